"""Acrobot (Sutton 1996): two links that hang from a pivot, driven at the joint between them until the tip swings high.

With joint angles θ and a torque u at the second joint, M(θ) θ'' + c(θ, θ') = (0, u). The constants are those of
Gymnasium's Acrobot-v1, the equations those of Sutton and Barto's book, integrated over 0.2 s by one Runge-Kutta step.
Reward -1 a step, and 0 for the one that gets there.
"""

from collections.abc import Callable, Sequence

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..core import Action, Drawn, Observation, Observed, PRNGKey, State, Timestep
from .canvas import BLUE, GREEN, INK, SKY, Canvas

GRAVITY = 9.8
LINK_MASS = 1.0
LINK_LENGTH = 1.0
LINK_CENTRE = 0.5
LINK_INERTIA = 1.0
TIME_STEP = 0.2
MAX_SPIN_1 = 4 * np.pi
MAX_SPIN_2 = 9 * np.pi
TIP_HEIGHT = 1.0


class Acrobot(Observed, Drawn):
    """Two links. Actions: torque -1, 0, 1.

    - State: two angles (rad, 0 hanging, the second relative to the first), two angular velocities (rad/s).
    - Observation: cosine and sine of either angle, then the velocities.
    """

    @property
    def observation_space(self) -> spaces.Box:
        high = np.array([1.0, 1.0, 1.0, 1.0, MAX_SPIN_1, MAX_SPIN_2], np.float32)
        return spaces.Box(-high, high, dtype=np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(3)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state = jax.random.uniform(key, (4,), minval=-0.1, maxval=0.1)
        return state, observe(state)

    def state_of(self, observation: Observation) -> State:
        cosine_1, sine_1, cosine_2, sine_2, *spins = jnp.asarray(observation)
        return jnp.stack([jnp.arctan2(sine_1, cosine_1), jnp.arctan2(sine_2, cosine_2), *spins])

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        state = dynamics(state, action)
        terminated = -jnp.cos(state[0]) - jnp.cos(state[0] + state[1]) > TIP_HEIGHT
        reward = terminated.astype(state.dtype) - 1.0
        observation = observe(state)
        return state, Timestep(observation, reward, terminated, jnp.zeros((), bool), observation, {})

    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """The line is the height that the tip is to reach."""
        del earlier
        angles, sheet = np.cumsum([float(v) for v in state[:2]]), Canvas((-2.2, -2.2), (2.2, 2.2))
        sheet.line([(-2.2, TIP_HEIGHT), (2.2, TIP_HEIGHT)], 0.03, GREEN)
        draw_links(sheet, LINK_LENGTH * np.stack([np.sin(angles), -np.cos(angles)], 1), 0.2)
        return sheet.picture()


def observe(state: Float[Array, "4"]) -> Float[Array, "6"]:
    """What is seen of a state: no jump where an angle passes π."""
    one, two = state[0], state[1]
    return jnp.stack([jnp.cos(one), jnp.sin(one), jnp.cos(two), jnp.sin(two), state[2], state[3]])


def dynamics(state: Float[Array, "4"], action: Action) -> Float[Array, "4"]:
    """0.2 s under a constant torque; then angles go back into [-π, π] and velocities into their limits."""
    torque = jnp.asarray(action, state.dtype) - 1.0
    state = runge_kutta(lambda s: rate_of_change(s, torque), state, TIME_STEP)
    # Rounding half turns to even leaves -π and π where they are.
    angles = state[:2] - 2 * np.pi * jnp.round(state[:2] / (2 * np.pi))
    limits = jnp.asarray([MAX_SPIN_1, MAX_SPIN_2], state.dtype)
    return jnp.concatenate([angles, jnp.clip(state[2:], -limits, limits)])


def rate_of_change(state: Float[Array, "4"], torque: Float[Array, ""]) -> Float[Array, "4"]:
    """Time derivative of the state: the equation of motion solved for the accelerations by elimination."""
    angle_1, angle_2, spin_1, spin_2 = state
    coupling = LINK_MASS * LINK_LENGTH * LINK_CENTRE
    lever = LINK_MASS * LINK_CENTRE**2
    mass_22 = lever + LINK_INERTIA
    mass_12 = mass_22 + coupling * jnp.cos(angle_2)
    mass_11 = 2 * mass_22 + LINK_MASS * LINK_LENGTH**2 + 2 * coupling * jnp.cos(angle_2)
    swing = coupling * jnp.sin(angle_2)
    weight_2 = LINK_MASS * LINK_CENTRE * GRAVITY * jnp.sin(angle_1 + angle_2)
    weight_1 = LINK_MASS * (LINK_CENTRE + LINK_LENGTH) * GRAVITY * jnp.sin(angle_1) + weight_2
    force_1 = weight_1 - swing * spin_2 * (spin_2 + 2 * spin_1)
    force_2 = weight_2 + swing * spin_1**2
    acceleration_2 = (torque - force_2 + mass_12 / mass_11 * force_1) / (mass_22 - mass_12**2 / mass_11)
    acceleration_1 = -(force_1 + mass_12 * acceleration_2) / mass_11
    return jnp.stack([spin_1, spin_2, acceleration_1, acceleration_2])


def runge_kutta(
    derivative: Callable[[Float[Array, "O"]], Float[Array, "O"]], state: Float[Array, "O"], duration: float
) -> Float[Array, "O"]:
    """One classical fourth-order Runge-Kutta step."""
    start = derivative(state)
    middle = derivative(state + duration / 2 * start)
    again = derivative(state + duration / 2 * middle)
    end = derivative(state + duration * again)
    return state + duration / 6 * (start + 2 * middle + 2 * again + end)


def draw_links(sheet: Canvas, links: Float[np.ndarray, "2 2"], width: float) -> None:
    """Two links from the origin, either by the way along it."""
    joints = np.concatenate([np.zeros((1, 2)), np.cumsum(links, 0)])
    sheet.line(joints[:2], width, BLUE)
    sheet.line(joints[1:], width, SKY)
    for joint in joints[:2]:
        sheet.disc(joint, 0.3 * width, INK)
