"""Catch: the smallest game of pictures (Mnih et al. 2014; bsuite, Osband et al. 2020). A ball falls, a paddle below moves; did it catch it?

The board is `rows` x `columns` grey pixels, ball and paddle white. Each step the ball falls a row, and the paddle moves left (0), stays
(1) or moves right (2). When the ball reaches the last row the episode ends, with reward 1 if the paddle is there and -1 if not. The
optimum is 1: from anywhere in the middle there is time.
"""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..core import Environment, PRNGKey, Timestep


class CatchState(eqx.Module):
    """Row and column of the ball, column of the paddle."""

    row: Int[Array, ""]
    column: Int[Array, ""]
    paddle: Int[Array, ""]


class Catch(Environment):
    """The game, on a board of a size that can be chosen."""

    rows: int = eqx.field(static=True, default=10)
    columns: int = eqx.field(static=True, default=5)

    def __check_init__(self) -> None:
        if self.columns < 1 or self.rows - 1 < self.columns // 2:
            raise ValueError(
                f"on a board of {self.rows} rows and {self.columns} columns the paddle cannot always be in time: it moves a column a row, "
                "and starts in the middle; give at least 1 + columns / 2 rows"
            )

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0, 255, (self.rows, self.columns, 1), np.uint8)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(3)

    def reset(self, key: PRNGKey) -> tuple[CatchState, Array]:
        column = jax.random.randint(key, (), 0, self.columns)
        state = CatchState(jnp.zeros((), jnp.int32), column, jnp.asarray(self.columns // 2, jnp.int32))
        return state, self._draw(state)

    def step(self, state: CatchState, action: Int[Array, ""], key: PRNGKey) -> tuple[CatchState, Timestep]:
        del key
        paddle = jnp.clip(state.paddle + action - 1, 0, self.columns - 1).astype(jnp.int32)
        state = CatchState(state.row + 1, state.column, paddle)
        down = state.row >= self.rows - 1
        reward = jnp.where(down, jnp.where(paddle == state.column, 1.0, -1.0), 0.0)
        picture = self._draw(state)
        return state, Timestep(picture, reward, down, jnp.zeros((), bool), picture, {})

    def _draw(self, state: CatchState) -> Array:
        board = jnp.zeros((self.rows, self.columns, 1), jnp.uint8)
        return board.at[self.rows - 1, state.paddle].set(255).at[state.row, state.column].set(255)
