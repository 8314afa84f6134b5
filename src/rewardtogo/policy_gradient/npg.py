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

from ..core import Number, number, part, setting
from ..nn import MLP, Network, as_network
from ..ops.distributions import Distribution
from .fisher import NaturalGradient, mean_kl, step_size
from .natural import Natural, Vector


class NPG(Natural):
    """Natural policy gradient. Any action space but dictionaries; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64), "recipe of the actor's and of the critic's network", converter=as_network)
    step_by: Literal["kl", "rate"] = setting(
        "kl", "what sets the length of a step: its KL divergence, or a learning rate", choices=("kl", "rate")
    )
    kl_step: Number = number(0.01, "eps: KL divergence of a step, with step_by=kl", above=0)
    learning_rate: Number = number(0.05, "alpha: what multiplies the direction, with step_by=rate", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    gae_lambda: Number = number(
        0.95, "weight of long returns in GAE: 0 is the TD error, 1 is Monte Carlo", at_least=0, at_most=1
    )
    entropy_cost: Number = number(0.0, "c_H: weight of an entropy bonus in the surrogate", at_least=0)
    damping: Number = number(0.1, "xi: multiple of the identity added to the Fisher matrix", at_least=0)
    cg_iterations: int = setting(10, "iterations of conjugate gradients", at_least=1)
    fisher_every: int = setting(
        1,
        "1 estimates the Fisher matrix from all samples, k from every k-th time step, with a memory sequence",
        at_least=1,
    )
    value_learning_rate: Number = number(1e-3, "Adam's step size for the value function", above=0)
    value_epochs: int = setting(10, "passes of the value regression over each rollout", at_least=1)
    minibatches: int = setting(
        4, "steps of the regression a pass; with a memory each takes whole sequences", at_least=1
    )
    bptt: int = setting(
        32, "steps that gradients flow back through a memory: rollouts are cut into such pieces", at_least=1
    )
    max_grad_norm: Number = number(10.0, "gradients of the value loss are scaled down to this norm", above=0)
    normalise_advantages: bool = setting(True, "mean 0, sd 1 over the rollout")
    log_std: Number = number(0.0, "log standard deviation that a Gaussian policy begins with, in units of half the box")
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

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
