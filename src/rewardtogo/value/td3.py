r"""TD3: twin delayed deterministic policy gradient (Fujimoto et al. 2018): DDPG with three mends against over-estimation.

    y     = r + gamma (1 - terminated) min_e Q_phi_e'(s', a'),   a' = clip(mu_theta'(s') + clip(eps, -c, c), -1, 1),  eps ~ N(0, sd^2)
    phi   down the mean of sum_e (Q_phi_e(s, a) - y)^2 / 2
    theta up the mean of Q_phi_1(s, mu_theta(s)), and all targets along, every `policy_delay` updates

The least of two critics is too low rather than too high; the noise on the target's action keeps the actor from sitting on a narrow peak
of an erring critic; the delay lets the critics settle. With one critic, no smoothing and a delay of 1 it is DDPG (a test). It acts by
mu_theta(s) with Gaussian or Ornstein-Uhlenbeck noise; networks with a memory learn from sequences.

Deviations from the paper: the noise's units are half the width of the box. A random policy fills the replay at first, as in the paper.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

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
from .critics import Actor, Critics, least, require_box
from .noise import Gaussian, Noise, Noisy, as_noise


class TD3(Learner):
    """Twin delayed deterministic policy gradient. Actions in a box; any observation; networks with or without a memory."""

    network: Network = part(MLP(256, 256, activation="relu"), "recipe of actor and critics", converter=as_network)
    learning_rate: Number = number(1e-3, "Adam's step size for the critics", above=0)
    actor_learning_rate: Number = number(1e-3, "Adam's step size for the actor", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    target_rate: Number = number(0.005, "tau: how far the targets move towards the networks", above=0, at_most=1)
    critics: int = setting(2, "critics, the least of which makes the targets", at_least=1)
    policy_delay: int = setting(2, "updates of the critics for one of the actor and of all targets", at_least=1)
    smoothing: Number = number(0.2, "sd of the noise on the target's action, in units of half the box", at_least=0)
    smoothing_limit: Number = number(0.5, "this noise is clipped here", at_least=0)
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
        require_box("TD3", spec)
        return DeterministicState.of(self.network, self.critics, self.normalise_observations, spec, key)

    def policy(self, state: DeterministicState, explore: bool) -> Policy:
        policy = GreedyActor(state.actor, state.critics, state.norm, state.spec)
        return Noisy.of(policy, self.at(state.updates).noise, state.spec) if explore else policy

    def update(
        self, state: DeterministicState, batch: Batch, key: PRNGKey
    ) -> tuple[DeterministicState, dict[str, Array], Float[Array, "N"]]:
        now = self.at(state.updates)
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        sample = Sample.of(batch, state.spec, norm, now.gamma, self.n_step)
        chosen = deterministic(state.target_actor.along(sample.memory.actor, sample.t)[1], sample.axes)
        noise = now.smoothing * jax.random.normal(key, chosen.shape)
        smoothed = jnp.clip(chosen + jnp.clip(noise, -now.smoothing_limit, now.smoothing_limit), -1.0, 1.0)
        seen = state.target_critics.see_along(sample.memory.critics, sample.t)[1]
        y = sample.t.reward + sample.discount * least(state.target_critics(seen, smoothed))
        fit = fit_critics(state.critics, state.critic_optimiser, now._rule(now.learning_rate), sample, y)
        updates = state.updates + 1
        due = updates % self.policy_delay == 0
        actor, optimiser = now._improve(state, fit.critics, sample, due)
        rate = jnp.where(due, now.target_rate, 0.0)
        state = DeterministicState(
            actor,
            fit.critics,
            towards(state.target_actor, actor, rate),
            towards(state.target_critics, fit.critics, rate),
            optimiser,
            fit.optimiser,
            norm,
            updates,
            state.spec,
        )
        return state, fit.metrics | {"saturation": jnp.abs(chosen).mean()}, fit.errors

    def _improve(
        self, state: DeterministicState, critics: Critics, sample: Sample, due: Bool[Array, ""]
    ) -> tuple[Actor, optax.OptState]:
        """The actor and its optimiser after its step, where one is due."""
        rule = self._rule(self.actor_learning_rate)

        def step(old: tuple[Actor, optax.OptState]) -> tuple[Actor, optax.OptState]:
            actor, optimiser, _ = improve_actor(old[0], critics, old[1], rule, sample)
            return actor, optimiser

        # Only what changes goes through the condition: what goes through is copied.
        old = state.actor, state.actor_optimiser
        return step(old) if self.policy_delay == 1 else jax.lax.cond(due, step, lambda old: old, old)

    def _rule(self, rate: Number) -> Optimiser:
        return Optimiser(rate, self.max_grad_norm)
