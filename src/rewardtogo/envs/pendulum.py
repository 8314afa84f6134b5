"""Pendulum: swing a rod up with a torque that cannot lift it at once, and hold it there.

θ'' = 3g/(2l) sin θ + 3/(ml²) u with θ = 0 upright, and the constants and the semi-implicit Euler step of Gymnasium's
Pendulum-v1. Reward -(θ² + 0.1 θ'² + 0.001 u²), of the state that the action was chosen in. Never ends.
"""

from collections.abc import Sequence

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..core import Action, Drawn, Observation, Observed, PRNGKey, State, Timestep
from .canvas import BLUE, GREEN, INK, Canvas

GRAVITY = 10.0
MASS = 1.0
LENGTH = 1.0
TIME_STEP = 0.05
MAX_SPIN = 8.0
MAX_TORQUE = 2.0


class Pendulum(Observed, Drawn):
    """One rod. Action: a torque in [-2, 2].

    - State: angle (rad, not wrapped), angular velocity (rad/s).
    - Observation: cosine and sine of the angle, then the velocity.
    """

    @property
    def observation_space(self) -> spaces.Box:
        high = np.array([1.0, 1.0, MAX_SPIN], np.float32)
        return spaces.Box(-high, high, dtype=np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-MAX_TORQUE, MAX_TORQUE, (1,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0) * jnp.asarray([np.pi, 1.0])
        return state, observe(state)

    def state_of(self, observation: Observation) -> State:
        cosine, sine, spin = jnp.asarray(observation)
        return jnp.stack([jnp.arctan2(sine, cosine), spin])

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        torque = jnp.clip(jnp.asarray(action, state.dtype)[0], -MAX_TORQUE, MAX_TORQUE)
        reward = -cost(state, torque)
        state = dynamics(state, torque)
        observation, never = observe(state), jnp.zeros((), bool)
        return state, Timestep(observation, reward, never, never, observation, {})

    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """The ring is where the tip should be."""
        del earlier
        angle, sheet = float(state[0]), Canvas((-1.3, -1.3), (1.3, 1.3))
        sheet.disc((0, LENGTH), 0.16, GREEN, 0.12)
        sheet.line([(0, 0), (-LENGTH * np.sin(angle), LENGTH * np.cos(angle))], 0.16, BLUE)
        sheet.disc((0, 0), 0.05, INK)
        return sheet.picture()


def observe(state: Float[Array, "2"]) -> Float[Array, "3"]:
    """What is seen of a state: no jump where the angle passes π."""
    return jnp.stack([jnp.cos(state[0]), jnp.sin(state[0]), state[1]])


def cost(state: Float[Array, "2"], torque: Float[Array, ""]) -> Float[Array, ""]:
    """Squared distance from upright and at rest, and a little for the torque."""
    angle = (state[0] + np.pi) % (2 * np.pi) - np.pi
    return angle**2 + 0.1 * state[1] ** 2 + 0.001 * torque**2


def dynamics(state: Float[Array, "2"], torque: Float[Array, ""]) -> Float[Array, "2"]:
    """One step: first the velocity, then the angle with the new velocity."""
    angle, spin = state
    acceleration = 3 * GRAVITY / (2 * LENGTH) * jnp.sin(angle) + 3.0 / (MASS * LENGTH**2) * torque
    spin = jnp.clip(spin + TIME_STEP * acceleration, -MAX_SPIN, MAX_SPIN)
    return jnp.stack([angle + TIME_STEP * spin, spin])
