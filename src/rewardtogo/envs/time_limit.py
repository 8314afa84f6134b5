"""A limit on an episode's length, which truncates and never terminates (erratum E1.5), and a horizon, which terminates and is seen."""

from typing import cast

import equinox as eqx
import gymnasium.spaces as spaces
import jax.numpy as jnp
import numpy as np
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


class FiniteHorizon(Environment):
    """`env` as a task of `max_steps` steps: the last one terminates, and the observation says how much time has passed, from 0 to 1.

    Where time runs out for good, the state without it is not Markov; with it the task is an episodic one, and gamma = 1 makes sense (Pardo
    et al. 2018, "time-aware" agents). The share of time is appended to a vector of floats.
    """

    env: Environment
    max_steps: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if self.max_steps < 1:
            raise ValueError(f"a horizon must be at least 1 step, not {self.max_steps}")
        space = self.env.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
            raise ValueError(
                f"FiniteHorizon adds the time to a vector of floats, and this environment observes {space}"
            )

    @property
    def observation_space(self) -> spaces.Box:
        space = cast(spaces.Box, self.env.observation_space)
        low, high = np.append(space.low, 0.0), np.append(space.high, 1.0)
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def _timed(self, observation: Observation, elapsed: Int[Array, ""]) -> Array:
        return jnp.append(jnp.asarray(observation), elapsed / self.max_steps)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        inner, observation = self.env.reset(key)
        elapsed = jnp.zeros((), jnp.int32)
        return TimeLimitState(inner, elapsed), self._timed(observation, elapsed)

    def step(self, state: TimeLimitState, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        inner, timestep = self.env.step(state.inner, action, key)
        elapsed = state.elapsed + 1
        terminated = timestep.terminated | (elapsed >= self.max_steps)
        observation = self._timed(timestep.observation, elapsed)
        # A cut of the environment's own at the last step is the end as well.
        truncated = timestep.truncated & ~terminated
        return TimeLimitState(inner, elapsed), Timestep(
            observation, timestep.reward, terminated, truncated, observation, timestep.extras
        )
