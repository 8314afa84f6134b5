r"""The cross-entropy method over sequences of actions, continuous and discrete, and its soft relative MPPI (notes 8.2.2, Algorithm 15).

    repeat   A_1 .. A_N ~ p(A),  J(A_i),  elites = the M best,  refit p to the elites by maximum likelihood

- Continuous actions: p is a Gaussian with a mean and a deviation for every entry, samples clipped to the bounds; maximum likelihood is mean
  and deviation (with ddof 0) of the elites.
- Discrete actions: p is a categorical for every step; maximum likelihood is the elites' frequencies.
- MPPI (Williams et al. 2017) weighs all samples by exp(-(J - min J) / temperature) in place of cutting at the M best.

The notes' loop has no end and no result (erratum E8.10). Here it ends (i) after `iterations`, or (ii) once the largest deviation (for
discrete
actions: the largest chance of anything but the favourite) is below `tolerance`; the result is the best sequence seen, or the final mean.

What practice adds (item 8.17): `smoothing` keeps a share of the old parameters, `floor` keeps deviations (or chances) from collapsing
before the mean has arrived, bounds clip, and a warm start goes on from an earlier plan.

Source: notes 8.2.2; Rubinstein 1999; de Boer et al. 2005.
"""

from abc import abstractmethod
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..core import Action, PRNGKey, Solution, State
from .flat import check_dynamics, require_finite
from .problem import CONVERGED, MAX_ITERS, Problem
from .shooting import mean_costs, sampled_plan


class Law(eqx.Module):
    """A distribution over sequences of actions that can be sampled and refitted."""

    @abstractmethod
    def sample(self, problem: Problem, key: PRNGKey, number: int) -> Action:
        """`number` sequences `[N, H, *U]`."""

    @abstractmethod
    def refit(self, sequences: Action, weights: Float[Array, "N"], keep: Array, floor: Array) -> "Law":
        """By weighted maximum likelihood (weights sum to 1), keeping a share `keep` of the old parameters."""

    @abstractmethod
    def spread(self) -> Float[Array, ""]:
        """How far it still is from a single sequence."""

    @abstractmethod
    def centre(self, problem: Problem) -> Action:
        """Its most likely sequence."""


class GaussianLaw(Law):
    """Independent normal entries: mean and deviation `[H, *U]`."""

    mean: Float[Array, "H *U"]
    sd: Float[Array, "H *U"]

    def sample(self, problem: Problem, key: PRNGKey, number: int) -> Action:
        noise = jax.random.normal(key, (number, *self.mean.shape), self.mean.dtype)
        return problem.action.clip(self.mean[None] + self.sd[None] * noise)

    def refit(self, sequences: Action, weights: Float[Array, "N"], keep: Array, floor: Array) -> "GaussianLaw":
        mean = jnp.tensordot(weights, sequences, 1)
        sd = jnp.sqrt(jnp.tensordot(weights, (sequences - mean[None]) ** 2, 1))
        mix = lambda old, new: keep * old + (1.0 - keep) * new  # noqa: E731
        return GaussianLaw(mix(self.mean, mean), jnp.maximum(mix(self.sd, sd), floor))

    def spread(self) -> Float[Array, ""]:
        return self.sd.max()

    def centre(self, problem: Problem) -> Action:
        return problem.action.clip(self.mean)


class CategoricalLaw(Law):
    """Independent choices: probabilities `[H, *U, A]`. Where entries have different numbers of choices, what is no choice has probability
    0.
    """

    probabilities: Float[Array, "H *U A"]

    def sample(self, problem: Problem, key: PRNGKey, number: int) -> Action:
        shape = (number, *self.probabilities.shape[:-1])
        return jax.random.categorical(key, jnp.log(self.probabilities), shape=shape).astype(jnp.int32)

    def refit(self, sequences: Action, weights: Float[Array, "N"], keep: Array, floor: Array) -> "CategoricalLaw":
        chosen = jax.nn.one_hot(sequences, self.probabilities.shape[-1])
        mixed = keep * self.probabilities + (1.0 - keep) * jnp.tensordot(weights, chosen, 1)
        possible = self.probabilities > 0
        raised = jnp.where(possible, jnp.maximum(mixed, floor), 0.0)
        return CategoricalLaw(raised / raised.sum(-1, keepdims=True))

    def spread(self) -> Float[Array, ""]:
        return 1.0 - self.probabilities.max(-1).min()

    def centre(self, problem: Problem) -> Action:
        return jnp.argmax(self.probabilities, -1).astype(jnp.int32)


def first_law(problem: Problem, guess: Any = None, sd: Any = None) -> Law:
    """Where the search begins: uniform over discrete actions; a Gaussian around `guess` (the middle of the box, or 0) with deviation `sd`
    (half the box, or 1).
    """
    spec, horizon = problem.action, problem.horizon
    if spec.kind == "box":
        low, high = spec.bounds()
        bounded = np.isfinite(low) & np.isfinite(high)
        # Without bounds the standard normal, which is what -1 and 1 give here.
        low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
        middle, half = (low + high) / 2, (high - low) / 2
        shape = (horizon, *spec.shape)
        mean = jnp.broadcast_to(middle, shape) if guess is None else jnp.asarray(guess)
        if mean.shape != shape:
            raise ValueError(f"the first guess has shape {mean.shape}, and {shape} actions are wanted")
        spread = jnp.broadcast_to(jnp.asarray(half if sd is None else sd), shape)
        return GaussianLaw(mean.astype(spec.dtype), spread.astype(spec.dtype))
    if spec.kind in ("discrete", "multi_discrete", "multi_binary"):
        counts = np.full(spec.shape, 2) if spec.kind == "multi_binary" else np.asarray(spec.counts).reshape(spec.shape)
        possible = np.arange(counts.max())[(None,) * counts.ndim] < counts[..., None]
        table = np.broadcast_to(possible / counts[..., None], (horizon, *possible.shape))
        law = CategoricalLaw(jnp.asarray(table, jnp.float32))
        if guess is None:
            return law
        # Half certain of the earlier plan.
        chosen = jax.nn.one_hot(jnp.asarray(guess), table.shape[-1])
        return CategoricalLaw(0.5 * law.probabilities + 0.5 * chosen)
    raise ValueError(f"the cross-entropy method draws box or discrete actions, and these are a {spec.kind}")


class Generation(eqx.Module):
    """Where the search stands: the law, the best sequence so far, and the history."""

    law: Law
    best: Action
    least: Float[Array, ""]
    iteration: Int[Array, ""]
    settled: Bool[Array, ""]
    costs: Float[Array, "I"]
    spreads: Float[Array, "I"]


@partial(jax.jit, static_argnames=("samples", "elites", "iterations", "particles"))
def _search(
    problem: Problem,
    state: State,
    law: Law,
    key: PRNGKey,
    samples: int,
    elites: int | None,
    iterations: int,
    particles: int,
    temperature: Array,
    keep: Array,
    floor: Array,
    tolerance: Array,
) -> Generation:
    """`elites` None weighs by the temperature."""
    draw_key, noise_key = jax.random.split(key)

    def generation(g: Generation) -> Generation:
        sequences = g.law.sample(problem, jax.random.fold_in(draw_key, g.iteration), samples)
        costs = mean_costs(problem, state, sequences, noise_key, particles)
        costs = jnp.where(jnp.isnan(costs), jnp.inf, costs)
        if elites is None:
            chosen, weights = sequences, jax.nn.softmax(-(costs - costs.min()) / temperature)
            first = jnp.argmin(costs)
        else:
            _, places = jax.lax.top_k(-costs, elites)
            chosen = jax.tree.map(lambda x: x[places], sequences)
            weights, first = jnp.full(elites, 1.0 / elites), places[0]
        better = costs[first] < g.least
        law = g.law.refit(chosen, weights, keep, floor)
        return Generation(
            law,
            jnp.where(better, sequences[first], g.best),
            jnp.where(better, costs[first], g.least),
            g.iteration + 1,
            law.spread() < tolerance,
            g.costs.at[g.iteration].set(costs[first]),
            g.spreads.at[g.iteration].set(law.spread()),
        )

    history = jnp.full(iterations, jnp.nan)
    centre = law.centre(problem)
    cost = jax.eval_shape(lambda: mean_costs(problem, state, centre[None], noise_key, particles))
    infinite = jnp.asarray(jnp.inf, cost.dtype)
    start = Generation(law, centre, infinite, jnp.zeros((), jnp.int32), jnp.zeros((), bool), history, history)
    going = lambda g: (g.iteration < iterations) & ~g.settled  # noqa: E731
    return jax.lax.while_loop(going, generation, start)


def cem(
    problem: Problem,
    state: Any,
    key: PRNGKey,
    *,
    samples: int = 500,
    elites: int = 50,
    iterations: int = 10,
    guess: Any = None,
    sd: Any = None,
    smoothing: ScalarLike = 0.0,
    floor: ScalarLike = 0.0,
    tolerance: ScalarLike = 1e-3,
    particles: int = 1,
    result: Literal["best", "mean"] = "best",
) -> Solution:
    """The cross-entropy method (Algorithm 15), for boxes and for discrete actions (item 8.12).

    - `guess`, `sd`: centre and deviation of the first Gaussian, `[H, *U]` or what broadcasts to it.
    - `smoothing`: share of the old parameters that stays, [0, 1). `floor`: least deviation, or least probability of a choice.
    - `tolerance`: stops once the largest deviation (discrete: the largest chance of another choice) is below it; 0 never does.
    - `particles`: samples of random dynamics that a candidate's cost is the mean of, the same ones for all candidates.
    - `result`: the best sequence that was seen, or the centre of the last law.

    `stats`: `iterations`, `evaluations` (samples times iterations), `reason`, `costs` and `spreads` `[iterations]` (NaN after the end),
    and `law`. Raises
    `ValueError` where there are not fewer elites than samples, for no iteration, and where nothing costs a finite number.
    """
    if not 1 <= elites < samples:
        raise ValueError(
            f"CEM chooses its elites among the samples, and {elites} of {samples} is no choice: give 1 <= elites < samples"
        )
    return _cross_entropy(
        problem, state, key, samples, elites, iterations, guess, sd, 1.0, smoothing, floor, tolerance, particles, result
    )


def mppi(
    problem: Problem,
    state: Any,
    key: PRNGKey,
    *,
    samples: int = 500,
    temperature: ScalarLike = 1.0,
    iterations: int = 5,
    guess: Any = None,
    sd: Any = None,
    smoothing: ScalarLike = 0.0,
    floor: ScalarLike = 0.1,
    particles: int = 1,
    result: Literal["best", "mean"] = "mean",
) -> Solution:
    """Model predictive path integral control: the law is refitted to all samples, weighed by exp(-J / temperature).

    `temperature`: in units of cost; towards 0 only the best sample counts. The rest, `stats` and errors are those of `cem`.
    """
    if samples < 2:
        raise ValueError(f"MPPI needs at least two samples, not {samples}")
    if not isinstance(temperature, Tracer) and not np.all(np.asarray(temperature) > 0):
        raise ValueError(f"the temperature must be more than 0, not {temperature}")
    return _cross_entropy(
        problem, state, key, samples, None, iterations, guess, sd, temperature, smoothing, floor, 0.0, particles, result
    )


def _cross_entropy(
    problem: Problem,
    state: State,
    key: PRNGKey,
    samples: int,
    elites: int | None,
    iterations: int,
    guess: Any,
    sd: Any,
    temperature: ScalarLike,
    smoothing: ScalarLike,
    floor: ScalarLike,
    tolerance: ScalarLike,
    particles: int,
    result: str,
) -> Solution:
    if iterations < 1 or particles < 1:
        raise ValueError(f"there must be at least one iteration and one particle, not {iterations} and {particles}")
    if result not in ("best", "mean"):
        raise ValueError(f"the result is the 'best' sequence or the 'mean', not {result!r}")
    check_dynamics(problem, state)
    law = first_law(problem, guess, sd)
    numbers = (jnp.asarray(x, jnp.float32) for x in (temperature, smoothing, floor, tolerance))
    found = _search(problem, state, law, key, samples, elites, iterations, particles, *numbers)
    require_finite(found.least, "every sequence that was tried")
    actions = found.best if result == "best" else found.law.centre(problem)
    noise_key = jax.random.split(key)[1]
    stats = {
        "iterations": found.iteration,
        "evaluations": found.iteration * samples,
        "reason": jnp.where(found.settled, CONVERGED, MAX_ITERS),
        "costs": found.costs,
        "spreads": found.spreads,
        "law": found.law,
    }
    return Solution(sampled_plan(problem, state, actions, noise_key, particles), found.settled, stats)
