"""Pendulum seen by a camera: a rod drawn on a small grey picture. Velocity is in no single picture, but in the change from one to the next.

The rod reaches from the middle to near the edge. A pixel is as bright as the rod covers it, falling off over a pixel at its border, so
that small turns can be seen although pixels are large; the tip is thicker. Dynamics, rewards and first states are `Pendulum`'s.
"""

import equinox as eqx
import gymnasium.spaces as spaces
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep
from .pendulum import Pendulum


class PixelPendulum(Environment):
    """`Pendulum` as 8-bit pictures `[size, size, 1]`; upright points to the top. State and action are those of `Pendulum`."""

    size: int = eqx.field(default=16, static=True)

    def __check_init__(self) -> None:
        if self.size < 4:
            raise ValueError(
                f"a rod cannot be seen in fewer than 4 by 4 pixels, and PixelPendulum was given {self.size}"
            )

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0, 255, (self.size, self.size, 1), np.uint8)

    @property
    def action_space(self) -> spaces.Box:
        return Pendulum().action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state, _ = Pendulum().reset(key)
        return state, picture(state[0], self.size)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        state, timestep = Pendulum().step(state, action, key)
        seen = picture(state[0], self.size)
        return state, Timestep(seen, timestep.reward, timestep.terminated, timestep.truncated, seen, timestep.extras)


def picture(angle: Float[Array, ""], size: int) -> UInt8[Array, "H W 1"]:
    """The rod at an angle from upright, counter-clockwise."""
    middle = 0.5 * (size - 1)
    length = middle - 1.5
    rows, columns = jnp.arange(size) - middle, jnp.arange(size) - middle
    x, y = columns[None, :], -rows[:, None]
    ahead, aside = -jnp.sin(angle), jnp.cos(angle)
    along = jnp.clip(x * ahead + y * aside, 0.0, length)
    distance = jnp.sqrt((x - along * ahead) ** 2 + (y - along * aside) ** 2)
    tip = jnp.sqrt((x - length * ahead) ** 2 + (y - length * aside) ** 2)
    edge = jnp.minimum(distance - 0.06 * size, tip - 0.12 * size)
    return (255.0 * jnp.clip(0.5 - edge, 0.0, 1.0)).astype(jnp.uint8)[..., None]
