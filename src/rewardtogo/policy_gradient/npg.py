"""NPG: the natural policy gradient (chapters 3.9.1 and 7.2.4; Kakade 2001), by conjugate gradients.

One step from each rollout, along x = (F + xi I)^-1 g with g the policy gradient and F the Fisher matrix,

    theta <- theta + sqrt(2 eps / x'(F + xi I)x) x        (`step_by="kl"`: the KL of the step is eps, to second order), or
    theta <- theta + alpha x                              (`step_by="rate"`: the update of 3.9.1).

Errata E3.12 and E7.9 concern the step size. Advantages are from GAE; V is fitted to A + V by a few epochs of Adam (`natural`).

Deviations: advantages are normalised over the rollout (which only rescales alpha), F is damped by xi I. Nothing checks a step after it
was taken, as TRPO does: `kl` in the metrics says how large it was.
"""

from collections.abc import Callable
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import Number, number, setting
from ..ops.distributions import Distribution
from .fisher import NaturalGradient, mean_kl, step_size
from .natural import Natural, Vector


class NPG(Natural):
    """Natural policy gradient. Any action space but dictionaries; any observation; networks with or without a memory."""

    step_by: Literal["kl", "rate"] = setting(
        "kl", "what sets the length of a step: its KL divergence, or a learning rate", choices=("kl", "rate")
    )
    kl_step: Number = number(0.01, "eps: KL divergence of a step, with step_by=kl", above=0)
    learning_rate: Number = number(0.05, "alpha: what multiplies the direction, with step_by=rate", above=0)

    def _step(
        self,
        theta: Vector,
        natural: NaturalGradient,
        laws: Callable[[Vector], Distribution],
        objective: Callable[[Distribution], Float[Array, ""]],
    ) -> tuple[Vector, dict[str, Array]]:
        del objective
        by_kl = self.step_by == "kl"
        size = step_size(natural.curvature, self.kl_step) if by_kl else jnp.asarray(self.learning_rate, theta.dtype)
        moved = theta + size * natural.direction
        return moved, {"kl": mean_kl(laws(theta), laws(moved)), "step_size": size}
