"""Catch (Mnih, Heess, Graves and Kavukcuoglu 2014): a game of pictures so small that it is learnt in seconds, whose optimum is known.

A ball falls from a random column, one row a step; a paddle in the bottom row moves left, stays, or moves right. When the ball reaches the
bottom row the episode terminates with reward 1 where it meets the paddle and -1 where it does not. All other rewards are 0, so that the
move that decided comes steps before what it earned.

The observation is the board as an 8-bit picture `[rows, columns, 1]`, ball and paddle 255, everything else 0, and shows the whole state:
the ball falls straight. With at least as many steps as the paddle has to go the best policy never misses: its return is 1 and its value
gamma to the number of steps that are left, less one.
"""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt8

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep


class CatchState(eqx.Module):
    """Where the ball is, and the column of the paddle."""

    row: Int[Array, ""]
    column: Int[Array, ""]
    paddle: Int[Array, ""]


class Catch(Environment):
    """A board of `rows` by `columns`. Actions: 0 left, 1 stay, 2 right."""

    rows: int = eqx.field(default=10, static=True)
    columns: int = eqx.field(default=5, static=True)

    def __check_init__(self) -> None:
        if self.rows < 2 or self.columns < 1:
            raise ValueError(
                f"Catch needs at least 2 rows and 1 column for a ball to fall, not {self.rows} and {self.columns}"
            )

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0, 255, (self.rows, self.columns, 1), np.uint8)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(3)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        column = jax.random.randint(key, (), 0, self.columns)
        state = CatchState(jnp.zeros((), jnp.int32), column, jnp.asarray(self.columns // 2, jnp.int32))
        return state, self._picture(state)

    def step(self, state: CatchState, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        paddle = jnp.clip(state.paddle + jnp.asarray(action, jnp.int32) - 1, 0, self.columns - 1)
        state = CatchState(state.row + 1, state.column, paddle)
        down = state.row == self.rows - 1
        reward = jnp.where(down, jnp.where(state.column == paddle, 1.0, -1.0), 0.0)
        picture = self._picture(state)
        return state, Timestep(picture, reward, down, jnp.zeros((), bool), picture, {})

    def _picture(self, state: CatchState) -> UInt8[Array, "H W 1"]:
        board = jnp.zeros((self.rows, self.columns, 1), jnp.uint8)
        return board.at[state.row, state.column, 0].set(255).at[self.rows - 1, state.paddle, 0].set(255)
