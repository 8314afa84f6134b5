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

from ..core import EnvSpec, Learner, Number, PRNGKey, Rollout, require_action
from ..nn import (
    ACTION_KINDS,
    ActorCritic,
    ActorCriticPolicy,
    Network,
    Optimiser,
    RunningNorm,
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
    """A learner that steps along the natural gradient; `_step` says how far. What the fields are, each of them says itself."""

    network: eqx.AbstractVar[Network]
    gamma: eqx.AbstractVar[Number]
    gae_lambda: eqx.AbstractVar[Number]
    entropy_cost: eqx.AbstractVar[Number]
    damping: eqx.AbstractVar[Number]
    cg_iterations: eqx.AbstractVar[int]
    fisher_every: eqx.AbstractVar[int]
    value_learning_rate: eqx.AbstractVar[Number]
    value_epochs: eqx.AbstractVar[int]
    minibatches: eqx.AbstractVar[int]
    bptt: eqx.AbstractVar[int]
    max_grad_norm: eqx.AbstractVar[Number]
    normalise_advantages: eqx.AbstractVar[bool]
    log_std: eqx.AbstractVar[Number]
    normalise_observations: eqx.AbstractVar[bool]

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
