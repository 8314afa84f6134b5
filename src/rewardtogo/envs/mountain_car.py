"""Mountain car (Moore 1990): a car too weak for the hill in front of it must first back up the one behind.

v' = v + u - 0.0025 cos 3x and x' = x + v', both clipped, with an inelastic wall on the left. Constants and order of
operations are those of Gymnasium's MountainCar-v0 (three pushes, -1 a step) and MountainCarContinuous-v0 (a force; +100
at the goal, less what the force costs).
"""

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core import Action, Observation, Observed, PRNGKey, State, Timestep

MIN_POSITION = -1.2
MAX_POSITION = 0.6
MAX_SPEED = 0.07
GRAVITY = 0.0025
PUSH = 0.001
GOAL = 0.5
POWER = 0.0015
CONTINUOUS_GOAL = 0.45
GOAL_REWARD = 100.0
FORCE_COST = 0.1


class MountainCar(Observed):
    """State and observation: position and velocity. Actions: 0 push left, 1 nothing, 2 push right."""

    @property
    def observation_space(self) -> spaces.Box:
        return _box()

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(3)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state = _start(key)
        return state, state

    def state_of(self, observation: Observation) -> State:
        return jnp.asarray(observation)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        state = drive(state, (jnp.asarray(action, state.dtype) - 1.0) * PUSH)
        terminated = (state[0] >= GOAL) & (state[1] >= 0.0)
        reward = -jnp.ones((), state.dtype)
        return state, Timestep(state, reward, terminated, jnp.zeros((), bool), state, {})


class MountainCarContinuous(Observed):
    """State and observation: position and velocity. Action: a force in [-1, 1].

    A force outside is clipped and yet costs what was asked for, as in Gymnasium.
    """

    @property
    def observation_space(self) -> spaces.Box:
        return _box()

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state = _start(key)
        return state, state

    def state_of(self, observation: Observation) -> State:
        return jnp.asarray(observation)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        force = jnp.asarray(action, state.dtype)[0]
        state = drive(state, jnp.clip(force, -1.0, 1.0) * POWER)
        terminated = (state[0] >= CONTINUOUS_GOAL) & (state[1] >= 0.0)
        reward = GOAL_REWARD * terminated.astype(state.dtype) - FORCE_COST * force**2
        return state, Timestep(state, reward, terminated, jnp.zeros((), bool), state, {})


def drive(state: Float[Array, "2"], push: Float[Array, ""]) -> Float[Array, "2"]:
    """One step of the car under a push."""
    position, velocity = state
    velocity = jnp.clip(velocity + push - GRAVITY * jnp.cos(3 * position), -MAX_SPEED, MAX_SPEED)
    position = jnp.clip(position + velocity, MIN_POSITION, MAX_POSITION)
    velocity = jnp.where((position <= MIN_POSITION) & (velocity < 0.0), 0.0, velocity)
    return jnp.stack([position, velocity])


def _box() -> spaces.Box:
    low = np.array([MIN_POSITION, -MAX_SPEED], np.float32)
    return spaces.Box(low, np.array([MAX_POSITION, MAX_SPEED], np.float32), dtype=np.float32)


def _start(key: PRNGKey) -> Float[Array, "2"]:
    position = jax.random.uniform(key, minval=-0.6, maxval=-0.4)
    return jnp.stack([position, jnp.zeros_like(position)])
