"""A limit on an episode's length, which truncates and never terminates (erratum E1.5)."""

import equinox as eqx
import gymnasium.spaces as spaces
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep


class TimeLimitState(eqx.Module):
    """The environment's state and the number of steps taken in this episode."""

    inner: State
    elapsed: Int[Array, ""]


class TimeLimit(Environment):
    """`env`, truncated after `max_steps` steps."""

    env: Environment
    max_steps: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if self.max_steps < 1:
            raise ValueError(f"a time limit must be at least 1 step, not {self.max_steps}")

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        inner, observation = self.env.reset(key)
        return TimeLimitState(inner, jnp.zeros((), jnp.int32)), observation

    def step(self, state: TimeLimitState, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        inner, timestep = self.env.step(state.inner, action, key)
        elapsed = state.elapsed + 1
        truncated = timestep.truncated | (elapsed >= self.max_steps)
        return TimeLimitState(inner, elapsed), eqx.tree_at(lambda t: t.truncated, timestep, truncated)
