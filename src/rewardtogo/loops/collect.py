"""Acting: B environments and one policy, step by step, inside one compiled program."""

import equinox as eqx
import jax
import jax.numpy as jnp

from ..core import (
    Actor,
    Carry,
    EnvSpec,
    Episodes,
    EpisodeStats,
    Observation,
    Policy,
    PRNGKey,
    Rollout,
    State,
    Transition,
    VectorEnv,
    env_spec,
)
from .devices import shard


class RandomPolicy(Policy):
    """Uniformly random actions: warm-up, baselines, data without a prejudice."""

    spec: EnvSpec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(
        self, carry: Carry, observation: Observation, key: PRNGKey
    ) -> tuple[Carry, jax.Array, dict[str, jax.Array]]:
        if isinstance(observation, dict) and "action_mask" in observation:
            logits = jnp.where(observation["action_mask"] > 0, 0.0, -jnp.inf)
            return carry, jax.random.categorical(key, logits).astype(jnp.int32), {}
        return carry, self.spec.action.sample(key), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, jax.Array]:
        del carry, observation
        return {}


def begin(env: VectorEnv, policy: Policy, key: PRNGKey) -> Actor:
    """Reset the environments and the policy's memory."""
    env_key, carry_key = jax.random.split(key)
    env_state, observation = env.reset(jax.random.split(env_key, env.num_envs))
    carry = fresh_carry(policy, carry_key, env.num_envs)
    zeros = jnp.zeros(env.num_envs)
    return shard(Actor(env_state, observation, carry, EpisodeStats(zeros, zeros)))


def fresh_carry(policy: Policy, key: PRNGKey, num_envs: int) -> Carry:
    """The policy's memory at the start of an episode, for each of B environments."""
    return jax.vmap(lambda key: policy.init(key))(jax.random.split(key, num_envs))


def reset_where(done: jax.Array, fresh: State, old: State) -> State:
    """`fresh` in the rows where `done`, `old` elsewhere."""
    return jax.tree.map(
        lambda new, old: jnp.where(done.reshape(done.shape + (1,) * (old.ndim - done.ndim)), new, old), fresh, old
    )


def collect(
    env: VectorEnv, policy: Policy, actor: Actor, key: PRNGKey, length: int, keep_carry: bool = False
) -> tuple[Actor, Rollout, Episodes]:
    """Take `length` steps in each of B environments.

    Returns where the environments stand now, the rollout `[length, B]` with the policy's memory before its first step, and the
    episodes that ended meanwhile. With `keep_carry` the memory before every step is kept
    too, as `extras["carry"]`. Memories are reset where an episode ends; actions are clipped into the action space on their way
    to the environment and stored as the policy sampled them.
    """
    action_spec, actor = env_spec(env).action, shard(actor)
    num_envs, first_carry = env.num_envs, actor.carry
    carry_key, act_key, env_key = jax.random.split(key, 3)
    # Keys are split before the loop: splitting inside costs a hash a step.
    act_keys = jax.random.split(act_key, (length, num_envs))
    env_keys = jax.random.split(env_key, (length, num_envs))
    fresh = fresh_carry(policy, carry_key, num_envs)

    def step(
        loop: tuple[Actor, Episodes], keys: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[Actor, Episodes], Transition]:
        actor, episodes = loop
        carry, action, extras = jax.vmap(lambda c, o, k: policy(c, o, k))(actor.carry, actor.observation, keys[0])
        env_state, timestep = env.step(actor.env_state, jax.vmap(action_spec.clip)(action), keys[1])
        done = timestep.done
        total = actor.stats.return_so_far + timestep.score
        steps = actor.stats.length_so_far + 1.0
        extras = {**extras, "carry": actor.carry} if keep_carry else extras
        ended = done.astype(jnp.float32)
        episodes = episodes + Episodes((total * ended).sum(), (steps * ended).sum(), ended.sum())
        stats = EpisodeStats(total * (1.0 - ended), steps * (1.0 - ended))
        transition = Transition(
            actor.observation,
            action,
            timestep.reward,
            timestep.terminated,
            timestep.truncated,
            timestep.final_observation,
            extras,
        )
        actor = Actor(env_state, timestep.observation, reset_where(done, fresh, carry), stats)
        return (actor, episodes), transition

    (actor, episodes), transitions = jax.lax.scan(step, (actor, Episodes.none()), (act_keys, env_keys))
    return shard(actor), Rollout(shard(transitions, axis=1), first_carry), episodes
