"""The exact mean and variance of estimators of the policy gradient, by summing over every trajectory.

For g(τ) = Σ_t Ψ_t ∇ log π(a_t | s_t), one number for each logit j,

    E[g_j] = Σ_τ p(τ) g_j(τ),      Var[g_j] = E[g_j²] - E[g_j]²,      total variance = Σ_j Var[g_j].

- A baseline leaves the mean as it is, unless it is computed from the same batch: the average return of N trajectories
  shrinks it to (1 - 1/N) ∇J, leaving each trajectory out of its own average does not (erratum E3.5).
- The best baseline is one for each parameter, b_j = E[g_j² r] / E[g_j²]; the best single number is E[‖g‖² r] / E[‖g‖²]
  (erratum E3.6). Neither is the average return, nor V (erratum E4.13).
- Rewards to go need not have the lower variance (erratum E3.4).

Source: notes, sections 3.7, 4.1, 4.2 and 4.8.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..envs.tabular import MDP, POMDP
from ..ops.estimators import Estimator, Steps
from .observed import enumerate_observed
from .signals import total_returns
from .softmax import gradient_samples, softmax_policy
from .trajectories import Trajectories

MOST_BATCHES = 4_000_000
"""More batches than this and their enumeration is refused."""

CHUNK = 20_000
"""Batches taken at a time."""

Weights = Callable[[Trajectories], np.ndarray]
"""From trajectories to Ψ `[N, T]`, such as `rewards_to_go`."""


class Moments(eqx.Module):
    """Mean and variance of each entry of an estimator."""

    mean: Float[np.ndarray, "..."]
    variance: Float[np.ndarray, "..."]

    @property
    def total_variance(self) -> float:
        """The sum of all variances: the trace of the covariance matrix."""
        return float(self.variance.sum())


def moments(
    samples: Float[Array | np.ndarray, "N ..."], log_probs: Float[Array | np.ndarray, "N"] | None = None
) -> Moments:
    """Exact moments of `samples` that have the probabilities exp(`log_probs`).

    Without them, the sample mean and the unbiased sample variance of N independent draws (item 3.23).
    """
    values = np.asarray(samples, np.float64)
    if log_probs is None:
        return Moments(np.asarray(values.mean(0)), np.asarray(values.var(0, ddof=1)))
    chance = np.exp(np.asarray(log_probs, np.float64))
    mean = np.asarray(np.tensordot(chance, values, 1))
    return Moments(mean, np.asarray(np.tensordot(chance, (values - mean) ** 2, 1)))


def estimator_moments(
    problem: MDP | POMDP,
    logits: Float[Array | np.ndarray, "... O A"],
    weights: Weights,
    horizon: int | None = None,
    *,
    baseline: float | Float[np.ndarray, "..."] = 0.0,
    behaviour: Float[Array | np.ndarray, "... O A"] | None = None,
) -> Moments:
    """Moments of g(τ) = Σ_t Ψ_t ∇ log π(a_t | o_t) for one trajectory (item 3.23).

    - `weights`: gives Ψ, such as `rewards_to_go` or `lambda τ: rewards_to_go(τ) - values_at(τ, v)`.
    - `baseline`: subtracted from every Ψ_t: one number, or one for each logit.
    - `behaviour`: the table of the policy that acts, π_θ itself by default; `weights` must then hold the ratios.
    """
    every, log_probs = enumerate_observed(problem, softmax_policy(logits) if behaviour is None else behaviour, horizon)
    samples = gradient_samples(logits, every, weights(every)) - baseline * gradient_samples(logits, every)
    return moments(samples, log_probs)


def weights_of(estimator: Estimator, values: Float[Array | np.ndarray, "... S"] | None = None) -> Weights:
    """Ψ as a learner forms it: the exact moments of what `PolicyGradient(...).estimator` trains with.

    `values` is the table of V, `[S]` or `[T + 1, S]`, and 0 where it is left out. Raises `ValueError` for a baseline that is
    made of a batch, which has no meaning for one trajectory: see `batch_moments`.
    """
    if estimator.baseline not in ("none", "value"):
        raise ValueError(
            f"the {estimator.baseline} baseline depends on the other trajectories of a batch: use batch_moments with "
            "subtract_batch_mean or subtract_others_mean, or optimal_baselines"
        )

    def weights(trajectories: Trajectories) -> np.ndarray:
        reward, taken = np.asarray(trajectories.rewards), np.asarray(trajectories.taken)
        number, steps = reward.shape
        last = np.arange(steps)[None] == np.asarray(trajectories.lengths)[:, None] - 1
        terminated = last & np.asarray(trajectories.terminated)[:, None]
        cut = last & (np.asarray(trajectories.terminated) | np.asarray(trajectories.truncated))[:, None]
        table = np.zeros((steps + 1, 1)) if values is None else np.asarray(values, np.float64)
        states = np.zeros((number, steps + 1), int) if values is None else np.asarray(trajectories.observations)
        table = np.broadcast_to(table, (steps + 1, table.shape[-1]))
        value = table[np.arange(steps + 1), states]
        rows = lambda x: jnp.asarray(x.T)  # noqa: E731
        seen = Steps(
            rows(reward),
            rows(float(estimator.gamma) * (1.0 - terminated)),
            rows(cut),
            rows(value[:, :-1]),
            rows(value[:, 1:]),
            rows(np.ones_like(reward)),
            jnp.zeros(number, jnp.int32),
        )
        return np.where(taken, np.asarray(estimator.weights(seen)).T, 0.0)

    return weights


def step_moments(
    problem: MDP | POMDP,
    logits: Float[Array | np.ndarray, "... O A"],
    weights: Weights,
    horizon: int | None = None,
) -> Moments:
    """Moments of each single term Ψ_t ∇ log π(a_t | o_t), with the time as first axis: `[T, ...]` (item 4.1)."""
    every, log_probs = enumerate_observed(problem, softmax_policy(logits), horizon)
    given = np.asarray(weights(every))
    single = [np.where(np.arange(given.shape[1]) == t, given, 0.0) for t in range(given.shape[1])]
    found = [moments(gradient_samples(logits, every, psi), log_probs) for psi in single]
    return Moments(np.stack([m.mean for m in found]), np.stack([m.variance for m in found]))


def subtract_batch_mean(signal: Float[np.ndarray, "... N T"]) -> Float[np.ndarray, "... N T"]:
    """x_i - (1/N) Σ_j x_j: the average of the same batch as a baseline (items 3.20 and 4.2)."""
    return signal - signal.mean(-2, keepdims=True)


def subtract_others_mean(signal: Float[np.ndarray, "... N T"]) -> Float[np.ndarray, "... N T"]:
    """x_i - (1/(N-1)) Σ_{j≠i} x_j: the leave-one-out baseline (item 3.21).

    Raises `ValueError` for a single trajectory, which has no others.
    """
    size = signal.shape[-2]
    if size < 2:
        raise ValueError("one trajectory has no others to be compared with: give a batch of at least 2")
    return subtract_batch_mean(signal) * (size / (size - 1))


def batch_moments(
    problem: MDP | POMDP,
    logits: Float[Array | np.ndarray, "... O A"],
    weights: Weights,
    size: int,
    horizon: int | None = None,
    *,
    compare: Callable[[np.ndarray], np.ndarray] = subtract_batch_mean,
) -> Moments:
    """Moments of (1/N) Σ_i Σ_t Ψ_it ∇ log π(a_it | o_it) where Ψ depends on the whole batch of N = `size` trajectories.

    Every batch is summed over. `weights` gives x `[M, T]` of single trajectories, and `compare` makes Ψ of the x of
    batches, `[K, N, T]` to `[K, N, T]`. Raises `ValueError` where there are too many batches.
    """
    every, log_probs = enumerate_observed(problem, softmax_policy(logits), horizon)
    count = len(log_probs)
    if size < 1 or count**size > MOST_BATCHES:
        raise ValueError(
            f"there are {count}^{size} batches of {size} trajectories and between 1 and {MOST_BATCHES} can be listed: "
            "use a smaller batch, a smaller problem or a shorter horizon"
        )
    signal, scores = np.asarray(weights(every), np.float64), _scores_by_step(logits, every)
    shape = scores.shape[2:]
    total, square = np.zeros(shape), np.zeros(shape)
    for start in range(0, count**size, CHUNK):
        batch = np.stack(np.unravel_index(np.arange(start, min(start + CHUNK, count**size)), (count,) * size), -1)
        psi, chance = compare(signal[batch]), np.exp(log_probs[batch].sum(-1))
        # One member at a time keeps the scores of a chunk small.
        found = sum(np.einsum("kt,kt...->k...", psi[:, i], scores[batch[:, i]]) for i in range(size)) / size
        total, square = total + np.tensordot(chance, found, 1), square + np.tensordot(chance, found**2, 1)
    return Moments(total, square - total**2)


def _scores_by_step(logits: Array | np.ndarray, every: Trajectories) -> np.ndarray:
    """∇ log π(a_t | o_t) `[M, T, ...]`."""
    steps = np.arange(every.rewards.shape[-1])
    only = [np.broadcast_to((steps == t).astype(np.float64), every.rewards.shape) for t in steps]
    return np.stack([gradient_samples(logits, every, one) for one in only], 1)


def optimal_baselines(
    problem: MDP | POMDP,
    logits: Float[Array | np.ndarray, "... O A"],
    horizon: int | None = None,
    *,
    weights: Weights = total_returns,
) -> tuple[Float[np.ndarray, "..."], float]:
    """The baselines of least variance: one for each logit, E[g² r] / E[g²], and the one number E[‖g‖² r] / E[‖g‖²].

    Here g is the score of the whole trajectory and r = R(τ), its return (item 3.24). Logits that are never used get 0.
    They are exact; estimated from the batch they are used on they would bias it, as any such baseline. Raises
    `ValueError` for `weights` that differ from step to step, for which r would not be one number.
    """
    every, log_probs = enumerate_observed(problem, softmax_policy(logits), horizon)
    given = np.asarray(weights(every), np.float64)
    if not np.all((given == given[:, :1]) | ~np.asarray(every.taken)):
        raise ValueError(
            "these weights differ between the steps of a trajectory, and the optimal baseline is one for the weight of "
            "a whole trajectory: give such as total_returns"
        )
    squares = gradient_samples(logits, every) ** 2
    mass = np.tensordot(np.exp(log_probs), squares, 1)
    weighted = np.tensordot(np.exp(log_probs) * given[:, 0], squares, 1)
    each = np.divide(weighted, mass, out=np.zeros_like(mass), where=mass > 0)
    return each, float(weighted.sum() / mass.sum()) if mass.sum() > 0 else 0.0
