r"""Lower bounds on the return of a new policy, and the largest steps that keep within a distance of the old one.

$$J(\pi') \ge J(\pi) + \bar A(\pi') - \sum_t 2 \epsilon t\, \gamma^t \max_s |\mathbb{E}_{a \sim \pi'} A_t|,
\qquad \text{for ever: the sum is } \frac{2 \epsilon \gamma}{(1 - \gamma)^2} \max_s |\mathbb{E}_{a \sim \pi'} A|
\le \frac{4 \epsilon^2 \gamma}{(1 - \gamma)^2} \max_{s, a} |A|,$$

with $\epsilon = \max_s D_{TV}$. The last is TRPO's. Steps: total variation at most $\epsilon$ (moves probability from
the worst actions to the best), KL at most $\epsilon$ ($\pi' \propto \pi e^{A / \eta}$), and a ball in the parameters.

Deviations from the notes. In (7.1) the constant O(r γ^t) has to stay under the sum with t, which makes 1/(1 - γ)^2
of 1/(1 - γ) (erratum E7.4); the smaller penalty is not a bound. Improvement is guaranteed not for any small ε but
where Ā exceeds the penalty, and an ε of KL is not one of total variation (erratum E7.5): `monotone_update` looks.
The ball of (7.5) has radius sqrt(ε) (erratum E7.8).

Source: notes, sections 7.2.1 to 7.2.4 and 3.9.1; Schulman et al. (2015), theorem 1; Kakade and Langford (2002).
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..envs.tabular import MDP
from ..exact import (
    advantage_values,
    check_policy,
    check_share,
    expected_return,
    horizon_of,
    policy_closeness,
    q_values,
)
from .couplings import kl_rows
from .theory import PolicyTable, discounted_visits, surrogate_advantage


def advantage_limit(mdp: MDP, horizon: int | None = None) -> Float[np.ndarray, "..."]:
    """What |A^π| never exceeds, whatever the policy: (T - t) range for each t `[T]`, else range / (1 - γ) (item 7.13).

    The range is that of r(s, a), with the 0 of terminal states. Raises `ValueError` for discount 1 without a horizon.
    """
    steps, span = horizon_of(mdp, horizon), float(np.ptp(mdp.rewards))
    if steps is None:
        return np.asarray(span / (1 - _discount_below_1(mdp)))
    return span * np.arange(steps, 0, -1, dtype=np.float64)


def _discount_below_1(mdp: MDP) -> float:
    if mdp.discount == 1:
        raise ValueError("with discount 1 and no horizon the sum over time of this bound is infinite: "
                         "lower the discount or give a horizon")  # fmt: skip
    return float(mdp.discount)


def improvement_penalty(
    mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None, *, trpo: bool = False
) -> float:
    """What the lower bound takes off Ā(π'), because the states of π' are not those of π (item 7.12, erratum E7.4).

    Σ_t 2 ε t γ^t max_s |E_{a ~ π'}[A_t]|, or with `trpo` the larger Σ_t 4 ε² t γ^t max |A_t|, where ε is
    `policy_closeness`. Raises `ValueError` for discount 1 without a horizon.
    """
    steps = horizon_of(mdp, horizon)
    table, advantages = check_policy(mdp, new, steps), advantage_values(mdp, old, horizon)
    eps = policy_closeness(table, check_policy(mdp, old, steps))
    size = 2 * eps * np.abs(advantages).max((-1, -2)) if trpo else np.abs((table * advantages).sum(-1)).max(-1)
    if steps is None:
        discount = _discount_below_1(mdp)
        return float(2 * eps * discount / (1 - discount) ** 2 * size)
    times = np.arange(steps)
    return float((2 * eps * times * float(mdp.discount) ** times * size).sum())


def return_lower_bound(
    mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None, *, trpo: bool = False
) -> float:
    """J(π) + Ā(π') - `improvement_penalty`, which J(π') is never below (item 7.12)."""
    known = expected_return(mdp, old, horizon) + surrogate_advantage(mdp, new, old, horizon)
    return known - improvement_penalty(mdp, new, old, horizon, trpo=trpo)


def clear_advantages(mdp: MDP, policy: PolicyTable, horizon: int | None = None) -> Float[np.ndarray, "... S A"]:
    """A^π, and 0 in states whose actions are equal up to rounding: noise must not move a policy there."""
    q = q_values(mdp, policy, horizon)
    differ = np.ptp(q, axis=-1, keepdims=True) > 1e-13 * np.abs(q).max()
    return np.where(differ, advantage_values(mdp, policy, horizon), 0.0)


def tv_constrained_update(
    mdp: MDP, policy: PolicyTable, eps: float, horizon: int | None = None
) -> Float[np.ndarray, "... S A"]:
    """The largest Ā(π') with D_TV <= ε in every state (item 7.14): a share ε goes from the worst actions to the best.

    With a horizon the result has time as its first axis. Never worse than the policy, by the lemma.
    """
    share = check_share(eps)
    table = check_policy(mdp, policy, horizon_of(mdp, horizon))
    advantages = clear_advantages(mdp, policy, horizon)
    order = advantages.argsort(-1, kind="stable")
    held = np.take_along_axis(table, order, -1)
    # Nothing to gain where the values are equal.
    behind = np.take_along_axis(advantages, order, -1) < advantages.max(-1, keepdims=True)
    taken = np.clip(share - (held.cumsum(-1) - held), 0, held) * behind
    moved = held - taken
    moved[..., -1] += taken.sum(-1)
    result = np.empty_like(moved)
    np.put_along_axis(result, order, moved, -1)
    return result


def monotone_update(
    mdp: MDP, policy: PolicyTable, horizon: int | None = None, *, trpo: bool = False
) -> Float[np.ndarray, "... S A"]:
    """The first `tv_constrained_update` of ε = 1, 1/2, 1/4, ... with Ā(π') above the penalty (item 7.14).

    So J rises by at least the difference. The policy itself where no ε down to 2^-30 will do: it is optimal, or
    nearly.
    """
    for halvings in range(31):
        new = tv_constrained_update(mdp, policy, 0.5**halvings, horizon)
        gain = surrogate_advantage(mdp, new, policy, horizon)
        if gain > improvement_penalty(mdp, new, policy, horizon, trpo=trpo):
            return new
    return np.array(check_policy(mdp, policy, horizon_of(mdp, horizon)))


def check_kl_target(eps: float) -> float:
    """A KL to keep to. Raises `ValueError` unless it is finite and above 0."""
    if not 0 < eps < np.inf:
        raise ValueError(f"the KL target is {eps} and must be a finite number above 0, such as 0.01: "
                         "a divergence is never negative, and at 0 the policy cannot move")  # fmt: skip
    return float(eps)


def weighted_mean(rows: Float[np.ndarray, "*shape"], weights: Float[np.ndarray, "*shape"]) -> float:
    """Σ w x / Σ w, where what has weight 0 may be infinite."""
    return float((weights * np.where(weights > 0, rows, 0)).sum() / weights.sum())


def occupancy_kl(
    mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None, *, old_first: bool = False
) -> float:
    """E_{s ~ d}[KL(π'(·|s) || π(·|s))] over the states of the old policy, weighted by γ^t and normalised.

    `old_first` takes KL(π || π'), which samples of the old policy estimate; to second order both are the same
    (erratum E7.6).
    """
    steps = horizon_of(mdp, horizon)
    after, before = check_policy(mdp, new, steps), check_policy(mdp, old, steps)
    rows = kl_rows(before, after) if old_first else kl_rows(after, before)
    return weighted_mean(rows, discounted_visits(mdp, old, horizon))


def exponential_tilt(policy: PolicyTable, exponents: Float[np.ndarray, "... S A"]) -> Float[np.ndarray, "... S A"]:
    """π'(a|s) ∝ π(a|s) exp(exponents[s, a]); actions of probability 0 stay so."""
    table = np.asarray(policy, np.float64)
    largest = np.where(table > 0, exponents, -np.inf).max(-1, keepdims=True)
    weights = table * np.exp(np.minimum(exponents - largest, 0))
    return weights / weights.sum(-1, keepdims=True)


class KLStep(eqx.Module):
    """`policy` ∝ π exp(A / `temperature`), and the multiplier λ of the constraint in Ā - λ (KL - ε), all float64.

    One number each for the mean KL, one for each state for KL in every state. 0 where the constraint does not bind:
    there even the best actions alone are within ε.
    """

    policy: Float[np.ndarray, "... S A"]
    temperature: Float[np.ndarray, "..."]
    multiplier: Float[np.ndarray, "..."]


def kl_constrained_update(
    mdp: MDP, policy: PolicyTable, eps: float, horizon: int | None = None, *, every_state: bool = False
) -> KLStep:
    """The largest Ā(π') with E_{s ~ d}[KL(π' || π)] <= ε, or with KL <= ε in `every_state` (item 7.16). Exact.

    The answer is π' ∝ π exp(A / η), and KL falls in η, which bisection finds to rounding. E_{a ~ π'}[A] >= 0 in every
    state, so J never falls, for any ε. Setting the derivative of Ā - λ (KL - ε) to 0 gives λ = η Σ_t γ^t for the
    mean (Ā is a sum over time, the mean KL is not) and λ_s = η_s Σ_t γ^t d_t(s) for every state.
    """
    check_kl_target(eps)
    table = check_policy(mdp, policy, horizon_of(mdp, horizon))
    advantages, visits = clear_advantages(mdp, policy, horizon), discounted_visits(mdp, policy, horizon)
    spread = np.ptp(np.where(table > 0, advantages, 0), axis=-1)  # E_{a ~ π}[A] = 0 is within the range of A
    if not every_state:
        spread = spread.max(where=visits > 0, initial=0, keepdims=True)
    scale = np.where(spread > 0, spread, 1.0)

    def tilted(temperature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        new = exponential_tilt(table, advantages / temperature[..., None])
        rows = kl_rows(new, table)
        return new, rows if every_state else np.full(spread.shape, weighted_mean(rows, visits))

    # KL <= (spread / η)² / 8 (Hoeffding) gives an η that is large enough; below `low`, A differs by rounding only.
    low, high = np.log(scale * 1e-16), np.log(scale / np.sqrt(8 * eps))
    low = np.minimum(low, high)
    loose = tilted(np.exp(low))[1] <= eps
    for _ in range(60):
        middle = (low + high) / 2
        within = tilted(np.exp(middle))[1] <= eps
        low, high = np.where(within, low, middle), np.where(within, middle, high)
    temperature = np.where(loose, scale * 1e-16, np.exp(high))
    new = tilted(temperature)[0]
    temperature = np.where(loose, 0.0, temperature)
    if every_state:
        return KLStep(new, temperature, temperature * visits)
    return KLStep(new, temperature.reshape(()), (temperature * visits.sum()).reshape(()))


def ball_constrained_step(gradient: Float[Array | np.ndarray, "*shape"], eps: float) -> Float[np.ndarray, "*shape"]:
    """The d of largest g·d with ||d||² <= ε: d = sqrt(ε / ||g||²) g (items 3.37 and 7.22, errata E3.13 and E7.8).

    Gradient ascent is this: a ball of radius sqrt(ε) in the parameters, whatever the policy makes of them. A gradient
    of 0 prefers no direction, and gives no step.
    """
    if not 0 <= eps < np.inf:
        raise ValueError(f"eps is {eps}, and as the square of a radius it must be finite and at least 0")
    g = np.asarray(gradient, np.float64)
    largest = np.abs(g).max(initial=0)
    if not np.isfinite(largest):
        raise ValueError(
            "the gradient has an entry that is not finite, so it has no direction: look for an overflow before it"
        )
    # Divided by its largest entry first: squares of very small or large gradients leave the range of float64.
    direction = g / largest if largest > 0 else g
    return direction * np.sqrt(eps) / (np.linalg.norm(direction) if largest > 0 else 1.0)
