"""NPG: the natural policy gradient (chapters 3.9.1 and 7.2.4; Kakade 2001), by conjugate gradients.

One step from each rollout, along x = (F + xi I)^-1 g with g the policy gradient and F the Fisher matrix,

    theta <- theta + sqrt(2 eps / x'(F + xi I)x) x        (`step_by="kl"`: the KL of the step is eps, to second order), or
    theta <- theta + alpha x                              (`step_by="rate"`: the update of 3.9.1).

Errata E3.12 and E7.9 concern the step size. Advantages are from GAE; V is fitted to A + V by a few epochs of Adam.

Deviations: advantages are normalised over the rollout (which only rescales alpha), F is damped by xi I. Nothing checks a step after it
was taken, as TRPO does: `kl` in the metrics says how large it was.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int

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


class NPGState(eqx.Module):
    """Networks, the value function's optimiser, what observations look like, and the number of updates done."""

    network: ActorCritic
    optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class NPG(Learner):
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
    entropy_cost: Number = number(0.0, "c_H: weight of an entropy bonus", at_least=0)
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

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    def init(self, spec: EnvSpec, key: PRNGKey) -> NPGState:
        require_action("NPG", spec, self.action_kinds)
        network = ActorCritic.of(self.network, spec, key, log_std=self.at(0).log_std)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        return NPGState(network, self._optimiser().init(critic(network)), norm, jnp.zeros((), jnp.int32))

    def policy(self, state: NPGState, explore: bool) -> ActorCriticPolicy:
        return ActorCriticPolicy(state.network, state.norm, explore, state.updates)

    def update(self, state: NPGState, batch: Rollout, key: PRNGKey) -> tuple[NPGState, dict[str, Array], tuple[()]]:
        require_fresh(batch.transitions, state.updates, "NPG")
        now = self.at(state.updates)
        samples = samples_of(
            state.network, state.norm, batch, now.gamma, now.gae_lambda, self.normalise_advantages, self.bptt
        )
        few = thin(samples, batch.transitions.reward.shape[1], self.fisher_every)
        theta, network_of = actor_parameters(state.network)
        natural = natural_gradient(
            lambda theta: surrogate(action_laws(network_of(theta), samples), samples, now.entropy_cost),
            lambda theta: action_laws(network_of(theta), few),
            theta,
            now.damping,
            self.cg_iterations,
        )
        by_kl = self.step_by == "kl"
        size = step_size(natural.curvature, now.kl_step) if by_kl else jnp.asarray(now.learning_rate, theta.dtype)
        moved = network_of(theta + size * natural.direction)
        old, new = action_laws(state.network, samples), action_laws(moved, samples)
        network, optimiser, value_loss = fit_values(
            moved, state.optimiser, now._optimiser(), samples, key, self.value_epochs, self.minibatches
        )
        # Statistics change after the update, so that the ratio starts at exactly 1.
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        metrics = {
            "kl": mean_kl(old, new),
            "step_size": size,
            "entropy": mean_entropy(old),
            "grad_norm": global_norm(natural.gradient),
            "value_loss": value_loss,
            "explained_variance": explained_variance(samples.value, samples.target),
        }
        return NPGState(network, optimiser, norm, state.updates + 1), metrics, ()

    def _optimiser(self) -> Optimiser:
        return Optimiser(self.value_learning_rate, self.max_grad_norm)
