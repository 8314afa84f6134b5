"""A stochastic policy and a value function in one module, with memories or without, and how they act."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..core import Action, Carry, EnvSpec, Observation, Policy, PRNGKey, Rollout, Transition
from ..ops.distributions import Categorical, DiagGaussian, Distribution
from .encoding import RunningNorm, action_mask
from .heads import ActionHead
from .network import Linear, Network, Torso
from .recurrent import is_recurrent, unroll

VERSION = "version"
"""Name, in `Transition.extras`, of the number of updates behind the parameters that chose an action."""


class ActorCritic(eqx.Module):
    """A policy and a value function: two torsos (notes 4.7: two networks are simple and stable), or one that both read.

    With a shared torso `critic` is None, and the torso learns from both losses, unless `detached`: then the value function reads
    features that it does not shape. The memory is a pair, the actor's and the critic's; a shared torso has the actor's only.
    """

    actor: Torso
    head: ActionHead
    critic: Torso | None
    value_head: Linear
    detached: bool = eqx.field(static=True, default=False)

    @staticmethod
    def of(
        network: Network,
        spec: EnvSpec,
        key: PRNGKey,
        *,
        shared: bool = False,
        detached: bool = False,
        log_std: ScalarLike = 0.0,
    ) -> "ActorCritic":
        """Fresh parameters. `log_std` is that of a Gaussian policy in units of half the box."""
        actor_key, head_key, critic_key, value_key = jax.random.split(key, 4)
        actor = network.build(spec.observation, actor_key)
        critic = None if shared else network.build(spec.observation, critic_key)
        return ActorCritic(
            actor,
            ActionHead.of(actor.features, spec.action, head_key, log_std=log_std),
            critic,
            Linear.of(actor.features, 1, value_key, gain=1.0),
            detached,
        )

    def init(self) -> Carry:
        """Both memories at the start of an episode."""
        return (self.actor.init(), () if self.critic is None else self.critic.init())

    def act(self, carry: Carry, observation: Observation) -> tuple[Carry, Distribution]:
        """The actor's memory after the observation, and the distribution of the action."""
        carry, features = self.actor(carry, observation)
        return carry, self.head(features, action_mask(observation))

    def value(self, carry: Carry, observation: Observation) -> Float[Array, ""]:
        """The value of an observation, from both memories before it."""
        torso, carry = self._critic(carry)
        return self.value_head(torso(carry, observation)[1])[0]

    def remember(self, carry: Carry, observation: Observation) -> Carry:
        """The critic's memory after an observation, from its memory before."""
        # A critic without a memory has nothing to do while acting: learners evaluate it on the whole rollout at once.
        return self.critic(carry, observation)[0] if self.critic is not None and is_recurrent(self.critic) else carry

    def _critic(self, carry: Carry) -> tuple[Torso, Carry]:
        """The torso that values are read from, and its memory."""
        return (self.actor, carry[0]) if self.critic is None else (self.critic, carry[1])

    @property
    def recurrent(self) -> bool:
        """Whether either network has a memory."""
        return is_recurrent(self.actor) or (self.critic is not None and is_recurrent(self.critic))

    def values(self, rollout: Rollout, norm: Callable[[Observation], Observation]) -> tuple[Array, Array]:
        """V of every observation and of every `next_observation` of a rollout, both `[T, B]`.

        With a memory, V(next_observation) starts from the memory before any reset, so that the value of a truncated episode's last
        observation still knows the episode.
        """
        t = rollout.transitions

        def one(
            carry: Carry, observation: Observation, following: Observation, done: Bool[Array, "T"]
        ) -> tuple[Array, Array]:
            torso, carry = self._critic(carry)
            observation, following = jax.vmap(norm)(observation), jax.vmap(norm)(following)
            carries, features = unroll(torso, carry, observation, done)
            _, next_features = jax.vmap(lambda c, o: torso(c, o))(carries, following)
            read = jax.vmap(lambda x: self.value_head(x)[0])
            return read(features), read(next_features)

        if not self.recurrent:
            flat = lambda o: jax.vmap(jax.vmap(lambda x: self.value(self.init(), norm(x))))(o)  # noqa: E731
            return flat(t.observation), flat(t.next_observation)
        return jax.vmap(one, in_axes=(0, 1, 1, 1), out_axes=1)(rollout.carry, t.observation, t.next_observation, t.done)

    def carries(self, rollout: Rollout, norm: Callable[[Observation], Observation]) -> Carry:
        """Both memories before every step of a rollout, `[T, B]`: what acting had, found again from the first of them."""

        def one(torso: Torso, carry: Carry, observation: Observation, done: Bool[Array, "T"]) -> Carry:
            after, _ = unroll(torso, carry, jax.vmap(norm)(observation), done)
            following = lambda fresh, after: jnp.where(done[:-1, None], fresh, after[:-1])  # noqa: E731
            before = lambda first, fresh, after: jnp.concatenate([first[None], following(fresh, after)])  # noqa: E731
            return jax.tree.map(before, carry, torso.init(), after)

        def both(carry: Carry, observation: Observation, done: Bool[Array, "T"]) -> Carry:
            critic = () if self.critic is None else one(self.critic, carry[1], observation, done)
            return one(self.actor, carry[0], observation, done), critic

        t = rollout.transitions
        return jax.vmap(both, in_axes=(0, 1, 1), out_axes=1)(rollout.carry, t.observation, t.done)

    def evaluate(
        self, carry: Carry, observation: Observation, action: Action, done: Bool[Array, "..."]
    ) -> tuple[Array, Array, Array]:
        """Log pi(a|s), entropy and value of one step; with a memory, of one environment's sequence `[T]`, from the memory before
        its first step and reset after each end.
        """

        def read(
            actor_features: Array, critic_features: Array, mask: Array | None, action: Action
        ) -> tuple[Array, Array, Array]:
            distribution = self.head(actor_features, mask)
            return distribution.log_prob(action), distribution.entropy(), self.value_head(critic_features)[0]

        if self.recurrent:
            features = lambda torso, carry: unroll(torso, carry, observation, done)[1]  # noqa: E731
            read = jax.vmap(read)
        else:
            carry, features = self.init(), lambda torso, carry: torso(carry, observation)[1]
        actor_features = features(self.actor, carry[0])
        critic_features = actor_features if self.critic is None else features(self.critic, carry[1])
        if self.detached:
            critic_features = jax.lax.stop_gradient(critic_features)
        return read(actor_features, critic_features, action_mask(observation), action)


class ActorCriticPolicy(Policy):
    """Acts with an `ActorCritic`: samples to explore, otherwise takes the mode. Keeps the action's `log_prob`, and of the parameters
    that chose it the `version`: the number of updates behind them.
    """

    network: ActorCritic
    norm: RunningNorm | None
    explore: bool = eqx.field(static=True)
    version: Int[Array, ""] | None = None

    def init(self, key: PRNGKey) -> Carry:
        del key
        return self.network.init()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        observation = observation if self.norm is None else self.norm(observation)
        actor, distribution = self.network.act(carry[0], observation)
        critic = self.network.remember(carry[1], observation)
        if self.explore:
            action, log_prob = distribution.sample_and_log_prob(key)
        else:
            action = distribution.mode()
            log_prob = distribution.log_prob(action)
        version = {} if self.version is None else {VERSION: self.version}
        return (actor, critic), action, {"log_prob": log_prob} | version

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        observation = observation if self.norm is None else self.norm(observation)
        _, distribution = self.network.act(carry[0], observation)
        value = self.network.value(carry, observation)
        thoughts = {"value": value, "entropy": distribution.entropy()}
        if isinstance(distribution, Categorical):
            thoughts["probabilities"] = distribution.probs
        if isinstance(distribution, DiagGaussian):
            thoughts |= {"mean": distribution.mean, "std": jnp.exp(distribution.log_std)}
        return thoughts


def require_fresh(transitions: Transition, updates: Int[Array, ""], who: str) -> None:
    """Raise `ValueError` where actions were chosen by parameters older than those that are to learn from them (item 3.25).

    Inside a compiled program nothing can be raised; there `OnPolicy` makes every rollout fresh.
    """
    version = transitions.extras.get(VERSION)
    if version is None or isinstance(version, Tracer) or isinstance(updates, Tracer):
        return
    oldest = int(jnp.min(version))
    if oldest != int(updates):
        raise ValueError(
            f"{who} learns from its own fresh actions, and some of these were chosen {int(updates) - oldest} updates ago: "
            "collect again, or use a learner that corrects for it, such as offpolicy_pg"
        )
