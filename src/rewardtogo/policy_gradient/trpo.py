"""TRPO: trust region policy optimisation (chapter 7; Schulman et al. 2015).

One step from each rollout of pi,

    max over theta' of E[pi'(a|s) / pi(a|s) A(s, a)]    subject to    E[KL(pi || pi')] <= eps:

the direction x = (F + xi I)^-1 g by conjugate gradients, the length sqrt(2 eps / x'(F + xi I)x) (erratum E7.9), then a backtracking
line search that shortens the step until the KL, no longer its quadratic, is at most eps and the surrogate is larger than before. Where
no try succeeds the policy stays as it is, to the bit. Advantages are from GAE; V is fitted to A + V by a few epochs of Adam.

The notes say "TRPO (PPO)" (erratum E3.13): they are two algorithms, see `ppo` and `npg`. The bound of the notes has KL(pi' || pi), the
paper and its implementations KL(pi || pi'), which needs no samples of pi' (E7.6): `kl_direction`.

Deviations from the paper, as is now usual: GAE for Monte-Carlo returns, normalised advantages, the Fisher matrix damped and from all
samples unless `fisher_every` says otherwise, the step shortened by 0.8 a try. With `normalise_observations` the statistics also move
between two rollouts, which no constraint sees.
"""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..core import Number, number, setting
from ..ops.distributions import Distribution
from .fisher import NaturalGradient, mean_kl, step_size
from .natural import Natural, Vector


class Search(eqx.Module):
    """How a line search ended: what was taken, and how much of the step; 0 everywhere where nothing was."""

    parameters: Float[Array, "P"]
    fraction: Float[Array, ""]
    improvement: Float[Array, ""]
    kl: Float[Array, ""]
    tries: Int[Array, ""]
    accepted: Bool[Array, ""]


def line_search(
    evaluate: Callable[[Float[Array, "P"]], tuple[Float[Array, ""], Float[Array, ""]]],
    parameters: Float[Array, "P"],
    step: Float[Array, "P"],
    objective: Float[Array, ""],
    kl: ScalarLike,
    shrink: ScalarLike,
    tries: int,
) -> Search:
    """The first of parameters + shrink^k step, k = 0 .. tries - 1, whose KL is at most `kl` and whose objective has grown.

    `evaluate` gives the objective and the KL at some parameters; `objective` is that of `parameters`. A NaN is no success.
    """

    def attempt(search: Search) -> Search:
        fraction = jnp.power(jnp.asarray(shrink, step.dtype), search.tries.astype(step.dtype))
        candidate = parameters + fraction * step
        value, divergence = evaluate(candidate)
        gain = value - objective
        accepted = (gain > 0) & (divergence <= kl)
        # The very numbers that were tried, or the very ones from before.
        taken, fraction, gain, divergence = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old),
            (candidate, fraction, gain, divergence),
            (parameters, zero, zero, zero),
        )
        return Search(taken, fraction, gain, divergence, search.tries + 1, accepted)

    zero = jnp.zeros((), parameters.dtype)
    start = Search(parameters, zero, zero, zero, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    return jax.lax.while_loop(lambda search: ~search.accepted & (search.tries < tries), attempt, start)


class TRPO(Natural):
    """Trust region policy optimisation. Any action space but dictionaries; any observation; networks with or without a memory."""

    target_kl: Number = number(0.01, "eps: greatest mean KL divergence of a step", above=0)
    shrink: Number = number(0.8, "what a step that fails is multiplied by", above=0, below=1)
    line_search_steps: int = setting(10, "lengths that are tried before the step is given up", at_least=1)
    kl_direction: Literal["old_new", "new_old"] = setting(
        "old_new", "KL(old || new), or KL(new || old)", choices=("old_new", "new_old")
    )

    def _step(
        self,
        theta: Vector,
        natural: NaturalGradient,
        laws: Callable[[Vector], Distribution],
        objective: Callable[[Distribution], Float[Array, ""]],
    ) -> tuple[Vector, dict[str, Array]]:
        old = laws(theta)

        def evaluate(theta: Vector) -> tuple[Float[Array, ""], Float[Array, ""]]:
            new = laws(theta)
            pair = (old, new) if self.kl_direction == "old_new" else (new, old)
            return objective(new), mean_kl(*pair)

        step = step_size(natural.curvature, self.target_kl) * natural.direction
        search = line_search(
            evaluate, theta, step, natural.objective, self.target_kl, self.shrink, self.line_search_steps
        )
        return search.parameters, {
            "kl": search.kl,
            "improvement": search.improvement,
            "step_fraction": search.fraction,
            "line_search_steps": search.tries.astype(theta.dtype),
            "accepted": search.accepted.astype(theta.dtype),
        }
