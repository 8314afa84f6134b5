"""Mountain car (Moore 1990): a car too weak for the hill in front of it must first back up the one behind.

v' = v + u - 0.0025 cos 3x and x' = x + v', both clipped, with an inelastic wall on the left. Constants and order of
operations are those of Gymnasium's MountainCar-v0 (three pushes, -1 a step) and MountainCarContinuous-v0 (a force; +100
at the goal, less what the force costs).
"""

from collections.abc import Sequence

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..core import Action, Drawn, Observation, Observed, PRNGKey, State, Timestep
from .canvas import BLUE, GREEN, INK, MIST, STONE, Canvas

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


class MountainCar(Observed, Drawn):
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

    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """The flag is the goal."""
        del earlier
        return draw_hills(float(state[0]), GOAL)


class MountainCarContinuous(Observed, Drawn):
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

    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """The flag is the goal."""
        del earlier
        return draw_hills(float(state[0]), CONTINUOUS_GOAL)


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


def draw_hills(position: float, goal: float) -> UInt8[np.ndarray, "H W 3"]:
    """The car on its hills, as high as Gymnasium draws them, and a flag at the goal."""
    height = lambda x: 0.45 * np.sin(3 * x) + 0.55  # noqa: E731
    sheet, along = Canvas((MIN_POSITION, 0.0), (MAX_POSITION, 1.25)), np.linspace(MIN_POSITION, MAX_POSITION, 100)
    ground = [(x, height(x)) for x in along]
    sheet.polygon([(MIN_POSITION, 0), *ground, (MAX_POSITION, 0)], MIST)
    sheet.line(ground, 0.01, STONE)
    foot, top = (goal, height(goal)), (goal, height(goal) + 0.16)
    sheet.line([foot, top], 0.01, INK)
    sheet.polygon([top, (goal - 0.09, top[1] - 0.035), (goal, top[1] - 0.07)], GREEN)
    slope = np.arctan(1.35 * np.cos(3 * position))
    ahead, up = np.array([np.cos(slope), np.sin(slope)]), np.array([-np.sin(slope), np.cos(slope)])
    base = np.array([position, height(position)])
    body = [
        base + a * ahead + b * up for a, b in ((-0.06, 0.02), (0.06, 0.02), (0.06, 0.05), (0.02, 0.08), (-0.06, 0.08))
    ]
    sheet.polygon(body, BLUE)
    for a in (-0.035, 0.035):
        sheet.disc(base + a * ahead + 0.02 * up, 0.02, INK)
    return sheet.picture()
