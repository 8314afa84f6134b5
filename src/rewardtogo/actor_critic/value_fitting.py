r"""Policy evaluation by regression: V_phi, observation to one number, fitted to what a fixed policy's rollouts say (notes 4.3, 4.4).

$$\phi \leftarrow \arg\min_\phi \tfrac{1}{2} \sum_{i,t} (V_\phi(s_{i,t}) - y_{i,t})^2, \qquad
y = \begin{cases} \sum_{t' \ge t} \gamma^{t'-t} r_{t'} & \text{Monte Carlo (item 4.12), } \lambda = 1 \\
r + \gamma (1 - \text{terminated}) V_\phi(s') & \text{bootstrapped (item 4.13), } \lambda = 0 \end{cases}$$

and the lambda-return between them. No gradient goes through y. A bootstrapped y moves with V: it is computed anew in every *round*, and
a few gradient steps are made towards it. It has the bias $\gamma\,E[V - V^\pi]$ of where it leads and the variance of one step
(4.4.4). A return that is cut, by a time limit or the end of the rollout, goes on with V at any lambda (erratum E1.5), so that
Monte-Carlo targets of unfinished episodes move, too. Discount 1 is for episodes that end (errata E4.3, E4.4).

Source: notes, sections 4.3, 4.4.3, 4.4.4 and 4.6.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, ScalarLike

from ..core import Observation, PRNGKey, Spec, Transition
from ..nn import Linear, Network, Optimiser, Torso
from ..ops.returns import lambda_returns

Value = Callable[[Any], Float[Array, ""]]
"""V: a module, all of whose leaves are arrays, that maps one observation to one number."""
V = TypeVar("V", bound=Value)


class ValueNetwork(eqx.Module):
    """The value network of figure 4.1: a torso, and a linear head of one number (item 4.7)."""

    torso: Torso
    head: Linear

    @staticmethod
    def of(network: Network, spec: Spec, key: PRNGKey) -> "ValueNetwork":
        """Fresh parameters. Raises `ValueError` for a recipe with a memory: one observation must be enough to tell the value."""
        if network.has_memory:
            raise ValueError(
                f"{network} has a memory, and a value network reads single observations: "
                "use a recipe without one, such as MLP(64, 64)"
            )
        torso_key, head_key = jax.random.split(key)
        torso = network.build(spec, torso_key)
        return ValueNetwork(torso, Linear.of(torso.features, 1, head_key, gain=1.0))

    def __call__(self, observation: Observation) -> Float[Array, ""]:
        return self.head(self.torso(self.torso.init(), observation)[1])[0]


class ValueTable(eqx.Module):
    """One number for each discrete observation."""

    values: Float[Array, "O"]

    def __call__(self, observation: Observation) -> Float[Array, ""]:
        return self.values[observation]


def value_targets(value: Value, transitions: Transition, gamma: ScalarLike, lambda_: ScalarLike) -> Float[Array, "T B"]:
    """The y of steps `[T, B]` that lie in the order of time: Monte Carlo at lambda 1, r + gamma V(s') at lambda 0."""
    t = transitions
    following = jax.vmap(jax.vmap(lambda o: value(o)))(t.next_observation)
    discount = gamma * (1.0 - t.terminated.astype(t.reward.dtype))
    targets = lambda r, d, v, c: lambda_returns(r, d, v, lambda_, c)  # noqa: E731
    return jax.lax.stop_gradient(jax.vmap(targets, 1, 1)(t.reward, discount, following, t.done))


def value_loss(value: Value, transitions: Transition, targets: Float[Array, "T B"]) -> Float[Array, ""]:
    """1/2 (V(s) - y)^2, the mean over all trajectories and all steps."""
    found = jax.vmap(jax.vmap(lambda o: value(o)))(transitions.observation)
    return 0.5 * jnp.mean(jnp.square(found - targets))


def fit_value(
    value: V,
    transitions: Transition,
    *,
    gamma: float,
    lambda_: float = 1.0,
    rounds: int = 1,
    updates: int = 100,
    optimiser: Optimiser = Optimiser(3e-3, 10.0),
) -> tuple[V, Float[Array, "K"]]:
    """Fit V to steps `[T, B]` of the policy that it is to evaluate: the fitted V, and the loss at the start of each round.

    - `lambda_`: 1 regresses on reward sums, 0 bootstraps.
    - `rounds`: how often targets are computed; `updates`: gradient steps, on all of the data, in each.

    Raises `ValueError` where there would be no step at all.
    """
    if rounds < 1 or updates < 1:
        raise ValueError(f"{rounds} rounds of {updates} updates fit nothing: give at least 1 of each")
    return _fit_value(value, transitions, jnp.asarray(gamma), jnp.asarray(lambda_), rounds, updates, optimiser)


@eqx.filter_jit
def _fit_value(
    value: V, transitions: Transition, gamma: Array, lambda_: Array, rounds: int, updates: int, optimiser: Optimiser
) -> tuple[V, Array]:
    def one_round(loop: tuple[V, optax.OptState], _: None) -> tuple[tuple[V, optax.OptState], Array]:
        targets = value_targets(loop[0], transitions, gamma, lambda_)

        def update(loop: tuple[V, optax.OptState], _: None) -> tuple[tuple[V, optax.OptState], Array]:
            value, state = loop
            loss, slope = jax.value_and_grad(value_loss)(value, transitions, targets)
            return optimiser.step(value, slope, state), loss

        loop, losses = jax.lax.scan(update, loop, None, updates)
        return loop, losses[0]

    (value, _), losses = jax.lax.scan(one_round, (value, optimiser.init(value)), None, rounds)
    return value, losses
