r"""Constraints through multipliers: the Lagrangian of a trust region, and dual gradient descent.

$$L(\pi', \lambda) = \bar A(\pi') - \lambda\, (\mathbb{E}_{s \sim d}[\mathrm{KL}(\pi' \| \pi)] - \epsilon), \qquad
\pi' \leftarrow \text{a few steps up } L(\cdot, \lambda), \qquad
\lambda \leftarrow \max(0,\ \lambda + \alpha\, (\mathrm{KL} - \epsilon)).$$

λ rises while the constraint is violated and falls while there is room. This goes down the dual function
g(λ) = max_π' L(π', λ), whose derivative is ε - KL at its maximiser.

Deviation from the notes: they leave out max(0, .), without which a constraint that does not bind drives λ below 0 and
pays for violating it (erratum E7.7).

Source: notes, section 7.2.3; Boyd and Vandenberghe (2004), section 5.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..envs.tabular import MDP
from ..exact import check_policy, horizon_of, softmax_policy
from .couplings import kl_rows
from .theory import (
    PolicyTable,
    discounted_visits,
    surrogate_advantage,
    surrogate_gradient,
)
from .trust_regions import check_kl_target, clear_advantages, exponential_tilt, occupancy_kl, weighted_mean


def _check_multiplier(multiplier: float) -> float:
    if not 0 <= multiplier < np.inf:
        raise ValueError(f"the multiplier is {multiplier} and must be finite and at least 0: "
                         "a negative one would reward violating the constraint")  # fmt: skip
    return float(multiplier)


def lagrangian(
    mdp: MDP, new: PolicyTable, old: PolicyTable, multiplier: float, eps: float, horizon: int | None = None
) -> float:
    """Ā(π') - λ (E_{s ~ d}[KL(π' || π)] - ε) (item 7.18)."""
    excess = occupancy_kl(mdp, new, old, horizon) - check_kl_target(eps)
    return surrogate_advantage(mdp, new, old, horizon) - _check_multiplier(multiplier) * excess


def lagrangian_gradient(
    mdp: MDP, logits: PolicyTable, old: PolicyTable, multiplier: float, horizon: int | None = None
) -> Float[np.ndarray, "... S A"]:
    """∂L/∂logits for π' = softmax(`logits`) (item 7.18); ε shifts L and does not matter to it.

    The KL adds -λ d(s) π'(a|s) (log π'(a|s)/π(a|s) - KL(s)). Logits without a time axis are shared by all steps.
    Raises `ValueError` where the old policy never does what the new one does, and the KL is infinite.
    """
    weight, steps = _check_multiplier(multiplier), horizon_of(mdp, horizon)
    after, before = check_policy(mdp, softmax_policy(logits), steps), check_policy(mdp, old, steps)
    visits, possible = discounted_visits(mdp, old, horizon), after > 0
    rows = kl_rows(after, before)
    if not np.all(np.isfinite(rows)):
        state = int(np.argwhere(~np.isfinite(rows))[0][-1])
        raise ValueError(f"in state {state} the new policy takes an action to which the old one gives probability 0, "
                         "so the KL has no gradient: give logits of -inf there")  # fmt: skip
    ratios = np.log(np.where(possible, after, 1)) - np.log(np.where(possible, before, 1))
    slope = (visits / visits.sum())[..., None] * after * (ratios - rows[..., None])
    shared = slope if slope.ndim == np.ndim(logits) else slope.sum(0)
    return surrogate_gradient(mdp, logits, old, horizon) - weight * shared


class DualDescent(eqx.Module):
    """Where dual gradient descent came to: the `point`, its `multiplier`, and how both went.

    `multipliers` and `violations` (of the constraint: above 0 is violated) are those after each round.
    """

    point: Float[np.ndarray, "..."]
    multiplier: float
    multipliers: Float[np.ndarray, "K"]
    violations: Float[np.ndarray, "K"]


def dual_gradient_descent(
    ascend: Callable[[np.ndarray, float], np.ndarray],
    violation: Callable[[np.ndarray], float],
    start: Float[np.ndarray, "..."],
    *,
    multiplier: float = 1.0,
    rate: float = 0.1,
    iterations: int = 1000,
) -> DualDescent:
    """The x of largest f(x) with violation(x) <= 0 (item 7.19).

    - `ascend(x, λ)` gives an x with a larger f(x) - λ violation(x). It need not be the best: a few steps are enough.
    - `rate` is α of λ <- max(0, λ + α violation(x)).
    """
    if not 0 < rate < np.inf or iterations < 1:
        raise ValueError(f"rate is {rate} and iterations {iterations}: a finite rate above 0 and at least "
                         "one iteration are needed")  # fmt: skip
    point, weight = start, _check_multiplier(multiplier)
    weights, violations = np.empty(iterations), np.empty(iterations)
    for k in range(iterations):
        point = ascend(point, weight)
        violations[k] = violation(point)
        if not np.isfinite(violations[k]):
            raise ValueError(f"after {k + 1} rounds the violation of the constraint is {violations[k]}: "
                             "lower the rate, or the steps that `ascend` takes")  # fmt: skip
        weight = weights[k] = max(0.0, weight + rate * violations[k])
    return DualDescent(point, weight, weights, violations)


def dual_kl_update(
    mdp: MDP,
    policy: PolicyTable,
    eps: float,
    horizon: int | None = None,
    *,
    multiplier: float = 1.0,
    rate: float | None = None,
    inner_steps: int = 5,
    iterations: int = 1000,
) -> DualDescent:
    """`kl_constrained_update` by dual gradient descent, with `inner_steps` steps up the Lagrangian a round (item 7.19).

    - The steps are natural gradient steps in x = log π'/π, for which states seldom seen are no slower. They are as
      long as is stable, 1 / (λ + the largest |Σ_t γ^t A|).
    - `rate`: α. `None` for a quarter of λ / ε at the λ that a quadratic KL would have.

    `point` is the policy π', `violations` are KL - ε.
    """
    check_kl_target(eps)
    if inner_steps < 1:
        raise ValueError(f"inner_steps is {inner_steps} and the Lagrangian needs at least 1 step up in each round")
    table = check_policy(mdp, policy, horizon_of(mdp, horizon))
    visits = discounted_visits(mdp, policy, horizon)
    gains = visits.sum() * clear_advantages(mdp, policy, horizon)
    largest = float(np.abs(gains).max())
    if rate is None:
        quadratic = np.sqrt(weighted_mean((table * gains**2).sum(-1), visits) / (2 * eps))
        rate = float(quadratic / (4 * eps)) if quadratic > 0 else 1.0

    def ascend(x: np.ndarray, weight: float) -> np.ndarray:
        for _ in range(inner_steps):
            x = x + (gains - weight * x) / (weight + largest) if largest > 0 else x
        return x

    def violation(x: np.ndarray) -> float:
        return weighted_mean(kl_rows(exponential_tilt(table, x), table), visits) - eps

    end = dual_gradient_descent(
        ascend, violation, np.zeros_like(table), multiplier=multiplier, rate=rate, iterations=iterations
    )
    return DualDescent(exponential_tilt(table, end.point), end.multiplier, end.multipliers, end.violations)
