"""Importance weights for whole trajectories: J and ∇J of a policy π' from the data of another one, π.

The dynamics cancel: p'(τ) / p(τ) = Π_t ρ_t with ρ_t = π'(a_t | s_t) / π(a_t | s_t) (item 3.28), and

    J(π') = E_π[Π_t ρ_t Σ_t r_t] = E_π[Σ_t r_t Π_{k <= t} ρ_k]      (E_π[Σ_t r_t] alone is J(π): erratum E3.7)

    ∇J(π') = E_π[Σ_t ∇ log π'_t (Π_{k <= t} ρ_k) Σ_{t' >= t} r_t' Π_{k = t+1}^{t'} ρ_k],

where the second product starts after t: the notes count ρ_t twice (erratum E3.8). Leaving that second product out gives
Σ_t E_{π'}[∇ log π' Q^π], which is biased, although it improves on π (erratum E3.9). The product up to t may be replaced
by ρ_t and the ratio of state distributions d'_t(s_t) / d_t(s_t), which in turn may be left out at the price of a bias of the
order of the difference of the policies (erratum E3.10). Var[Π ρ] grows exponentially with T.

Every weight function here gives Ψ `[N, T]` for `gradient_samples` or `estimator_moments(..., behaviour=...)`. Rewards count
γ^t r_t, as they do in J.

Source: notes, sections 3.8 and 3.9; Precup, Sutton and Singh 2000 (per-decision weights); Degris et al. 2012 (E3.9).
"""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..envs.tabular import MDP
from .chains import state_distributions
from .dynamic_programming import horizon_of
from .policies import check_policy
from .trajectories import Trajectories


def step_ratios(
    trajectories: Trajectories,
    target: Float[Array | np.ndarray, "... O A"],
    behaviour: Float[Array | np.ndarray, "... O A"],
) -> Float[np.ndarray, "N T"]:
    """ρ_t = π'(a_t | o_t) / π(a_t | o_t), and 1 at padding.

    Raises `ValueError` where `behaviour` never takes an action that `target` may take in an observation that was made:
    no weight can make up for that.
    """
    actions = np.asarray(trajectories.actions)
    steps, taken = actions.shape[1], np.asarray(trajectories.taken)
    seen = np.asarray(trajectories.observations)[:, :steps]
    time = np.arange(steps)
    new, old = (_over_time(table, steps) for table in (target, behaviour))
    missed = (old == 0) & (new > 0)
    bad = np.argwhere(missed[time, seen].any(-1) & taken)
    if len(bad):
        t, observation = bad[0, 1], seen[tuple(bad[0])]
        raise ValueError(
            f"in observation {observation} at step {t} the behaviour never takes action "
            f"{missed[t, observation].argmax()}, which the target may take: collect data with a policy that may take it"
        )
    ratio = new[time, seen, actions] / np.where(taken, old[time, seen, actions], 1.0)
    return np.where(taken, ratio, 1.0)


def _over_time(table: Array | np.ndarray, steps: int) -> np.ndarray:
    given = np.asarray(table, np.float64)
    return np.broadcast_to(given, (steps, *given.shape[-2:]))


def trajectory_ratios(ratios: Float[np.ndarray, "N T"]) -> Float[np.ndarray, "N"]:
    """p'(τ) / p(τ) = Π_t ρ_t, from the ratios of the steps (item 3.28)."""
    with np.errstate(divide="ignore"):
        return np.exp(np.log(ratios).sum(-1))


def off_policy_returns(
    trajectories: Trajectories,
    ratios: Float[np.ndarray, "N T"],
    discount: float = 1.0,
    *,
    per_decision: bool = False,
) -> Float[np.ndarray, "N"]:
    """The unbiased estimate of J(π') in each trajectory: Π ρ · R, or per decision Σ_t γ^t r_t Π_{k <= t} ρ_k."""
    if not per_decision:
        return trajectory_ratios(ratios) * np.asarray(trajectories.returns(discount), np.float64)
    return (_discounted(trajectories, discount) * np.cumprod(ratios, -1)).sum(-1)


class OffPolicyReturn(eqx.Module):
    """An estimate of J(π'), its standard error, and how many on-policy trajectories would be worth as much."""

    value: float
    standard_error: float
    effective_sample_size: float


def off_policy_return(
    trajectories: Trajectories,
    target: Float[Array | np.ndarray, "... O A"],
    behaviour: Float[Array | np.ndarray, "... O A"],
    discount: float = 1.0,
    *,
    method: Literal["trajectory", "self_normalised", "per_decision"] = "trajectory",
) -> OffPolicyReturn:
    """J(π') from N sampled trajectories of another policy (item 3.29).

    "trajectory" and "per_decision" are unbiased; "self_normalised", Σ w R / Σ w, has a bias of order 1/N, and the
    standard error of its linearisation. Raises `ValueError` as `step_ratios` does, and where all weights are 0.
    """
    ratios = step_ratios(trajectories, target, behaviour)
    weights, count = trajectory_ratios(ratios), len(ratios)
    if not weights.any():
        raise ValueError(
            "the target cannot have produced any of these trajectories: collect more, or from a nearer policy"
        )
    size = float(weights.sum() ** 2 / (weights**2).sum())
    if method == "self_normalised":
        totals = np.asarray(trajectories.returns(discount), np.float64)
        value = float(weights @ totals / weights.sum())
        error = float(np.sqrt((weights**2 * (totals - value) ** 2).sum()) / weights.sum())
        return OffPolicyReturn(value, error, size)
    each = off_policy_returns(trajectories, ratios, discount, per_decision=method == "per_decision")
    return OffPolicyReturn(float(each.mean()), float(each.std(ddof=1) / np.sqrt(count)), size)


def trajectory_weights(
    trajectories: Trajectories, ratios: Float[np.ndarray, "N T"], discount: float = 1.0
) -> Float[np.ndarray, "N T"]:
    """Ψ = Π ρ · R at each step: the gradient at θ' with the ratio of the whole trajectory (item 3.30)."""
    weighted = trajectory_ratios(ratios) * np.asarray(trajectories.returns(discount), np.float64)
    return np.repeat(weighted[:, None], ratios.shape[1], 1)


def per_decision_weights(
    trajectories: Trajectories,
    ratios: Float[np.ndarray, "N T"],
    discount: float = 1.0,
    *,
    past: Float[np.ndarray, "N T"] | None = None,
    future_ratio: bool = True,
) -> Float[np.ndarray, "N T"]:
    """Ψ_t = c_t ρ_t Σ_{t' >= t} γ^t' r_t' Π_{k=t+1}^{t'} ρ_k with c_t = Π_{k<t} ρ_k (item 3.33).

    - `past`: c_t instead, such as `marginal_ratios` (item 3.35), or ones to leave the ratio of states out (item 3.36).
    - `future_ratio`: whether the last product is there; without it the direction is a biased one (item 3.34).
    """
    ahead = _discounted(trajectories, discount)
    for t in reversed(range(ratios.shape[1] - 1)):
        ahead[:, t] += ahead[:, t + 1] * (ratios[:, t + 1] if future_ratio else 1.0)
    before = np.cumprod(np.concatenate([np.ones((len(ratios), 1)), ratios[:, :-1]], 1), -1) if past is None else past
    return before * ratios * ahead


def _discounted(trajectories: Trajectories, discount: float) -> np.ndarray:
    """γ^t r_t."""
    rewards = np.asarray(trajectories.rewards, np.float64)
    return rewards * float(discount) ** np.arange(rewards.shape[-1])


def marginal_ratios(
    mdp: MDP,
    trajectories: Trajectories,
    target: Float[Array | np.ndarray, "... S A"],
    behaviour: Float[Array | np.ndarray, "... S A"],
) -> Float[np.ndarray, "N T"]:
    """d'_t(s_t) / d_t(s_t) of the states where trajectories of `behaviour` were, exact (item 3.35)."""
    steps = trajectories.rewards.shape[-1]
    new, old = (state_distributions(mdp, table, steps)[:-1] for table in (target, behaviour))
    seen, time = np.asarray(trajectories.observations)[:, :-1], np.arange(steps)
    return np.asarray(new[time, seen] / old[time, seen])


def weight_variances(
    mdp: MDP,
    target: Float[Array | np.ndarray, "... S A"],
    behaviour: Float[Array | np.ndarray, "... S A"],
    horizon: int | None = None,
) -> Float[np.ndarray, "K"]:
    """Var[Π_{k<t} ρ_k] for t = 0..T, by dynamic programming: E[Π ρ²] - 1 (item 3.32).

    Where the two policies differ alike in every state it is (1 + χ²(π' || π))^t - 1. Raises `ValueError` without a
    horizon, and where `behaviour` never takes an action that `target` may take.
    """
    steps = horizon_of(mdp, horizon)
    if steps is None:
        raise ValueError("the weights of endless trajectories have no variance: give a horizon")
    new, old = (check_policy(mdp, table, steps) for table in (target, behaviour))
    live = ~np.asarray(mdp.terminal)
    if ((old == 0) & (new > 0))[:, live].any():
        raise ValueError(
            "the target may take an action that the behaviour never takes, so its trajectories cannot all be weighted: "
            "give a behaviour that may take every action of the target"
        )
    # Σ_a π(a|s) ρ² = Σ_a π'(a|s)² / π(a|s); nothing is chosen, and no ratio taken, in terminal states.
    squares = np.divide(new**2, old, out=np.zeros(new.shape), where=old > 0)
    squares = np.where(live[:, None], squares, new)
    mass = [np.asarray(mdp.initial, np.float64)]
    for t in range(steps):
        mass.append(np.einsum("s,sa,sax->x", mass[-1], squares[t], mdp.transitions))
    return np.stack(mass).sum(-1) - 1
