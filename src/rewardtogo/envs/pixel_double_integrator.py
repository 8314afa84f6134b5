r"""A double integrator seen by a camera: a point mass in the plane, pushed by forces, drawn as a disc on a small grey picture.

$$p' = p + \tfrac12 h^2 u + h v, \qquad v' = v + h u + w, \quad w \sim N(0, \sigma^2 I), \qquad
r = -\tfrac12 \big(|p|^2 + q |v|^2 + \rho |u|^2\big),$$

of the position, velocity and force before the move: linear dynamics (`dynamics`, `noise`) and quadratic cost (`cost`), so that the
regulator of the state is exactly the best there is, and what a policy of pictures loses can be measured. The goal is the picture's middle.
The velocity is in no single picture. There are no walls: a mass that leaves the picture is not seen until it comes back. It never
terminates: `make` cuts after 15 steps.
"""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep

STEP = 0.4
"""h, in seconds."""
NOISE = 0.02
"""sigma: deviation of the noise on the velocity, in each step."""
SPEED_PRICE, FORCE_PRICE = 0.1, 0.5
"""q and rho."""
MOST = 1.5
"""The largest force along each axis. The regulator's first force is less than the distance to the goal, and never comes to it."""
START = 0.8
"""First positions are uniform within this of the goal, along each axis; first velocities are zero."""
VIEW = 2.0
"""The picture shows positions within this of the goal."""
RADIUS = 0.4
"""Of the disc."""


def dynamics() -> Float[np.ndarray, "4 6"]:
    """F: the next (position, velocity) of (position, velocity, force)."""
    eye, zero = np.eye(2), np.zeros((2, 2))
    return np.block([[eye, STEP * eye, 0.5 * STEP**2 * eye], [zero, eye, STEP * eye]])


def cost() -> Float[np.ndarray, "6 6"]:
    """C: a step costs z' C z / 2 of z = (position, velocity, force)."""
    return np.diag([1.0, 1.0, SPEED_PRICE, SPEED_PRICE, FORCE_PRICE, FORCE_PRICE])


def noise() -> Float[np.ndarray, "4 4"]:
    """Covariance of what is added to (position, velocity) in each step."""
    return np.diag([0.0, 0.0, NOISE**2, NOISE**2])


class PixelDoubleIntegrator(Environment):
    """Pictures `[size, size, 1]` of a disc, 255 at its middle. State: position and velocity `[4]`, right and down, 0 at the goal.

    Action: the force `[2]`, each number in [-1.5, 1.5].
    """

    size: int = eqx.field(default=16, static=True)

    def __check_init__(self) -> None:
        if self.size < 8:
            raise ValueError(f"a disc needs at least 8 by 8 pixels, and PixelDoubleIntegrator was given {self.size}")

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0, 255, (self.size, self.size, 1), np.uint8)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-MOST, MOST, (2,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state = jnp.concatenate([jax.random.uniform(key, (2,), minval=-START, maxval=START), jnp.zeros(2)])
        return state, picture(state[:2], self.size)

    def step(self, state: Float[Array, "4"], action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        z = jnp.concatenate([state, jnp.clip(action, -MOST, MOST)])
        following = jnp.asarray(dynamics(), state.dtype) @ z
        following = following.at[2:].add(NOISE * jax.random.normal(key, (2,)))
        reward = -0.5 * (jnp.asarray(np.diag(cost()), state.dtype) * z**2).sum()
        seen, never = picture(following[:2], self.size), jnp.zeros((), bool)
        return following, Timestep(seen, reward, never, never, seen, {})


def picture(position: Float[Array, "2"], size: int) -> UInt8[Array, "H W 1"]:
    """What the camera sees: a disc that shades off over a pixel."""
    at = ((jnp.arange(size) + 0.5) / size * 2.0 - 1.0) * VIEW
    across, down = at[None, :] - position[0], at[:, None] - position[1]
    distance = jnp.sqrt(across**2 + down**2)
    return (255.0 * jnp.clip(0.5 - 0.5 * size / VIEW * (distance - RADIUS), 0.0, 1.0)).astype(jnp.uint8)[..., None]
