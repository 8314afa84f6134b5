r"""Swing-up of a cart-pole: a pole hangs from a cart that is pushed left and right, and is to stand on it, in the middle of the track.

The dynamics are those of `CartPole` (its masses, its length, no friction), over 0.05 s by one Runge-Kutta step. With the angle θ = 0
upright and the tip at (x + 2 l sin θ, 2 l cos θ), 2 l being the pole's length, the reward is that of PETS (Chua et al. 2018),

    r = exp(-|tip - (0, 2 l)|² / (2 l)²) - 0.01 u²

for the state that a step led to and the action u. It is near 0 where the pole hangs, so that there is little to climb by. The track has no
end, and nothing terminates: `make` cuts after 100 steps.
"""

from collections.abc import Sequence

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..core import Action, Drawn, Observation, Observed, PRNGKey, State, Timestep
from .acrobot import runge_kutta
from .canvas import GREEN, Canvas
from .cartpole import FORCE, HALF_LENGTH, accelerations, draw_cart

TIME_STEP = 0.05
EFFORT = 0.01
"""What a squared action costs."""


class CartPoleSwingUp(Observed, Drawn):
    """A cart and a pole. Action: the force in units of 10 N, in [-1, 1].

    - State: position (m), velocity (m/s), angle (rad, 0 upright, not wrapped), angular velocity (rad/s).
    - Observation: position, velocity, cosine and sine of the angle, angular velocity.
    """

    @property
    def observation_space(self) -> spaces.Box:
        high = np.array([np.inf, np.inf, 1.0, 1.0, np.inf], np.float32)
        return spaces.Box(-high, high, dtype=np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        """Hanging, nearly at rest, near the middle."""
        state = jnp.asarray([0.0, 0.0, np.pi, 0.0]) + 0.05 * jax.random.normal(key, (4,))
        return state, observe(state)

    def state_of(self, observation: Observation) -> State:
        x, velocity, cosine, sine, spin = jnp.asarray(observation)
        return jnp.stack([x, velocity, jnp.arctan2(sine, cosine), spin])

    def step(self, state: Float[Array, "4"], action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        push = jnp.clip(jnp.asarray(action, state.dtype)[0], -1.0, 1.0)
        state = runge_kutta(lambda s: rate_of_change(s, FORCE * push), state, TIME_STEP)
        observation, never = observe(state), jnp.zeros((), bool)
        reward = standing(state) - EFFORT * push**2
        return state, Timestep(observation, reward, never, never, observation, {})

    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """The ring is where the tip should be. The picture goes along with a cart that leaves it."""
        del earlier
        x, _, angle, _ = (float(v) for v in state)
        aside = x - np.clip(x, -1.4, 1.4)
        sheet = Canvas((aside - 2.6, -1.3), (aside + 2.6, 1.4))
        sheet.disc((0, 2 * HALF_LENGTH), 0.14, GREEN, 0.09)
        draw_cart(sheet, x, angle)
        return sheet.picture()


def observe(state: Float[Array, "4"]) -> Float[Array, "5"]:
    """What is seen of a state: no jump where the angle passes π."""
    x, velocity, angle, spin = state
    return jnp.stack([x, velocity, jnp.cos(angle), jnp.sin(angle), spin])


def standing(state: Float[Array, "4"]) -> Float[Array, ""]:
    """1 with the tip where it should be, less the farther away it is."""
    length = 2 * HALF_LENGTH
    right = state[0] + length * jnp.sin(state[2])
    below = length * (1.0 - jnp.cos(state[2]))
    return jnp.exp(-(right**2 + below**2) / length**2)


def rate_of_change(state: Float[Array, "4"], force: Float[Array, ""]) -> Float[Array, "4"]:
    """Time derivative of the state."""
    linear, angular = accelerations(state, force)
    return jnp.stack([state[1], linear, state[3], angular])
