"""CartPole (Barto, Sutton and Anderson 1983) with the constants, the integrator and the limits of Gymnasium's CartPole-v1.

A pole stands on a cart that is pushed left or right with a fixed force. Reward 1 a step, the last one included.
"""

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core import Action, Observation, Observed, PRNGKey, State, Timestep

GRAVITY = 9.8
CART_MASS = 1.0
POLE_MASS = 0.1
HALF_LENGTH = 0.5
FORCE = 10.0
TIME_STEP = 0.02
X_LIMIT = 2.4
ANGLE_LIMIT = 12 * 2 * np.pi / 360


class CartPole(Observed):
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
