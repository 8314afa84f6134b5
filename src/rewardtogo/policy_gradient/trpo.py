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

from ..core import Number, number, part, setting
from ..nn import MLP, Network, as_network
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

    network: Network = part(MLP(64, 64), "recipe of the actor's and of the critic's network", converter=as_network)
    target_kl: Number = number(0.01, "eps: greatest mean KL divergence of a step", above=0)
    shrink: Number = number(0.8, "what a step that fails is multiplied by", above=0, below=1)
    line_search_steps: int = setting(10, "lengths that are tried before the step is given up", at_least=1)
    kl_direction: Literal["old_new", "new_old"] = setting(
        "old_new", "KL(old || new), or KL(new || old)", choices=("old_new", "new_old")
    )
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
