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
import optax
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..core import EnvSpec, Learner, Number, PRNGKey, Rollout, number, part, require_action, setting
from ..nn import (
    ACTION_KINDS,
    MLP,
    ActorCritic,
    ActorCriticPolicy,
    Network,
    Optimiser,
    RunningNorm,
    as_network,
    global_norm,
    require_fresh,
)
from ..ops.metrics import explained_variance
from .fisher import mean_kl, natural_gradient, step_size
from .fit import action_laws, actor_parameters, critic, fit_values, mean_entropy, samples_of, surrogate, thin


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


class TRPOState(eqx.Module):
    """Networks, the value function's optimiser, what observations look like, and the number of updates done."""

    network: ActorCritic
    optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class TRPO(Learner):
    """Trust region policy optimisation. Any action space but dictionaries; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64), "recipe of the actor's and of the critic's network", converter=as_network)
    target_kl: Number = number(0.01, "eps: greatest mean KL divergence of a step", above=0)
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
    shrink: Number = number(0.8, "what a step that fails is multiplied by", above=0, below=1)
    line_search_steps: int = setting(10, "lengths that are tried before the step is given up", at_least=1)
    kl_direction: Literal["old_new", "new_old"] = setting(
        "old_new", "KL(old || new), or KL(new || old)", choices=("old_new", "new_old")
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

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    def init(self, spec: EnvSpec, key: PRNGKey) -> TRPOState:
        require_action("TRPO", spec, self.action_kinds)
        network = ActorCritic.of(self.network, spec, key, log_std=self.at(0).log_std)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        return TRPOState(network, self._optimiser().init(critic(network)), norm, jnp.zeros((), jnp.int32))

    def policy(self, state: TRPOState, explore: bool) -> ActorCriticPolicy:
        return ActorCriticPolicy(state.network, state.norm, explore, state.updates)

    def update(self, state: TRPOState, batch: Rollout, key: PRNGKey) -> tuple[TRPOState, dict[str, Array], tuple[()]]:
        require_fresh(batch.transitions, state.updates, "TRPO")
        now = self.at(state.updates)
        samples = samples_of(
            state.network, state.norm, batch, now.gamma, now.gae_lambda, self.normalise_advantages, self.bptt
        )
        few = thin(samples, batch.transitions.reward.shape[1], self.fisher_every)
        theta, network_of = actor_parameters(state.network)
        old = action_laws(state.network, samples)
        natural = natural_gradient(
            lambda theta: surrogate(action_laws(network_of(theta), samples), samples, now.entropy_cost),
            lambda theta: action_laws(network_of(theta), few),
            theta,
            now.damping,
            self.cg_iterations,
        )

        def evaluate(theta: Float[Array, "P"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
            new = action_laws(network_of(theta), samples)
            pair = (old, new) if self.kl_direction == "old_new" else (new, old)
            return surrogate(new, samples, now.entropy_cost), mean_kl(*pair)

        step = step_size(natural.curvature, now.target_kl) * natural.direction
        search = line_search(
            evaluate, theta, step, natural.objective, now.target_kl, now.shrink, self.line_search_steps
        )
        network, optimiser, value_loss = fit_values(
            network_of(search.parameters),
            state.optimiser,
            now._optimiser(),
            samples,
            key,
            self.value_epochs,
            self.minibatches,
        )
        # Statistics change after the update, so that the ratio starts at exactly 1.
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        metrics = {
            "kl": search.kl,
            "improvement": search.improvement,
            "step_fraction": search.fraction,
            "line_search_steps": search.tries.astype(theta.dtype),
            "accepted": search.accepted.astype(theta.dtype),
            "entropy": mean_entropy(old),
            "grad_norm": global_norm(natural.gradient),
            "value_loss": value_loss,
            "explained_variance": explained_variance(samples.value, samples.target),
        }
        return TRPOState(network, optimiser, norm, state.updates + 1), metrics, ()

    def _optimiser(self) -> Optimiser:
        return Optimiser(self.value_learning_rate, self.max_grad_norm)
