r"""Reacher: a planar arm of two links whose tip is to come to a target, by torques at both joints.

With joint angles q, the second relative to the first, and uniform rods, Lagrange's equations are

    M(q) q'' + c(q, q') + b q' = u,      M = [[α + 2 β cos q_2, δ + β cos q_2], [δ + β cos q_2, δ]]

    c = β sin q_2 [-q_2' (2 q_1' + q_2'), q_1'²],    α = I_1 + I_2 + m r² + m (l² + r²),    β = m l r,    δ = I_2 + m r²

with r = l / 2 and I = m l² / 12. The arm lies flat: there is no gravity. Each joint has some friction b. A step is 0.1 s, two steps of
Runge and Kutta's. The reward is minus the distance from tip to target after it, less 0.01 |a|² for the action. It never terminates: `make`
cuts after 50 steps.

Different from Gymnasium's Reacher-v5, which is the same task with MuJoCo's arm, armature and units.
"""

from collections.abc import Sequence

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..core import Action, Drawn, Observation, Observed, PRNGKey, State, Timestep
from .acrobot import draw_links, runge_kutta
from .canvas import GREEN, MIST, ORANGE, Canvas

LENGTH, MASS = 0.5, 1.0
"""Of either link, m and kg."""
CENTRE, INERTIA = LENGTH / 2, MASS * LENGTH**2 / 12
"""From a link's joint to its centre of mass, and its moment of inertia around that."""
TORQUES = (2.0, 0.5)
"""The largest ones, N m: what an action of 1 is."""
FRICTION = (0.2, 0.05)
"""N m s."""
TIME_STEP, SUBSTEPS = 0.1, 2
EFFORT = 0.01
"""What a unit of squared action costs."""
NEAREST, FARTHEST = 0.2, 0.9
"""Distances of targets from the shoulder."""


class Reacher(Observed, Drawn):
    """Two links. Action: torques `[2]` in units of the largest ones, in [-1, 1].

    - State: the two angles (rad, not wrapped), the two angular velocities (rad/s), the target (m).
    - Observation: cosines and sines of the angles, the velocities, the target, and from the target to the tip: ten numbers.
    """

    @property
    def observation_space(self) -> spaces.Box:
        high = np.array([1.0] * 4 + [np.inf] * 2 + [FARTHEST] * 2 + [FARTHEST + 2 * LENGTH] * 2, np.float32)
        return spaces.Box(-high, high, dtype=np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        """Any angles, at rest; the target uniform over a ring that the tip can reach."""
        angle_key, area_key, way_key = jax.random.split(key, 3)
        angles = jax.random.uniform(angle_key, (2,), minval=-np.pi, maxval=np.pi)
        radius = jnp.sqrt(jax.random.uniform(area_key, minval=NEAREST**2, maxval=FARTHEST**2))
        way = jax.random.uniform(way_key, minval=-np.pi, maxval=np.pi)
        target = radius * jnp.stack([jnp.cos(way), jnp.sin(way)])
        state = jnp.concatenate([angles, jnp.zeros(2), target])
        return state, observe(state)

    def state_of(self, observation: Observation) -> State:
        seen = jnp.asarray(observation)
        return jnp.concatenate([jnp.arctan2(seen[2:4], seen[0:2]), seen[4:8]])

    def step(self, state: Float[Array, "6"], action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        action = jnp.clip(jnp.asarray(action, state.dtype), -1.0, 1.0)
        torques = jnp.asarray(TORQUES, state.dtype) * action
        friction = jnp.asarray(FRICTION, state.dtype)
        arm = state[:4]
        for _ in range(SUBSTEPS):
            arm = runge_kutta(lambda x: rate_of_change(x, torques, friction), arm, TIME_STEP / SUBSTEPS)
        state = jnp.concatenate([arm, state[4:]])
        observation, never = observe(state), jnp.zeros((), bool)
        # A little more than 0, where the root has no derivative.
        distance = jnp.sqrt(jnp.sum(observation[8:] ** 2) + 1e-12)
        reward = -distance - EFFORT * jnp.sum(action**2)
        return state, Timestep(observation, reward, never, never, observation, {})

    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """The ring is the target; the tip leaves a trail."""
        far = 2 * LENGTH
        sheet = Canvas((-1.1, -1.1), (1.1, 1.1))
        sheet.disc((0, 0), far, MIST, far - 0.01)
        links = lambda s: LENGTH * np.array([(np.cos(q), np.sin(q)) for q in np.cumsum(np.asarray(s, float)[:2])])  # noqa: E731
        sheet.disc(np.asarray(state, float)[4:], 0.08, GREEN, 0.055)
        sheet.line([links(s).sum(0) for s in (*earlier, state)], 0.015, ORANGE)
        draw_links(sheet, links(state), 0.07)
        return sheet.picture()


def tip(angles: Float[Array, "2"]) -> Float[Array, "2"]:
    """Where the arm ends, the shoulder at the origin."""
    first, both = angles[0], angles[0] + angles[1]
    return LENGTH * jnp.stack([jnp.cos(first) + jnp.cos(both), jnp.sin(first) + jnp.sin(both)])


def observe(state: Float[Array, "6"]) -> Float[Array, "10"]:
    """What is seen of a state: no jump where an angle passes π."""
    angles, target = state[:2], state[4:]
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles), state[2:4], target, tip(angles) - target])


def rate_of_change(
    arm: Float[Array, "4"], torques: Float[Array, "2"], friction: Float[Array, "2"]
) -> Float[Array, "4"]:
    """Time derivative of angles and velocities: the equation of motion solved for the accelerations."""
    bend, spins = arm[1], arm[2:]
    coupling = MASS * LENGTH * CENTRE
    mass_22 = INERTIA + MASS * CENTRE**2
    mass_12 = mass_22 + coupling * jnp.cos(bend)
    mass_11 = 2 * mass_22 + MASS * LENGTH**2 + 2 * coupling * jnp.cos(bend)
    swing = coupling * jnp.sin(bend)
    turning = swing * jnp.stack([-spins[1] * (2 * spins[0] + spins[1]), spins[0] ** 2])
    force_1, force_2 = torques - turning - friction * spins
    determinant = mass_11 * mass_22 - mass_12**2
    accelerations = jnp.stack(
        [
            (mass_22 * force_1 - mass_12 * force_2) / determinant,
            (mass_11 * force_2 - mass_12 * force_1) / determinant,
        ]
    )
    return jnp.concatenate([spins, accelerations])
