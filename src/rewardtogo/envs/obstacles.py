"""Obstacles: a point of the plane on its way to a goal, with walls in between, after the course's task of model-based learning.

The point lives in the square [-1, 1]² and moves by 0.1 times the action. The square's border stops it; a move that would touch a wall is
not made at all, so that the dynamics are simple but for a jump at the walls. The point begins upper left, the goal lies lower right, both
somewhere in a square of 0.5, and the straight way is walled up. The reward of a step is minus the distance to the goal of where it led. It
never terminates: `make` cuts after 100 steps.
"""

from collections.abc import Sequence

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from ..core import Action, Drawn, Observation, Observed, PRNGKey, State, Timestep
from .canvas import BLUE, GREEN, PAPER, SKY, STONE, Canvas

WALLS = ((-0.5, 0.1, 0.1, 0.2), (0.2, -0.7, 0.3, -0.1), (-0.4, -0.6, -0.3, -0.2))
"""Closed rectangles: left, lower, right, upper."""
START, GOAL = ((-0.9, 0.4), (-0.4, 0.9)), ((0.4, -0.9), (0.9, -0.4))
"""Lower left and upper right corner of where episodes begin, and of where goals lie."""
STRIDE = 0.1
"""The longest move along each axis."""


class Obstacles(Observed, Drawn):
    """A point among walls. Action: its move in tenths, `[2]` in [-1, 1].

    State and observation: position (right, up), then the goal's.
    """

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (4,), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        low, high = (jnp.asarray([START[i], GOAL[i]], jnp.float32) for i in range(2))
        state = jax.random.uniform(key, (2, 2), minval=low, maxval=high).ravel()
        return state, state

    def state_of(self, observation: Observation) -> State:
        return jnp.asarray(observation)

    def step(self, state: Float[Array, "4"], action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        position, goal = state[:2], state[2:]
        stride = STRIDE * jnp.clip(jnp.asarray(action, state.dtype), -1.0, 1.0)
        wanted = jnp.clip(position + stride, -1.0, 1.0)
        position = jnp.where(walled(position, wanted), position, wanted)
        state = jnp.concatenate([position, goal])
        # A little more than 0, where the root has no derivative.
        reward = -jnp.sqrt(jnp.sum((position - goal) ** 2) + 1e-12)
        never = jnp.zeros((), bool)
        return state, Timestep(state, reward, never, never, state, {})

    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """Walls, the way so far, and the goal as a ring."""
        sheet = Canvas((-1.05, -1.05), (1.05, 1.05), STONE)
        sheet.box((-1, -1), (1, 1), PAPER)
        for left, lower, right, upper in WALLS:
            sheet.box((left, lower), (right, upper), STONE)
        way = np.asarray([*earlier, state], float)
        sheet.disc(way[-1, 2:], 0.07, GREEN, 0.045)
        sheet.line(way[:, :2], 0.02, SKY)
        sheet.disc(way[-1, :2], 0.045, BLUE)
        return sheet.picture()


def walled(start: Float[Array, "2"], end: Float[Array, "2"]) -> Bool[Array, ""]:
    """Whether the straight way from `start` to `end` touches a wall: whether the times at which it is between a wall's sides overlap."""
    walls = jnp.asarray(WALLS, start.dtype)
    way = end - start
    # Along an axis that it does not move on it is between the sides for ever or never, which huge times say.
    way = jnp.where(jnp.abs(way) < 1e-9, 1e-9, way)
    low, high = (walls[:, :2] - start[None]) / way[None], (walls[:, 2:] - start[None]) / way[None]
    enters = jnp.minimum(low, high).max(1)
    leaves = jnp.maximum(low, high).min(1)
    return ((enters <= leaves) & (leaves >= 0.0) & (enters <= 1.0)).any()
