r"""DDPG: deep deterministic policy gradient (chapter 6, Algorithm 14; Lillicrap et al. 2016): DQN whose argmax over actions is learned.

    y     = r + gamma (1 - terminated) Q_phi'(s', mu_theta'(s'))
    phi   down the mean of (Q_phi(s, a) - y)^2 / 2
    theta up the mean of Q_phi(s, mu_theta(s)):   (dmu/dtheta)^T dQ/da, taken at a = mu_theta(s)
    phi' and theta' follow phi and theta by Polyak averaging

The text's target takes mu_theta(s'), Algorithm 14's mu_theta'(s') (erratum E6.6): the second is the paper's and the default, the first is
`target_policy = online`. It acts by mu_theta(s) with Gaussian or Ornstein-Uhlenbeck noise; networks with a memory learn from sequences.

Deviations from the paper: one step size for both networks, 1e-3; targets follow at 0.005; no weight decay and no batch normalisation
(`normalise_observations` standardises by running statistics); updates are means over the batch. A random policy fills the replay at first.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import Batch, EnvSpec, Learner, Number, Policy, PRNGKey, number, part, setting
from ..nn import MLP, Network, Optimiser, as_network
from ..nn.optimise import towards
from .continuous import (
    DeterministicState,
    GreedyActor,
    Sample,
    deterministic,
    fit_critics,
    improve_actor,
    require_short,
)
from .critics import require_box
from .noise import Gaussian, Noise, Noisy, as_noise


class DDPG(Learner):
    """Deep deterministic policy gradient. Actions in a box; any observation; networks with or without a memory."""

    network: Network = part(MLP(256, 256, activation="relu"), "recipe of actor and critic", converter=as_network)
    learning_rate: Number = number(1e-3, "Adam's step size for the critic", above=0)
    actor_learning_rate: Number = number(1e-3, "Adam's step size for the actor", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    target_rate: Number = number(0.005, "tau: how far the targets move towards the networks", above=0, at_most=1)
    target_policy: Literal["target", "online"] = setting(
        "target", "which actor chooses the next action in a target", choices=("target", "online")
    )
    noise: Noise = part(Gaussian(0.1), "noise on the actions while learning", converter=as_noise)
    n_step: int = setting(1, "rewards in a target; more come from sequences of at least as many steps", at_least=1)
    max_grad_norm: Number = number(1000.0, "gradients are scaled down to this global norm", above=0)
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    def __check_init__(self) -> None:
        require_short(self.network, self.n_step)

    @property
    def batch(self) -> Literal["transitions", "sequences"]:
        return "sequences" if self.network.has_memory or self.n_step > 1 else "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("box",)

    def init(self, spec: EnvSpec, key: PRNGKey) -> DeterministicState:
        require_box("DDPG", spec)
        return DeterministicState.of(self.network, 1, self.normalise_observations, spec, key)

    def policy(self, state: DeterministicState, explore: bool) -> Policy:
        policy = GreedyActor(state.actor, state.critics, state.norm, state.spec)
        return Noisy.of(policy, self.at(state.updates).noise, state.spec) if explore else policy

    def update(
        self, state: DeterministicState, batch: Batch, key: PRNGKey
    ) -> tuple[DeterministicState, dict[str, Array], Float[Array, "N"]]:
        del key
        now = self.at(state.updates)
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        sample = Sample.of(batch, state.spec, norm, now.gamma, self.n_step)
        chooser = state.target_actor if self.target_policy == "target" else state.actor
        following = deterministic(chooser.along(sample.memory.actor, sample.t)[1], sample.axes)
        seen = state.target_critics.see_along(sample.memory.critics, sample.t)[1]
        y = sample.t.reward + sample.discount * state.target_critics(seen, following)[0]
        fit = fit_critics(state.critics, state.critic_optimiser, now._rule(now.learning_rate), sample, y)
        actor, optimiser, loss = improve_actor(
            state.actor, fit.critics, state.actor_optimiser, now._rule(now.actor_learning_rate), sample
        )
        state = DeterministicState(
            actor,
            fit.critics,
            towards(state.target_actor, actor, now.target_rate),
            towards(state.target_critics, fit.critics, now.target_rate),
            optimiser,
            fit.optimiser,
            norm,
            state.updates + 1,
            state.spec,
        )
        return state, fit.metrics | {"actor_loss": loss, "saturation": jnp.abs(following).mean()}, fit.errors

    def _rule(self, rate: Number) -> Optimiser:
        return Optimiser(rate, self.max_grad_norm)
