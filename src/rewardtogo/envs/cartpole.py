"""CartPole (Barto, Sutton and Anderson 1983) with the constants, the integrator and the limits of Gymnasium's CartPole-v1.

A pole stands on a cart that is pushed left or right with a fixed force. Reward 1 a step, the last one included.
"""

from collections.abc import Sequence

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..core import Action, Drawn, Observation, Observed, PRNGKey, State, Timestep
from .canvas import BLUE, INK, ORANGE, STONE, VERMILION, Canvas

GRAVITY = 9.8
CART_MASS = 1.0
POLE_MASS = 0.1
HALF_LENGTH = 0.5
FORCE = 10.0
TIME_STEP = 0.02
X_LIMIT = 2.4
ANGLE_LIMIT = 12 * 2 * np.pi / 360


class CartPole(Observed, Drawn):
    """State and observation: position (m), velocity (m/s), pole angle (rad), angular velocity (rad/s). Actions: 0 left, 1 right."""

    @property
    def observation_space(self) -> spaces.Box:
        high = np.array([2 * X_LIMIT, np.inf, 2 * ANGLE_LIMIT, np.inf], np.float32)
        return spaces.Box(-high, high, dtype=np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state = jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05)
        return state, state

    def state_of(self, observation: Observation) -> State:
        return jnp.asarray(observation)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        state = dynamics(state, action)
        terminated = (jnp.abs(state[0]) > X_LIMIT) | (jnp.abs(state[2]) > ANGLE_LIMIT)
        return state, Timestep(state, jnp.ones(()), terminated, jnp.zeros((), bool), state, {})

    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """Where the cart may not go and how far the pole may lean are marked."""
        del earlier
        x, _, angle, _ = (float(v) for v in state)
        sheet = Canvas((-2.8, -0.5), (2.8, 1.5))
        for side in (-1, 1):
            lean = side * ANGLE_LIMIT
            sheet.line([(x, 0), (x + 1.3 * np.sin(lean), 1.3 * np.cos(lean))], 0.02, STONE)
            sheet.line([(side * X_LIMIT, -0.3), (side * X_LIMIT, 0.1)], 0.05, VERMILION)
        draw_cart(sheet, x, angle)
        return sheet.picture()


def dynamics(state: Float[Array, "4"], action: Action) -> Float[Array, "4"]:
    """One Euler step of the cart and the pole."""
    x, velocity, angle, spin = state
    linear, angular = accelerations(state, jnp.where(action == 1, FORCE, -FORCE))
    return jnp.stack(
        [x + TIME_STEP * velocity, velocity + TIME_STEP * linear, angle + TIME_STEP * spin, spin + TIME_STEP * angular]
    )


def accelerations(state: Float[Array, "4"], force: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Of the cart and of the pole's angle under a force (Florian 2005, frictionless)."""
    _, _, angle, spin = state
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    total_mass, moment = CART_MASS + POLE_MASS, POLE_MASS * HALF_LENGTH
    push = (force + moment * spin**2 * sine) / total_mass
    angular = (GRAVITY * sine - cosine * push) / (HALF_LENGTH * (4.0 / 3.0 - POLE_MASS * cosine**2 / total_mass))
    return push - moment * angular * cosine / total_mass, angular


def draw_cart(sheet: Canvas, x: float, angle: float) -> None:
    """The track, which is marked at every metre, the cart at `x` and its pole."""
    middle = round(x)
    sheet.line([(middle - 9, -0.2), (middle + 9, -0.2)], 0.02, STONE)
    for metre in range(middle - 9, middle + 10):
        sheet.line([(metre, -0.2), (metre, -0.28)], 0.02, STONE)
    sheet.box((x - 0.25, -0.2), (x + 0.25, 0.08), INK)
    sheet.line([(x, 0), (x + 2 * HALF_LENGTH * np.sin(angle), 2 * HALF_LENGTH * np.cos(angle))], 0.1, BLUE)
    sheet.disc((x, 0), 0.03, ORANGE)
