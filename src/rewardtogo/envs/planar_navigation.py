"""Planar navigation (Watter et al. 2015): an agent among round obstacles, seen as a small grey picture, on its way to a corner.

The agent is a point of the unit square and moves by what the action says. Obstacles are hard and smooth: a move whose end lies in one ends
at its edge, at the nearest point outside. The square's border stops it. Obstacles are always in the same places, the goal is near the lower
right corner, and the reward of a step is minus the squared distance to the goal of where it led. It never terminates: `make` cuts after 40
steps.

Deviations from the paper: 16 x 16 pixels in place of 40 x 40, five obstacles in place of six, and a disc that shades off over a pixel, so
that moves of less than a pixel can be seen.
"""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep

OBSTACLES = ((0.3, 0.25), (0.7, 0.25), (0.45, 0.55), (0.8, 0.6), (0.2, 0.8))
"""Their middles, (right, down) in the unit square."""
RADIUS = 0.1
"""Of an obstacle."""
GOAL = (0.9, 0.9)
BORDER = 0.08
"""How near to the picture's edge the agent gets: it is always seen whole."""
MOST = 0.1
"""The largest move along each axis. Less than an obstacle's diameter: none is jumped over through its middle."""


class PlanarNavigation(Environment):
    """Pictures `[size, size, 1]` of an agent, 255, and obstacles, 128. State: position `[2]`, right and down, in [0, 1].

    Action: the move `[2]`, each number in [-0.1, 0.1]. First states: uniform outside the obstacles.
    """

    size: int = eqx.field(default=16, static=True)

    def __check_init__(self) -> None:
        if self.size < 8:
            raise ValueError(
                f"obstacles and ways between them need at least 8 by 8 pixels, and PlanarNavigation was given {self.size}"
            )

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0, 255, (self.size, self.size, 1), np.uint8)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-MOST, MOST, (2,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        def again(loop: tuple[PRNGKey, Array]) -> tuple[PRNGKey, Array]:
            key, draw = jax.random.split(loop[0])
            return key, jax.random.uniform(draw, (2,), minval=BORDER, maxval=1.0 - BORDER)

        _, position = jax.lax.while_loop(lambda loop: blocked(loop[1]), again, again((key, jnp.zeros(2))))
        return position, picture(position, self.size)

    def step(self, state: Float[Array, "2"], action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        wanted = jnp.clip(state + jnp.clip(action, -MOST, MOST), BORDER, 1.0 - BORDER)
        position = pushed_out(wanted)
        reward = -jnp.sum((position - jnp.asarray(GOAL, position.dtype)) ** 2)
        seen, never = picture(position, self.size), jnp.zeros((), bool)
        return position, Timestep(seen, reward, never, never, seen, {})


def blocked(position: Float[Array, "2"]) -> Bool[Array, ""]:
    """Whether it lies in an obstacle."""
    return (((position[None] - jnp.asarray(OBSTACLES)) ** 2).sum(-1) < RADIUS**2).any()


def pushed_out(position: Float[Array, "2"]) -> Float[Array, "2"]:
    """The nearest point outside the obstacles."""
    middles = jnp.asarray(OBSTACLES)
    way = position[None] - middles
    distance = jnp.linalg.norm(way, axis=-1)
    nearest = jnp.argmin(distance)
    edge = middles[nearest] + RADIUS * way[nearest] / jnp.maximum(distance[nearest], 1e-6)
    return jnp.where(distance[nearest] < RADIUS, edge, position)


def picture(position: Float[Array, "2"], size: int) -> UInt8[Array, "H W 1"]:
    """What the camera sees: the agent is a disc of 1.5 pixels of 16."""
    at = (jnp.arange(size) + 0.5) / size
    place = jnp.stack(jnp.meshgrid(at, at), -1)
    cover = lambda middle, radius: jnp.clip(  # noqa: E731
        0.5 - size * (jnp.linalg.norm(place - middle[None, None], axis=-1) - radius), 0.0, 1.0
    )
    walls = jax.vmap(lambda middle: cover(middle, RADIUS))(jnp.asarray(OBSTACLES)).max(0)
    return (255.0 * jnp.maximum(0.5 * walls, cover(position, 1.5 / 16))).astype(jnp.uint8)[..., None]
