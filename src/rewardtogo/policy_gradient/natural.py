"""What the methods of the natural gradient share: advantages and a Fisher matrix from each rollout, one step of the policy along
x = (F + xi I)^-1 g, and V fitted to A + V by a few epochs of Adam. NPG and TRPO differ in how far they go along x.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Literal, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

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
from ..ops.distributions import Distribution
from ..ops.metrics import explained_variance
from .fisher import NaturalGradient, natural_gradient
from .fit import action_laws, actor_parameters, critic, fit_values, mean_entropy, samples_of, surrogate, thin

Vector: TypeAlias = Float[Array, "P"]


class NaturalState(eqx.Module):
    """Networks, the value function's optimiser, what observations look like, and the number of updates done."""

    network: ActorCritic
    optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class Natural(Learner):
    """A learner that steps along the natural gradient; `_step` says how far."""

    network: Network = part(MLP(64, 64), "recipe of the actor's and of the critic's network", converter=as_network)
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

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    def init(self, spec: EnvSpec, key: PRNGKey) -> NaturalState:
        require_action(type(self).__name__, spec, self.action_kinds)
        network = ActorCritic.of(self.network, spec, key, log_std=self.at(0).log_std)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        return NaturalState(network, self._optimiser().init(critic(network)), norm, jnp.zeros((), jnp.int32))

    def policy(self, state: NaturalState, explore: bool) -> ActorCriticPolicy:
        return ActorCriticPolicy(state.network, state.norm, explore, state.updates)

    @abstractmethod
    def _step(
        self,
        theta: Vector,
        natural: NaturalGradient,
        laws: Callable[[Vector], Distribution],
        objective: Callable[[Distribution], Float[Array, ""]],
    ) -> tuple[Vector, dict[str, Array]]:
        """The parameters of the policy after the step, and what to report of it.

        `laws` are the distributions of the action at every sample, of any parameters; `objective` is their surrogate.
        """

    def update(
        self, state: NaturalState, batch: Rollout, key: PRNGKey
    ) -> tuple[NaturalState, dict[str, Array], tuple[()]]:
        require_fresh(batch.transitions, state.updates, type(self).__name__)
        now = self.at(state.updates)
        samples = samples_of(
            state.network, state.norm, batch, now.gamma, now.gae_lambda, self.normalise_advantages, self.bptt
        )
        few = thin(samples, batch.transitions.reward.shape[1], self.fisher_every)
        theta, network_of = actor_parameters(state.network)
        laws = lambda theta: action_laws(network_of(theta), samples)  # noqa: E731
        objective = lambda laws: surrogate(laws, samples, now.entropy_cost)  # noqa: E731
        natural = natural_gradient(
            lambda theta: objective(laws(theta)),
            lambda theta: action_laws(network_of(theta), few),
            theta,
            now.damping,
            self.cg_iterations,
        )
        moved, metrics = now._step(theta, natural, laws, objective)
        network, optimiser, value_loss = fit_values(
            network_of(moved), state.optimiser, now._optimiser(), samples, key, self.value_epochs, self.minibatches
        )
        # Statistics change after the update, so that the ratio starts at exactly 1.
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        metrics |= {
            "entropy": mean_entropy(action_laws(state.network, samples)),
            "grad_norm": global_norm(natural.gradient),
            "value_loss": value_loss,
            "explained_variance": explained_variance(samples.value, samples.target),
        }
        return NaturalState(network, optimiser, norm, state.updates + 1), metrics, ()

    def _optimiser(self) -> Optimiser:
        return Optimiser(self.value_learning_rate, self.max_grad_norm)
