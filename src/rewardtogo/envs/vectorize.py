"""B copies of a pure environment side by side, with automatic reset that keeps the true final observation."""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from ..core import Action, Environment, Observation, State, Timestep, VectorEnv


class Vectorized(VectorEnv):
    """`env`, B times. Where an episode ends, the next one begins in the same step: see `core.Timestep`."""

    env: Environment
    size: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if self.size < 1:
            raise ValueError(f"there must be at least one environment, not {self.size}")

    @property
    def num_envs(self) -> int:
        return self.size

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, keys: Key[Array, "B"]) -> tuple[State, Observation]:
        return jax.vmap(lambda key: self.env.reset(key))(keys)

    def step(self, state: State, action: Action, keys: Key[Array, "B"]) -> tuple[State, Timestep]:
        def one(state: State, action: Action, key: Key[Array, ""]) -> tuple[State, Timestep]:
            step_key, reset_key = jax.random.split(key)
            state, timestep = self.env.step(state, action, step_key)
            fresh_state, fresh_observation = self.env.reset(reset_key)
            choose = lambda new, old: jnp.where(timestep.done, new, old)  # noqa: E731
            state = jax.tree.map(choose, fresh_state, state)
            observation = jax.tree.map(choose, fresh_observation, timestep.observation)
            return state, eqx.tree_at(lambda t: t.observation, timestep, observation)

        return jax.vmap(one)(state, action, keys)


def vectorize(env: Environment, num_envs: int) -> Vectorized:
    """`num_envs` copies of a pure environment as one `VectorEnv`."""
    return Vectorized(env, num_envs)
