"""What multiplies the scores in an estimator of the policy gradient: returns, rewards to go, values and advantages.

Each function takes trajectories and gives Ψ `[N, T]`, to be used alone or subtracted one from another:

    total return     Σ_{t'} γ^t' r_t'                 reward to go     Σ_{t' >= t} γ^(t'-t) r_t'
    TD error         r_t + γ V(s_{t+1}) - V(s_t)      n-step return    Σ_{k < n} γ^k r_{t+k} + γ^n V(s_{t+n})

The n-step sum has n rewards, not n + 1 (erratum E4.9). V of a terminal state is 0; V of where an episode was truncated
counts (erratum E1.5). Entries of padding are of no account.

Source: notes, sections 3.7.1, 4.3, 4.8 and 4.9.
"""

import numpy as np
from jaxtyping import Array, Float

from .trajectories import Trajectories


def total_returns(trajectories: Trajectories, discount: float = 1.0) -> Float[np.ndarray, "N T"]:
    """Σ_t γ^t r_t of the whole trajectory, at each of its steps (item 3.5)."""
    totals = np.asarray(trajectories.returns(discount), np.float64)
    return np.repeat(totals[:, None], trajectories.rewards.shape[-1], 1)


def rewards_to_go(trajectories: Trajectories, discount: float = 1.0) -> Float[np.ndarray, "N T"]:
    """Σ_{t' >= t} γ^(t'-t) r_t' (item 3.18)."""
    ahead = np.asarray(trajectories.rewards, np.float64).copy()
    for t in reversed(range(ahead.shape[1] - 1)):
        ahead[:, t] += discount * ahead[:, t + 1]
    return ahead


def values_at(trajectories: Trajectories, values: Float[Array | np.ndarray, "... O"]) -> Float[np.ndarray, "N T"]:
    """V(o_t), or V_t(o_t) of values `[T, O]` or `[T + 1, O]` that vary with time."""
    return _values(trajectories, values)[:, :-1]


def action_values_at(
    trajectories: Trajectories, values: Float[Array | np.ndarray, "... O A"]
) -> Float[np.ndarray, "N T"]:
    """Q(o_t, a_t), or Q_t(o_t, a_t) of values `[T, O, A]` that vary with time."""
    table, actions = np.asarray(values, np.float64), np.asarray(trajectories.actions)
    seen = np.asarray(trajectories.observations)[:, :-1]
    return table[seen, actions] if table.ndim == 2 else table[np.arange(seen.shape[1]), seen, actions]


def td_errors(
    trajectories: Trajectories, values: Float[Array | np.ndarray, "... O"], discount: float = 1.0
) -> Float[np.ndarray, "N T"]:
    """δ_t = r_t + γ (1 - terminated) V(o_{t+1}) - V(o_t), the one-sample advantage (item 4.6)."""
    return n_step_returns(trajectories, values, 1, discount) - values_at(trajectories, values)


def n_step_returns(
    trajectories: Trajectories, values: Float[Array | np.ndarray, "... O"], n: int, discount: float = 1.0
) -> Float[np.ndarray, "N T"]:
    """Σ_{k < n} γ^k r_{t+k} + γ^n V(o_{t+n}), with fewer steps where the episode ends (item 4.30).

    Values that vary with time must be `[T + 1, O]` where some episode is truncated. Raises `ValueError` for n below 1.
    """
    if n < 1:
        raise ValueError(f"a return of {n} steps has no reward in it: give n of at least 1")
    after = _values(trajectories, values)[:, 1:].copy()
    steps = np.arange(after.shape[1])
    last = steps == np.asarray(trajectories.lengths)[:, None] - 1
    after[last & np.asarray(trajectories.terminated)[:, None]] = 0
    rewards = np.asarray(trajectories.rewards, np.float64)
    found = rewards + discount * after
    for _ in range(min(n, len(steps)) - 1):
        longer = np.concatenate([found[:, 1:], after[:, -1:]], 1)
        found = rewards + discount * np.where(last, after, longer)
    return found


def _values(trajectories: Trajectories, values: Array | np.ndarray) -> np.ndarray:
    """V at each of the T + 1 observations: `[N, T + 1]`; 0 at the last one if there are only T tables."""
    table, seen = np.asarray(values, np.float64), np.asarray(trajectories.observations)
    if table.ndim == 1:
        return table[seen]
    steps = seen.shape[1]
    if len(table) not in (steps - 1, steps):
        raise ValueError(
            f"the values vary over {len(table)} times and the trajectories have {steps}, or {steps - 1} without "
            "their last observation: give one row for each"
        )
    table = table if len(table) == steps else np.concatenate([table, np.zeros((1, table.shape[1]))])
    return table[np.arange(steps), seen]
