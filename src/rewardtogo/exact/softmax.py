"""Softmax policies as tables of logits θ[o, a], their scores, and what a trajectory adds to the policy gradient.

    π_θ(a | o) = exp θ[o, a] / Σ_b exp θ[o, b],      ∂ log π_θ(a | o) / ∂ θ[o, ·] = one_hot(a) - π_θ(· | o),

and 0 in every other row, so that E_{a ~ π}[∇ log π] = 0 and ∇π = π ∇ log π (item 3.2). An estimator of the policy
gradient multiplies every score by a weight,

    g(τ) = Σ_t Ψ_t ∇_θ log π_θ(a_t | o_t),

and needs the actions, the observations and the weights, but neither p_0 nor P (item 3.4): they do not depend on θ. With
Ψ = 1 it is the gradient of the log-likelihood of the trajectory (item 3.11). Logits may vary with time: `[T, O, A]`.

Source: notes, sections 3.1, 3.2 and 3.4.
"""

import numpy as np
from jaxtyping import Array, Float

from .trajectories import Trajectories

MOST_NUMBERS = 50_000_000
"""Samples of gradients with more entries than this are refused: they would no longer fit a small machine."""


def softmax_policy(logits: Float[Array | np.ndarray, "... O A"]) -> Float[np.ndarray, "... O A"]:
    """π_θ(a | o) ∝ exp(θ[o, a]) as a table in float64; -inf for what is never done.

    Raises `ValueError` for logits that give no distribution.
    """
    theta = np.asarray(logits, np.float64)
    largest = theta.max(-1, keepdims=True)
    if not np.all(np.isfinite(largest)):
        raise ValueError(
            "the logits of a state hold NaN or +inf, or are all -inf, so they give no distribution: "
            "give at least one finite number for each state, and nothing above it"
        )
    weights = np.exp(theta - largest)
    return weights / weights.sum(-1, keepdims=True)


def score_table(logits: Float[Array | np.ndarray, "... O A"]) -> Float[np.ndarray, "... O A A"]:
    """The scores: entry `[o, a, b]` is ∂ log π(a | o) / ∂ θ[o, b]."""
    policy = softmax_policy(logits)
    return np.eye(policy.shape[-1]) - policy[..., None, :]


def expected_scores(
    logits: Float[Array | np.ndarray, "... O A"], values: Float[Array | np.ndarray, "... O A"]
) -> Float[np.ndarray, "... O A"]:
    """Σ_a ∇π(a | o) x(o, a), which lies in row o: π(b | o) (x(o, b) - E_{a ~ π}[x(o, a)]) in column b."""
    policy, table = softmax_policy(logits), np.asarray(values, np.float64)
    return policy * (table - (policy * table).sum(-1, keepdims=True))


def gradient_samples(
    logits: Float[Array | np.ndarray, "... O A"],
    trajectories: Trajectories,
    weights: Float[Array | np.ndarray, "N T"] | None = None,
) -> Float[np.ndarray, "N ..."]:
    """g(τ) = Σ_t Ψ_t ∇ log π(a_t | o_t) of each trajectory: `[N, *logits.shape]`. Steps that are padding add nothing.

    Without `weights` they are 1: the score of the whole trajectory. Raises `ValueError` for logits that vary with
    time over another horizon, and where the result would be too large.
    """
    policy = softmax_policy(logits)
    actions, taken = np.asarray(trajectories.actions), np.asarray(trajectories.taken)
    weights = np.where(taken, 1.0 if weights is None else np.asarray(weights, np.float64), 0.0)
    rows, flat = _rows(policy, trajectories), policy.reshape(-1, policy.shape[-1])
    found, every = _room(len(actions), flat.shape), np.arange(len(actions))
    for t in range(actions.shape[1]):
        # Each trajectory appears once per step, so adding by index loses nothing.
        found[every, rows[:, t]] -= weights[:, t, None] * flat[rows[:, t]]
        found[every, rows[:, t], actions[:, t]] += weights[:, t]
    return found.reshape(len(actions), *policy.shape)


def control_variate_samples(
    logits: Float[Array | np.ndarray, "... O A"],
    trajectories: Trajectories,
    weights: Float[Array | np.ndarray, "N T"],
    action_baseline: Float[Array | np.ndarray, "... O A"],
) -> Float[np.ndarray, "N ..."]:
    """Σ_t ∇ log π(a_t | o_t) (Ψ_t - b(o_t, a_t)) + ∇ E_{a ~ π(· | o_t)}[b(o_t, a)] of each trajectory (item 4.29).

    A baseline may depend on the action if what it takes away is put back exactly; any b, `[O, A]` or `[T, O, A]`, leaves the
    mean as it was (Gu et al. 2017, Q-Prop).
    """
    rows, taken = _rows(softmax_policy(logits), trajectories), np.asarray(trajectories.taken)
    count, steps = rows.shape
    seen, actions, every = np.asarray(trajectories.observations), np.asarray(trajectories.actions), np.arange(count)
    table = np.broadcast_to(np.asarray(action_baseline, np.float64), (steps, *logits.shape[-2:]))
    back = expected_scores(logits, table)
    weights = np.asarray(weights, np.float64) - table[np.arange(steps), seen[:, :-1], actions]
    found = gradient_samples(logits, trajectories, weights)
    by_row = found.reshape(count, -1, logits.shape[-1])
    for t in range(steps):
        by_row[every, rows[:, t]] += taken[:, t, None] * back[t, seen[:, t]]
    return found


def _rows(policy: np.ndarray, trajectories: Trajectories) -> np.ndarray:
    """Which row of the logits, counted through time if they vary with it, each step used: `[N, T]`."""
    steps = np.asarray(trajectories.actions).shape[1]
    seen = np.asarray(trajectories.observations)[:, :steps]
    if policy.ndim == 2:
        return seen
    if len(policy) != steps:
        raise ValueError(
            f"the logits vary over {len(policy)} steps and the trajectories have {steps}: give one table for each step"
        )
    return seen + np.arange(steps) * policy.shape[1]


def _room(number: int, shape: tuple[int, ...]) -> np.ndarray:
    if number * shape[0] * shape[1] > MOST_NUMBERS:
        raise ValueError(
            f"{number} trajectories with {shape[0]} x {shape[1]} logits have too many gradients to hold: "
            "use fewer trajectories or a smaller problem"
        )
    return np.zeros((number, *shape))
