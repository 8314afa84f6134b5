r"""Policy gradients as policy iteration: what a new policy gains, and what of it old data can tell.

$$J(\pi') - J(\pi) = \sum_t \gamma^t\, \mathbb{E}_{s \sim d'_t}\, \mathbb{E}_{a \sim \pi'}[A^\pi(s, a)]
= \sum_t \mathbb{E}_{s \sim d'_t}\, \mathbb{E}_{a \sim \pi}\Big[\tfrac{\pi'(a|s)}{\pi(a|s)} \gamma^t A^\pi(s, a)\Big],
\qquad
\bar A(\pi') = \sum_t \gamma^t\, \mathbb{E}_{s \sim d_t}\, \mathbb{E}_{a \sim \pi'}[A^\pi(s, a)].$$

The first is the performance difference lemma. The surrogate $\bar A$ has the states of the old policy, so it needs no
new data; it agrees with $J(\pi') - J(\pi)$ in value (0) and gradient at $\pi' = \pi$, and to order $\epsilon^2$ for
policies within $\epsilon$. How far that carries is in `couplings` (how far the states can move), `trust_regions` (the
lower bounds, and the largest steps that keep to them) and `duals` (constraints through multipliers).

All are exact, on tabular problems, in float64. Everywhere `horizon` is a number of actions, the problem's own where
it is left out, and values, advantages and occupancies then have time as their first axis, from t = 0; without one
they are the discounted sums for ever. A policy is a table `[S, A]`, or `[T, S, A]` with a horizon.

Source: notes, section 7.1 and 7.2.4 (first-order surrogate); Kakade and Langford (2002), lemma 6.1; Schulman et al.
(2015), section 2.
"""

import numpy as np
from jaxtyping import Array, Float

from ..envs.tabular import MDP
from ..exact import (
    advantage_values,
    check_policy,
    discounted_occupancy,
    greedy_policy,
    horizon_of,
    softmax_policy,
    state_distributions,
)

PolicyTable = Float[Array | np.ndarray, "... S A"]


def discounted_visits(mdp: MDP, policy: PolicyTable, horizon: int | None = None) -> Float[np.ndarray, "... S"]:
    """γ^t d_t(s), `[T, S]` with a horizon, else their sum over all t, `[S]`; only states in which there is a choice.

    The weights of every sum over time below. Without terminal states, and for ever, (1 - γ) times them is the
    discounted state distribution.
    """
    steps = horizon_of(mdp, horizon)
    if steps is None:
        return discounted_occupancy(mdp, policy).sum(-1)
    visits = state_distributions(mdp, policy, steps)[:-1] * ~np.asarray(mdp.terminal)
    return float(mdp.discount) ** np.arange(steps)[:, None] * visits


def _expected_advantage(mdp: MDP, visits: np.ndarray, new: PolicyTable, old: PolicyTable, horizon: int | None) -> float:
    table = check_policy(mdp, new, horizon_of(mdp, horizon))
    return float((visits[..., None] * table * advantage_values(mdp, old, horizon)).sum())


def performance_difference(mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None) -> float:
    """J(π') - J(π) = Σ_t γ^t E_{s ~ d'_t, a ~ π'}[A^π(s, a)] (item 7.1): states and actions of the new policy."""
    return _expected_advantage(mdp, discounted_visits(mdp, new, horizon), new, old, horizon)


def importance_performance_difference(
    mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None
) -> float:
    """Σ_t E_{s ~ d'_t} E_{a ~ π}[π'(a|s)/π(a|s) γ^t A^π(s, a)] (item 7.4): the actions come from the old policy.

    Raises `ValueError` where the new policy does what the old one never does: no weight can make up for that.
    """
    steps = horizon_of(mdp, horizon)
    after, before = check_policy(mdp, new, steps), check_policy(mdp, old, steps)
    visits = discounted_visits(mdp, new, horizon)
    missing = np.argwhere((visits[..., None] > 0) & (after > 0) & (before == 0))
    if len(missing):
        *time, state, action = (int(i) for i in missing[0])
        place = f"in state {state}" + (f" at time {time[0]}" if time else "")
        raise ValueError(f"{place} the new policy takes action {action}, to which the old one gives probability 0, "
                         "so its importance weight does not exist: give an old policy that tries every action "
                         "of the new one, or use performance_difference")  # fmt: skip
    ratios = np.divide(after, before, out=np.zeros_like(after), where=before > 0)
    return float((visits[..., None] * before * ratios * advantage_values(mdp, old, horizon)).sum())


def surrogate_advantage(mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None) -> float:
    """Ā(π') = Σ_t γ^t E_{s ~ d_t, a ~ π'}[A^π(s, a)] (item 7.5): the states are the old policy's. 0 for π' = π."""
    return _expected_advantage(mdp, discounted_visits(mdp, old, horizon), new, old, horizon)


def surrogate_gradient(
    mdp: MDP, logits: PolicyTable, old: PolicyTable, horizon: int | None = None
) -> Float[np.ndarray, "... S A"]:
    """∇Ā in the logits of π' = softmax(`logits`): Σ_t γ^t d_t(s) π'(a|s) (A(s, a) - E_{a ~ π'}[A(s, a)]).

    At π' = π it is the policy gradient ∇J(π), with γ^t kept (item 7.21). Logits without a time axis are shared by
    all steps.
    """
    after = check_policy(mdp, softmax_policy(logits), horizon_of(mdp, horizon))
    advantages = advantage_values(mdp, old, horizon)
    centred = advantages - (after * advantages).sum(-1, keepdims=True)
    gradient = discounted_visits(mdp, old, horizon)[..., None] * after * centred
    return gradient if gradient.ndim == np.ndim(logits) else gradient.sum(0)


def argmax_step(mdp: MDP, policy: PolicyTable, horizon: int | None = None) -> Float[np.ndarray, "... S A"]:
    """argmax_a A^π(s, a) in each state: a step of policy iteration (item 7.3). Never worse, by the lemma."""
    return greedy_policy(advantage_values(mdp, policy, horizon))


def gradient_step(
    mdp: MDP, logits: PolicyTable, step_size: float, horizon: int | None = None
) -> Float[np.ndarray, "... S A"]:
    """Logits after a step of policy gradient: policy iteration that improves by a little (item 7.3)."""
    if not step_size > 0 or not np.isfinite(step_size):
        raise ValueError(f"the step size is {step_size} and a step uphill needs a finite one above 0")
    return np.asarray(logits, np.float64) + step_size * surrogate_gradient(mdp, logits, softmax_policy(logits), horizon)
