r"""SAC: soft actor-critic (Haarnoja et al. 2018) with two critics, a squashed Gaussian and a learned temperature.

It maximises the sum of rewards and of alpha times the entropy of the policy (chapter 11 derives it):

    y     = r + gamma (1 - terminated) (min_e Q_phi_e'(s', a') - alpha log pi(a'|s')),     a' ~ pi(.|s')
    phi   down the mean of sum_e (Q_phi_e(s, a) - y)^2 / 2
    theta down the mean of alpha log pi(a|s) - min_e Q_phi_e(s, a),    a = tanh(m(s) + sd(s) eps), eps ~ N(0, 1)
    alpha: log alpha down the mean of -log alpha (log pi(a|s) + H),    H the entropy that is asked for

Actions, densities and entropies are in units of the box (-1 to 1 in each entry), so that H = -1 for each entry means the same whatever the
bounds. Without exploring it acts by tanh(m(s)). Networks with a memory learn from sequences.

Deviations from the paper: log alpha itself is in the temperature's loss (as in the authors' code), so that it moves by ratios; targets
of several steps (`n_step`) count the entropy of the last step only.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ..core import (
    Action,
    Batch,
    Carry,
    EnvSpec,
    Learner,
    Number,
    Observation,
    Policy,
    PRNGKey,
    Spec,
    number,
    part,
    setting,
)
from ..nn import MLP, Network, Optimiser, RunningNorm, as_network
from ..nn.optimise import towards
from ..ops.axes import over
from ..ops.distributions import TanhGaussian
from .continuous import Memories, Sample, fit_critics, require_short
from .critics import Actor, Critics, from_units, least, require_box

LEAST_LOG_STD, MOST_LOG_STD = -10.0, 2.0
"""The logarithm of the standard deviation, before squashing, is clipped to these."""


def law_of(outputs: Float[Array, "..."]) -> TanhGaussian:
    """The law of one action in units of the box, from an actor's two outputs for each entry."""
    return TanhGaussian(outputs[0], jnp.clip(outputs[1], LEAST_LOG_STD, MOST_LOG_STD), -1.0, 1.0)  # type: ignore[arg-type]


class SACState(eqx.Module):
    """Actor, critics and their targets, the logarithm of the temperature, three optimisers, what observations look like, and the number
    of updates done.
    """

    actor: Actor
    critics: Critics
    target_critics: Critics
    log_temperature: Float[Array, ""]
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    temperature_optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]
    spec: Spec = eqx.field(static=True)


class SquashedPolicy(Policy):
    """Samples from the squashed Gaussian to explore, otherwise takes its squashed mean."""

    actor: Actor
    critics: Critics
    norm: RunningNorm | None
    spec: Spec = eqx.field(static=True)
    explore: bool = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return Memories(self.actor.init(), self.critics.init())

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        observation = observation if self.norm is None else self.norm(observation)
        memory, outputs = self.actor(carry.actor, observation)
        law = law_of(outputs)
        units = law.sample(key) if self.explore else law.mode()
        carry = Memories(memory, self.critics.remember(carry.critics, observation))
        return carry, from_units(self.spec, units), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        observation = observation if self.norm is None else self.norm(observation)
        law = law_of(self.actor(carry.actor, observation)[1])
        value = least(self.critics(self.critics.see(carry.critics, observation), law.mode()))
        return {
            "value": value,
            "mean": from_units(self.spec, law.mode()),
            "std": jnp.exp(law.log_std),
            "entropy": law.entropy(),
        }


class SAC(Learner):
    """Soft actor-critic. Actions in a box; any observation; networks with or without a memory."""

    network: Network = part(MLP(256, 256, activation="relu"), "recipe of actor and critics", converter=as_network)
    learning_rate: Number = number(3e-4, "Adam's step size for the critics", above=0)
    actor_learning_rate: Number = number(3e-4, "Adam's step size for the actor", above=0)
    temperature_learning_rate: Number = number(3e-4, "Adam's step size for the temperature", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    target_rate: Number = number(0.005, "tau: how far the targets move towards the critics", above=0, at_most=1)
    critics: int = setting(2, "critics, the least of which counts", at_least=1)
    temperature: Number = number(1.0, "alpha, the weight of the entropy; where it is learned, its start", above=0)
    learn_temperature: bool = setting(True, "move the temperature so that the entropy becomes what is asked for")
    entropy_per_entry: Number = number(-1.0, "the entropy that is asked for, in nats for each entry of the action")
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

    def init(self, spec: EnvSpec, key: PRNGKey) -> SACState:
        require_box("SAC", spec)
        actor_key, critic_key = jax.random.split(key)
        actor = Actor.of(self.network, spec, actor_key, number=2)
        critics = Critics.of(self.network, spec, critic_key, self.critics)
        log_temperature = jnp.log(jnp.asarray(self.at(0).temperature, jnp.float32))
        rule = Optimiser(0.0, 1.0)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        optimisers = rule.init(actor), rule.init(critics), rule.init(log_temperature)
        return SACState(
            actor, critics, critics, log_temperature, *optimisers, norm, jnp.zeros((), jnp.int32), spec.action
        )

    def policy(self, state: SACState, explore: bool) -> SquashedPolicy:
        return SquashedPolicy(state.actor, state.critics, state.norm, state.spec, explore)

    def update(
        self, state: SACState, batch: Batch, key: PRNGKey
    ) -> tuple[SACState, dict[str, Array], Float[Array, "N"]]:
        now = self.at(state.updates)
        target_key, actor_key = jax.random.split(key)
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        sample = Sample.of(batch, state.spec, norm, now.gamma, self.n_step)
        learned = jnp.exp(state.log_temperature)
        alpha = learned if self.learn_temperature else jnp.asarray(now.temperature, jnp.float32)
        following, log_prob = draw(state.actor.along(sample.memory.actor, sample.t)[1], sample.axes, target_key)
        seen = state.target_critics.see_along(sample.memory.critics, sample.t)[1]
        soft = least(state.target_critics(seen, following)) - alpha * log_prob
        y = sample.t.reward + sample.discount * soft
        fit = fit_critics(state.critics, state.critic_optimiser, now._rule(now.learning_rate), sample, y)
        actor, actor_optimiser, found = now._improve(state, fit.critics, sample, alpha, actor_key)
        log_temperature, temperature_optimiser = state.log_temperature, state.temperature_optimiser
        if self.learn_temperature:
            # d/d log alpha of -log alpha (log pi + H) is the entropy that there is too much.
            surplus = found["entropy"] - now.entropy_per_entry * state.spec.size
            rule = now._rule(now.temperature_learning_rate)
            log_temperature, temperature_optimiser = rule.step(log_temperature, surplus, temperature_optimiser)
        state = SACState(
            actor,
            fit.critics,
            towards(state.target_critics, fit.critics, now.target_rate),
            log_temperature,
            actor_optimiser,
            fit.optimiser,
            temperature_optimiser,
            norm,
            state.updates + 1,
            state.spec,
        )
        return state, fit.metrics | found | {"temperature": alpha}, fit.errors

    def _improve(
        self, state: SACState, critics: Critics, sample: Sample, alpha: Float[Array, ""], key: PRNGKey
    ) -> tuple[Actor, optax.OptState, dict[str, Array]]:
        """One step of the actor."""
        seen, _ = critics.see_along(sample.memory.critics, sample.t)

        def loss(actor: Actor) -> tuple[Array, Array]:
            units, log_prob = draw(actor.along(sample.memory.actor, sample.t)[0], sample.axes, key)
            return (alpha * log_prob - least(critics(seen, units))).mean(), -log_prob.mean()

        (value, entropy), gradient = jax.value_and_grad(loss, has_aux=True)(state.actor)
        rule = self._rule(self.actor_learning_rate)
        actor, optimiser = rule.step(state.actor, gradient, state.actor_optimiser)
        return actor, optimiser, {"actor_loss": value, "entropy": entropy}

    def _rule(self, rate: Number) -> Optimiser:
        return Optimiser(rate, self.max_grad_norm)


def draw(outputs: Float[Array, "..."], axes: int, key: PRNGKey) -> tuple[Float[Array, "..."], Float[Array, "*N"]]:
    """An action in units and its log-probability for each of many outputs of an actor, differentiable in these."""
    keys = jax.random.split(key, outputs.shape[:axes])
    return over(axes, lambda outputs, key: law_of(outputs).sample_and_log_prob(key))(outputs, keys)
