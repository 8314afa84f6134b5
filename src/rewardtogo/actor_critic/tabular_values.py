"""V^π from sampled episodes, in a table or linear in features, in float64: what regression ends at, and learning step by step.

    normal equations     Σ φ φ' w = Σ φ y,       y the reward sums          (item 4.12: argmin 1/2 Σ (φ'w - y)²)
    TD fixed point       Σ φ (φ - γ φ_next)' w = Σ φ r                      (item 4.13: y = r + γ φ_next'w, no gradient through y)
    n steps              V(s_t) += α (G^(n)_t - V(s_t))                     (item 4.30; n = ∞ is Monte Carlo)
    TD(λ)                e <- γ λ e + 1{s_t},   V += α δ_t e                (item 4.35)

From the same episodes the TD fixed point has the smaller error in stochastic problems: it is exact for the Markov chain that fits
the data best, and a reward sum carries the noise of every step to the end (4.4.4).

Source: notes, sections 4.4.3, 4.4.4 and 4.9; Sutton and Barto 2018, sections 6.3, 7.1, 9.8 and 12.2.
"""

import numpy as np
from jaxtyping import Array, Bool, Float

from ..exact import Trajectories
from ..exact.signals import n_step_returns, rewards_to_go


def normal_equations(
    features: Float[Array | np.ndarray, "N F"], targets: Float[Array | np.ndarray, "N"]
) -> Float[np.ndarray, "F"]:
    """The w of least Σ (φ'w - y)²; of several the smallest."""
    return np.linalg.lstsq(np.asarray(features, np.float64), np.asarray(targets, np.float64), rcond=None)[0]


def td_fixed_point(
    features: Float[Array | np.ndarray, "N F"],
    rewards: Float[Array | np.ndarray, "N"],
    discounts: Float[Array | np.ndarray, "N"],
    next_features: Float[Array | np.ndarray, "N F"],
) -> Float[np.ndarray, "F"]:
    """The w that fits its own targets r + γ (1 - terminated) φ_next'w best (LSTD; Bradtke and Barto 1996).

    Features that never occur get 0. Raises `ValueError` where there is no such w, as for a loop with discount 1.
    """
    phi = np.asarray(features, np.float64)
    system = phi.T @ (phi - np.asarray(discounts, np.float64)[:, None] * np.asarray(next_features, np.float64))
    given = phi.T @ np.asarray(rewards, np.float64)
    found = np.linalg.lstsq(system, given, rcond=None)[0]
    if np.abs(system @ found - given).max() > 1e-8 * max(1.0, np.abs(given).max()):
        raise ValueError(
            "no value is its own target for these steps, because some of them lead round for ever without a discount: "
            "lower the discount or give episodes that end"
        )
    return found


def monte_carlo_values(
    trajectories: Trajectories, features: Float[np.ndarray, "O F"], discount: float = 1.0
) -> Float[np.ndarray, "O"]:
    """φ'w fitted to the reward sums of all steps of all episodes, for each observation. `np.eye(O)` for a table."""
    seen, taken = np.asarray(trajectories.observations)[:, :-1], np.asarray(trajectories.taken)
    return features @ normal_equations(features[seen[taken]], rewards_to_go(trajectories, discount)[taken])


def td_values(
    trajectories: Trajectories, features: Float[np.ndarray, "O F"], discount: float = 1.0
) -> Float[np.ndarray, "O"]:
    """φ'w at the TD fixed point of all steps of all episodes, for each observation."""
    seen, taken = np.asarray(trajectories.observations), np.asarray(trajectories.taken)
    discounts = discount * (1.0 - _ends(trajectories))
    rewards = np.asarray(trajectories.rewards, np.float64)[taken]
    found = td_fixed_point(features[seen[:, :-1][taken]], rewards, discounts[taken], features[seen[:, 1:][taken]])
    return features @ found


def learn_n_step(
    trajectories: Trajectories,
    num_observations: int,
    n: int,
    rates: Float[np.ndarray, "K"],
    *,
    discount: float = 1.0,
    runs: int = 1,
) -> Float[np.ndarray, "R E K O"]:
    """Tables after each episode, from 0, learned with n-step returns while the episodes are played (online n-step TD).

    - `trajectories`: N episodes; the first N / `runs` are the first learner's, one after another, and so on.
    - `rates`: α; each has a table of its own.

    Raises `ValueError` for n below 1, and where the learners cannot have equally many episodes.
    """
    lengths, steps = np.asarray(trajectories.lengths)[:, None], np.arange(trajectories.rewards.shape[-1])
    # The update of step t is made when step t + n - 1 is known, from the table as the updates of earlier steps left it.
    after = np.minimum(steps + n, lengths)
    ended = (after == lengths) & np.asarray(trajectories.terminated)[:, None]
    power = np.where(ended, 0.0, discount ** np.maximum(after - steps, 0).astype(np.float64))
    sums = n_step_returns(trajectories, np.zeros(num_observations), n, discount)
    seen = np.asarray(trajectories.observations)
    given = (seen, sums, power, np.take_along_axis(seen, after, 1), np.asarray(trajectories.lengths))
    seen, sums, power, following, lengths = (_deal(x, runs) for x in given)
    run, tables, found = np.arange(runs), np.zeros((runs, len(rates), num_observations)), []
    for e in range(lengths.shape[1]):
        for t in range(lengths[:, e].max()):
            s, alpha = seen[:, e, t], np.where(lengths[:, e, None] > t, rates, 0.0)
            target = sums[:, e, t, None] + power[:, e, t, None] * tables[run, :, following[:, e, t]]
            tables[run, :, s] += alpha * (target - tables[run, :, s])
        found.append(tables.copy())
    return np.stack(found, 1)


@np.errstate(over="ignore", invalid="ignore")
def learn_td_lambda(
    trajectories: Trajectories,
    num_observations: int,
    lambda_: float,
    rates: Float[np.ndarray, "K"],
    *,
    discount: float = 1.0,
    runs: int = 1,
) -> Float[np.ndarray, "R E K O"]:
    """Tables after each episode, from 0, learned with eligibility traces; arguments as `learn_n_step`.

    A rate that is too large for its lambda ends in numbers that are not finite.
    """
    given = (
        trajectories.observations,
        trajectories.rewards,
        discount * (1.0 - _ends(trajectories)),
        trajectories.lengths,
    )
    seen, rewards, discounts, lengths = (_deal(np.asarray(x), runs) for x in given)
    run, tables, found = np.arange(runs), np.zeros((runs, len(rates), num_observations)), []
    for e in range(lengths.shape[1]):
        trace = np.zeros((runs, num_observations))
        for t in range(lengths[:, e].max()):
            s, alpha = seen[:, e, t], np.where(lengths[:, e, None] > t, rates, 0.0)
            ahead = discounts[:, e, t, None] * tables[run, :, seen[:, e, t + 1]]
            trace *= discount * lambda_
            trace[run, s] += 1.0
            change = alpha * (rewards[:, e, t, None] + ahead - tables[run, :, s])
            tables += change[..., None] * trace[:, None]
        found.append(tables.copy())
    return np.stack(found, 1)


def _deal(x: np.ndarray, runs: int) -> np.ndarray:
    if runs < 1 or len(x) % runs:
        raise ValueError(
            f"{len(x)} episodes cannot be dealt to {runs} learners in equal numbers: give a multiple of {max(runs, 1)}"
        )
    return x.reshape(runs, len(x) // runs, *x.shape[1:])


def _ends(trajectories: Trajectories) -> Bool[np.ndarray, "N T"]:
    """Which steps led to a terminal state."""
    last = np.arange(trajectories.rewards.shape[-1]) == np.asarray(trajectories.lengths)[:, None] - 1
    return last & np.asarray(trajectories.terminated)[:, None]
