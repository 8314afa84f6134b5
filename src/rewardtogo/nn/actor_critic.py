"""A stochastic policy and a value function in one module, with memories or without, and how they act."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core import Action, Carry, EnvSpec, Observation, Policy, PRNGKey, Rollout
from ..ops.distributions import Categorical, DiagGaussian, Distribution
from .encoding import RunningNorm, action_mask
from .heads import ActionHead
from .network import Linear, Network, Torso
from .recurrent import is_recurrent, unroll


class ActorCritic(eqx.Module):
    """Two torsos (Fig 4.1: two networks are simple and stable), an action head, a value head, and what observations look like.

    The memory is a pair, the actor's and the critic's.
    """

    actor: Torso
    head: ActionHead
    critic: Torso
    value_head: Linear

    @staticmethod
    def of(network: Network, spec: EnvSpec, key: PRNGKey) -> "ActorCritic":
        """Fresh parameters."""
        actor_key, head_key, critic_key, value_key = jax.random.split(key, 4)
        actor, critic = network.build(spec.observation, actor_key), network.build(spec.observation, critic_key)
        return ActorCritic(
            actor,
            ActionHead.of(actor.features, spec.action, head_key),
            critic,
            Linear.of(critic.features, 1, value_key, gain=1.0),
        )

    def init(self) -> Carry:
        """Both memories at the start of an episode."""
        return (self.actor.init(), self.critic.init())

    def act(self, carry: Carry, observation: Observation) -> tuple[Carry, Distribution]:
        """The actor's memory after the observation, and the distribution of the action."""
        carry, features = self.actor(carry, observation)
        return carry, self.head(features, action_mask(observation))

    def value(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, ""]]:
        """The critic's memory after the observation, and the value."""
        carry, features = self.critic(carry, observation)
        return carry, self.value_head(features)[0]

    @property
    def recurrent(self) -> bool:
        """Whether either network has a memory."""
        return is_recurrent(self.actor) or is_recurrent(self.critic)

    def values(self, rollout: Rollout, norm: Callable[[Observation], Observation]) -> tuple[Array, Array]:
        """V of every observation and of every `next_observation` of a rollout, both `[T, B]`.

        With a memory, V(next_observation) starts from the memory before any reset, so that the value of a truncated episode's last
        observation still knows the episode.
        """
        t = rollout.transitions

        def one(
            carry: Carry, observation: Observation, following: Observation, done: Bool[Array, "T"]
        ) -> tuple[Array, Array]:
            observation, following = jax.vmap(norm)(observation), jax.vmap(norm)(following)
            carries, features = unroll(self.critic, carry, observation, done)
            _, next_features = jax.vmap(lambda c, o: self.critic(c, o))(carries, following)
            read = jax.vmap(lambda x: self.value_head(x)[0])
            return read(features), read(next_features)

        if not self.recurrent:
            flat = lambda o: jax.vmap(jax.vmap(lambda x: self.value((), norm(x))[1]))(o)  # noqa: E731
            return flat(t.observation), flat(t.next_observation)
        return jax.vmap(one, in_axes=(0, 1, 1, 1), out_axes=1)(
            rollout.carry[1], t.observation, t.next_observation, t.done
        )

    def evaluate(
        self, carry: Carry, observation: Observation, action: Action, done: Bool[Array, "..."]
    ) -> tuple[Array, Array, Array]:
        """Log pi(a|s), entropy and value of one step; with a memory, of one environment's sequence `[T]`, from the memory before
        its first step and reset after each end.
        """
        if not self.recurrent:
            distribution, value = (
                self.act(self.actor.init(), observation)[1],
                self.value(self.critic.init(), observation)[1],
            )
            return distribution.log_prob(action), distribution.entropy(), value

        def one(
            actor_features: Array, critic_features: Array, mask: Array | None, action: Action
        ) -> tuple[Array, Array, Array]:
            distribution = self.head(actor_features, mask)
            return distribution.log_prob(action), distribution.entropy(), self.value_head(critic_features)[0]

        _, actor_features = unroll(self.actor, carry[0], observation, done)
        _, critic_features = unroll(self.critic, carry[1], observation, done)
        return jax.vmap(one)(actor_features, critic_features, action_mask(observation), action)


class ActorCriticPolicy(Policy):
    """Acts with an `ActorCritic`: samples to explore, otherwise takes the mode. Keeps the action's `log_prob`."""

    network: ActorCritic
    norm: RunningNorm | None
    explore: bool = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return self.network.init()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        observation = observation if self.norm is None else self.norm(observation)
        actor, distribution = self.network.act(carry[0], observation)
        # A critic without a memory has nothing to do here: learners evaluate it on the whole rollout at once.
        critic = self.network.critic(carry[1], observation)[0] if is_recurrent(self.network.critic) else carry[1]
        if self.explore:
            action, log_prob = distribution.sample_and_log_prob(key)
        else:
            action = distribution.mode()
            log_prob = distribution.log_prob(action)
        return (actor, critic), action, {"log_prob": log_prob}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        observation = observation if self.norm is None else self.norm(observation)
        _, distribution = self.network.act(carry[0], observation)
        _, value = self.network.value(carry[1], observation)
        thoughts = {"value": value, "entropy": distribution.entropy()}
        if isinstance(distribution, Categorical):
            thoughts["probabilities"] = distribution.probs
        if isinstance(distribution, DiagGaussian):
            thoughts |= {"mean": distribution.mean, "std": jnp.exp(distribution.log_std)}
        return thoughts
