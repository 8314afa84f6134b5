r"""Fitted value iteration (Algorithm 8) and fitted Q-iteration (Algorithm 9) with linear features and exact regressions (notes, 5.3).

$$y_i = \max_a \Big( r(s_i, a) + \gamma\, \mathbb{E}_{s'}[V_\phi(s')] \Big), \qquad
\phi = \arg\min_\phi \tfrac12 \sum_i (V_\phi(s_i) - y_i)^2 \qquad \text{(8)}$$

$$y_i = r_i + \gamma\, (1 - \text{terminated}_i) \max_{a'} Q_\phi(s'_i, a'), \qquad
\phi = \arg\min_\phi \tfrac12 \sum_i (Q_\phi(s_i, a_i) - y_i)^2 \qquad \text{(9)}$$

The maximum of (8) is outside of the expectation, over an $a$ that the notes write $a_i$ (erratum E5.5), and so it needs the outcome of
*every* action in $s_i$: a model. (9) needs single transitions, from whatever policy. (8) is fitted to the greedy backup, not to $V^\pi$
(erratum E5.4). With one feature a state (or pair) the first is value iteration and the second value iteration in the model that the data
makes; with fewer, both may diverge (`value/divergence.py`). The number of rounds and the regression are left open in the notes (erratum
E5.12): here each is solved exactly, by least squares. Deep fitted Q-iteration, gradient steps in place of solving, is `rtg train fqi`.

Source: notes, sections 5.3.1 and 5.3.2; Ernst, Geurts and Wehenkel 2005.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core import Carry, Model, Observation, Policy, PRNGKey, Solution, State

Features = Callable[[Any], Float[Array, "F"]]


def value_regression_loss(
    value: Callable[[Any], Float[Array, ""]], states: Any, targets: Float[Array, "N"]
) -> Float[Array, ""]:
    """½ Σ_i (V(s_i) - y_i)², with no derivative through y (item 5.10). A sum over the samples (erratum E5.4)."""
    found = jax.vmap(lambda s: value(s))(states)
    return 0.5 * jnp.square(found - jax.lax.stop_gradient(targets)).sum()


class LinearValue(eqx.Module):
    """V(s) = φ(s)'w."""

    weights: Float[Array, "F"]
    features: Features = eqx.field(static=True)

    def __call__(self, state: Any) -> Float[Array, ""]:
        return self.features(state) @ self.weights


class Outcomes(eqx.Module):
    """What a model says of N states, all A actions, and M samples of each: the data of Algorithm 8."""

    features: Float[np.ndarray, "N F"]
    rewards: Float[np.ndarray, "N A M"]
    going_on: Float[np.ndarray, "N A M"]
    next_features: Float[np.ndarray, "N A M F"]

    def targets(self, weights: Float[np.ndarray, "F"], gamma: float) -> Float[np.ndarray, "N"]:
        """max_a mean_m (r + γ (1 - terminal) V(s'))."""
        return (self.rewards + gamma * self.going_on * (self.next_features @ weights)).mean(-1).max(-1)


def outcomes(
    model: Any, states: Any, actions: Any, features: Features, *, samples: int = 1, key: PRNGKey | None = None
) -> Outcomes:
    """Try every action in every state, `samples` times (1 is enough where nothing is random).

    Raises `ValueError` without a model: nobody can go back and try another action in the world itself (item 5.12).
    """
    if not isinstance(model, Model):
        raise ValueError(
            f"fitted value iteration tries every action in every state, which takes a model (rtg.Model), not {type(model).__name__}: "
            "give one, or learn from single transitions by fitted Q-iteration"
        )
    if samples < 1:
        raise ValueError(f"{samples} samples of an outcome say nothing: take at least 1")
    counts = (len(jax.tree.leaves(states)[0]), len(jax.tree.leaves(actions)[0]), samples)
    keys = jax.random.split(jax.random.key(0) if key is None else key, counts)

    def one(state: State, action: State, key: PRNGKey) -> tuple[Array, Array, Array]:
        following = model.transition(state, action, key)
        going_on = 1.0 - model.terminal(following).astype(float)
        return model.reward(state, action, following), going_on, features(following)

    over_samples = jax.vmap(one, (None, None, 0))
    over_actions = jax.vmap(over_samples, (None, 0, 0))
    rewards, going_on, after = jax.jit(jax.vmap(over_actions, (0, None, 0)))(states, actions, keys)
    here = jax.jit(jax.vmap(lambda s: features(s)))(states)
    return Outcomes(*(np.asarray(x, np.float64) for x in (here, rewards, going_on, after)))


def fitted_value_iteration(
    model: Any,
    states: Any,
    actions: Any,
    features: Features,
    *,
    gamma: float,
    samples: int = 1,
    key: PRNGKey | None = None,
    rounds: int = 1000,
    tolerance: float = 1e-6,
) -> Solution:
    """Algorithm 8 on N states of a model: `value` is a `LinearValue`.

    - `model`: a `Model`; all else is refused.
    - `states`, `actions`: trees with leading axes N and A; all states of a small problem, or samples of a large one (item 5.13).
    - `features`: of one state of the model.

    It stops when no value of the N states changes by more than `tolerance`; `converged` is False where it never does, as it may not.
    Raises `ValueError` without a model, and for numbers that make no sense.
    """
    data = outcomes(model, states, actions, features, samples=samples, key=key)
    weights, stats = _iterate(data.features, lambda w: data.targets(w, gamma), rounds, tolerance, None)
    found = LinearValue(jnp.asarray(weights, jnp.float32), features)
    return Solution(found, np.asarray(stats["residuals"][-1] <= tolerance), stats)


def fitted_q_iteration(
    features: Float[np.ndarray, "N F"],
    rewards: Float[np.ndarray, "N"],
    discounts: Float[np.ndarray, "N"],
    next_features: Float[np.ndarray, "N A F"],
    *,
    weights: Float[np.ndarray, "N"] | None = None,
    rounds: int = 1000,
    tolerance: float = 1e-8,
) -> Solution:
    """Algorithm 9 on N transitions: `value` is w of Q(s, a) = φ(s, a)'w.

    - `features`: φ(s_i, a_i); `next_features`: φ(s'_i, a') for every a'.
    - `discounts`: γ (1 - terminated_i); a truncated step bootstraps (erratum E1.5).
    - `weights`: how much each sample counts.

    Neither the order of the samples nor the policy that took them matters (items 5.15 and 5.18). Raises `ValueError` where the next
    observations are missing or the numbers do not fit together.
    """
    features, next_features = np.asarray(features, np.float64), np.asarray(next_features, np.float64)
    n, width = features.shape
    if next_features.ndim != 3 or next_features.shape[0] != n or next_features.shape[2] != width:
        raise ValueError(
            f"next_features has shape {next_features.shape} and must be [{n}, A, {width}]: the target of each of {n} transitions looks at "
            "all actions in the next observation, without which nothing can be fitted"
        )
    targets = lambda w: rewards + discounts * (next_features @ w).max(-1)  # noqa: E731
    found, stats = _iterate(features, targets, rounds, tolerance, weights)
    return Solution(found, np.asarray(stats["residuals"][-1] <= tolerance), stats)


def _iterate(
    features: Float[np.ndarray, "N F"],
    targets: Callable[[Float[np.ndarray, "F"]], Float[np.ndarray, "N"]],
    rounds: int,
    tolerance: float,
    weights: Float[np.ndarray, "N"] | None,
) -> tuple[Float[np.ndarray, "F"], dict[str, Any]]:
    """Regress on targets that move with what is regressed, until nothing changes or everything does."""
    if rounds < 1:
        raise ValueError(f"{rounds} rounds fit nothing: allow at least 1")
    root = np.ones(len(features)) if weights is None else np.sqrt(np.asarray(weights, np.float64))
    solve = np.linalg.pinv(root[:, None] * features) * root
    w, residuals = np.zeros(features.shape[1]), []
    with np.errstate(over="ignore", invalid="ignore"):
        while len(residuals) < rounds:
            new = solve @ targets(w)
            residuals.append(float(np.abs(features @ (new - w)).max()))
            w = new
            if residuals[-1] <= tolerance or not np.isfinite(residuals[-1]):
                break
    return w, {"rounds": np.asarray(len(residuals)), "residuals": np.array(residuals)}


class LookaheadPolicy(Policy):
    """argmax_a r(s, a) + γ E V(s'): the policy of a V and a model, the mean over `samples` outcomes of each action."""

    model: Model
    value: LinearValue
    actions: Any
    gamma: Float[Array, ""]
    samples: int = eqx.field(static=True, default=1)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Any, dict[str, Array]]:
        best = jnp.argmax(self.q_values(observation, key))
        return carry, jax.tree.map(lambda x: x[best], self.actions), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        q = self.q_values(observation, jax.random.key(0))
        return {"q_values": q, "value": q.max()}

    def q_values(self, observation: Observation, key: PRNGKey) -> Float[Array, "A"]:
        """One step ahead, for every action."""
        state = self.model.encode(observation)

        def one(action: Any, key: PRNGKey) -> Float[Array, ""]:
            following = self.model.transition(state, action, key)
            ahead = jnp.where(self.model.terminal(following), 0.0, self.value(following))
            return self.model.reward(state, action, following) + self.gamma * ahead

        keys = jax.random.split(key, self.samples)
        several = lambda action: jax.vmap(lambda k: one(action, k))(keys).mean()  # noqa: E731
        return jax.vmap(several)(self.actions)
