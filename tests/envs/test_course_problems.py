"""Obstacles, Reacher and the swing-up of a cart-pole: dynamics against oracles in float64, and what a step gives."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rewardtogo as rtg
from rewardtogo.envs import CartPoleSwingUp, Obstacles, Reacher, cartpole_swing_up, obstacles, reacher
from rewardtogo.envs.cartpole import CART_MASS, FORCE, GRAVITY, HALF_LENGTH, POLE_MASS

KEY = jax.random.key(0)
RNG = np.random.default_rng(0)


def stepper(env):
    """Many steps side by side, compiled."""
    return jax.jit(jax.vmap(lambda state, action: env.step(state, action, KEY)))


ACROSS, REACH, SWING = stepper(Obstacles()), stepper(Reacher()), stepper(CartPoleSwingUp())


# Obstacles


def touches(start: np.ndarray, end: np.ndarray) -> bool:
    """Whether a segment touches a wall, by its ends and by where it crosses the lines of the wall's sides."""
    for left, low, right, high in obstacles.WALLS:
        inside = lambda p: left <= p[0] <= right and low <= p[1] <= high  # noqa: B023, E731
        if inside(start) or inside(end):
            return True
        for axis, line in ((0, left), (0, right), (1, low), (1, high)):
            before, after = start[axis] - line, end[axis] - line
            if before * after < 0:
                crossing = start + (end - start) * before / (before - after)
                across = crossing[1 - axis]
                if (low, left)[axis] <= across <= (high, right)[axis]:
                    return True
    return False


def test_moves_stop_at_walls_and_at_the_border():
    """4,000 moves from free places, a third of them beside a wall, against a search for crossings in float64."""
    places = RNG.uniform(-1, 1, (6000, 2))
    walls = np.asarray(obstacles.WALLS)[RNG.integers(0, len(obstacles.WALLS), 6000)]
    near = (
        walls[:, :2] + RNG.uniform(0, 1, (6000, 2)) * (walls[:, 2:] - walls[:, :2]) + RNG.uniform(-0.1, 0.1, (6000, 2))
    )
    places[::2] = near[::2]
    places = places[[not touches(p, p) for p in places]][:4000].astype(np.float32)
    moves = RNG.uniform(-1.5, 1.5, places.shape).astype(np.float32)
    moves[::50, 0], moves[1::50, 1] = 0.0, 0.0
    goals = RNG.uniform(-1, 1, places.shape).astype(np.float32)
    after, timestep = ACROSS(jnp.asarray(np.hstack([places, goals])), jnp.asarray(moves))
    wanted = np.clip(places.astype(float) + obstacles.STRIDE * np.clip(moves, -1, 1), -1, 1)
    stopped = np.array([touches(a, b) for a, b in zip(places.astype(float), wanted, strict=True)])
    assert len(places) == 4000 and 200 < stopped.sum() < 2000 and (np.abs(wanted) == 1).any()
    assert np.allclose(after[:, :2], np.where(stopped[:, None], places, wanted), atol=1e-6)
    assert np.array_equal(after[:, 2:], goals) and np.array_equal(timestep.observation, after)
    assert np.allclose(timestep.reward, -np.linalg.norm(after[:, :2] - goals, axis=1), atol=2e-6)
    assert not timestep.terminated.any() and not timestep.truncated.any()


def test_the_straight_way_is_walled_up():
    """From nearly every start to its goal; and episodes begin and end where they should."""
    states = np.asarray(jax.jit(jax.vmap(Obstacles().reset))(jax.random.split(KEY, 1000))[0], np.float64)
    for part, (low, high) in ((states[:, :2], obstacles.START), (states[:, 2:], obstacles.GOAL)):
        assert (part >= np.array(low) - 1e-6).all() and (part <= np.array(high) + 1e-6).all()
        assert np.allclose(part.mean(0), (np.array(low) + np.array(high)) / 2, atol=0.03)
    assert np.mean([touches(s[:2], s[2:]) for s in states]) > 0.9
    assert not any(touches(s[:2], s[:2]) or touches(s[2:], s[2:]) for s in states)


# Reacher


def tip_of_link(q: Any, share: float, link: int) -> jax.Array:
    """A place on a link, as a function of the angles."""
    first, both = q[0], q[0] + q[1]
    if link == 0:
        return share * reacher.LENGTH * jnp.stack([jnp.cos(first), jnp.sin(first)])
    elbow = reacher.LENGTH * jnp.stack([jnp.cos(first), jnp.sin(first)])
    return elbow + share * reacher.LENGTH * jnp.stack([jnp.cos(both), jnp.sin(both)])


def kinetic(q: jax.Array, spins: jax.Array) -> jax.Array:
    """Kinetic energy, from nothing but the mass along the rods: Gauss's rule of two points is exact for squares."""
    total = jnp.zeros((), q.dtype)
    for link in range(2):
        for share in (0.5 - 0.5 / np.sqrt(3), 0.5 + 0.5 / np.sqrt(3)):
            velocity = jax.jvp(lambda x, s=share, i=link: tip_of_link(x, s, i), (q,), (spins,))[1]
            total = total + 0.5 * reacher.MASS / 2 * (velocity**2).sum()
    return total


def lagrange(x: jax.Array, torques: jax.Array) -> jax.Array:
    """Lagrange's equations of that energy, by automatic derivatives: M q'' = u - b q' + dT/dq - (dM/dt) q'."""
    q, spins = x[:2], x[2:]
    momentum = jax.grad(kinetic, 1)
    mass = jax.jacobian(momentum, 1)(q, spins)
    moved = jax.jvp(lambda a: momentum(a, spins), (q,), (spins,))[1]
    forces = torques - jnp.asarray(reacher.FRICTION) * spins + jax.grad(kinetic)(q, spins) - moved
    return jnp.concatenate([spins, jnp.linalg.solve(mass, forces)])


def test_the_arm_obeys_lagrange():
    """Accelerations of 200 states in float64; a step against an integration to 1e-12."""
    with jax.enable_x64(True):
        arms, torques = RNG.uniform(-4, 4, (200, 4)), RNG.uniform(-1, 1, (200, 2)) * reacher.TORQUES
        friction = jnp.asarray(reacher.FRICTION)
        ours = jax.jit(jax.vmap(lambda x, u: reacher.rate_of_change(x, u, friction)))(arms, torques)
        oracle = jax.jit(lagrange)
        assert np.allclose(ours, jax.jit(jax.vmap(lagrange))(arms, torques), atol=1e-10)
        ends = [
            solve_ivp(lambda _, x, u=u: np.asarray(oracle(x, u)), (0, 0.1), x, rtol=1e-10, atol=1e-10).y[:, -1]
            for x, u in zip(arms[:10], torques[:10], strict=True)
        ]
    targets = np.full((10, 2), 0.3)
    states = jnp.asarray(np.hstack([arms[:10], targets]), jnp.float32)
    after, timestep = REACH(states, jnp.asarray(torques[:10] / reacher.TORQUES, jnp.float32))
    assert np.allclose(after[:, :4], ends, atol=2e-3)
    tips = np.array([tip_of_link(x, 1.0, 1) for x in np.array(ends)])
    distance = np.linalg.norm(tips - targets, axis=1)
    cost = reacher.EFFORT * ((torques[:10] / reacher.TORQUES) ** 2).sum(1)
    assert np.allclose(timestep.reward, -distance - cost, atol=2e-3)
    assert not timestep.terminated.any() and not timestep.truncated.any()


def test_the_arm_keeps_its_energy():
    """Without friction and torques the integrator loses less than two thousandths in 5 s, and with half its step, being of fourth order, a
    sixteenth of that or less; with friction the energy only falls.
    """
    with jax.enable_x64(True):
        arms = jnp.asarray(RNG.uniform(-2, 2, (50, 4)))

        def run(x, friction, steps):
            def step(x, _):
                rate = lambda y: reacher.rate_of_change(y, jnp.zeros(2), friction)  # noqa: E731
                x = reacher.runge_kutta(rate, x, 5.0 / steps)
                return x, kinetic(x[:2], x[2:])

            return jax.lax.scan(step, x, None, length=steps)[1]

        many = jax.jit(jax.vmap(run, (0, None, None)), static_argnums=2)
        steps = round(5.0 / reacher.TIME_STEP) * reacher.SUBSTEPS
        first = np.asarray(jax.vmap(lambda x: kinetic(x[:2], x[2:]))(arms))
        free = np.asarray(many(arms, jnp.zeros(2), steps))
        finer = np.asarray(many(arms, jnp.zeros(2), 2 * steps))
        slowed = np.asarray(many(arms, jnp.asarray(reacher.FRICTION), steps))
    lost, less = (np.abs(path / first[:, None] - 1).max() for path in (free, finer))
    assert lost < 2e-3 and less < lost / 12
    assert (np.diff(slowed, axis=1) <= 1e-9).all() and (slowed[:, -1] / first).max() < 0.2


def test_the_arm_begins_anywhere_and_can_reach():
    states, seen = jax.jit(jax.vmap(Reacher().reset))(jax.random.split(KEY, 2000))
    radius = np.linalg.norm(states[:, 4:], axis=1)
    assert radius.min() >= reacher.NEAREST - 1e-6 and radius.max() <= reacher.FARTHEST + 1e-6
    # Uniform over the ring: a quarter of its area lies inside this radius.
    quarter = np.sqrt(0.75 * reacher.NEAREST**2 + 0.25 * reacher.FARTHEST**2)
    assert abs((radius < quarter).mean() - 0.25) < 0.04
    back = jax.vmap(Reacher().state_of)(seen)
    assert np.allclose(back, states, atol=1e-5)
    assert np.allclose(seen[:, 8:], jax.vmap(reacher.tip)(states[:, :2]) - states[:, 4:], atol=1e-6)


# Swing-up


def energy(x: np.ndarray) -> np.ndarray:
    """Of cart and pole, a uniform rod: both move along, the rod turns, and its middle is lifted."""
    _, velocity, angle, spin = np.moveaxis(x, -1, 0)
    middle = np.stack([velocity + HALF_LENGTH * spin * np.cos(angle), -HALF_LENGTH * spin * np.sin(angle)])
    turning = POLE_MASS * (2 * HALF_LENGTH) ** 2 / 12
    moving = 0.5 * CART_MASS * velocity**2 + 0.5 * POLE_MASS * (middle**2).sum(0) + 0.5 * turning * spin**2
    return moving + POLE_MASS * GRAVITY * HALF_LENGTH * np.cos(angle)


def test_the_pole_keeps_its_energy_and_gains_what_is_put_in():
    """dE/dt is force times the cart's velocity, by differences in float64; without a force a hundred steps lose a thousandth."""
    with jax.enable_x64(True):
        states, forces = RNG.uniform(-3, 3, (200, 4)), RNG.uniform(-FORCE, FORCE, 200)
        rates = np.asarray(jax.jit(jax.vmap(cartpole_swing_up.rate_of_change))(states, forces))
        power = (energy(states + 1e-6 * rates) - energy(states - 1e-6 * rates)) / 2e-6
        assert np.allclose(power, forces * states[:, 1], atol=1e-6)

        def step(x, _):
            rate = lambda y: cartpole_swing_up.rate_of_change(y, jnp.zeros(()))  # noqa: E731
            x = cartpole_swing_up.runge_kutta(rate, x, cartpole_swing_up.TIME_STEP)
            return x, x

        path = np.asarray(jax.jit(jax.vmap(lambda x: jax.lax.scan(step, x, None, length=100)[1]))(jnp.asarray(states)))
        span = POLE_MASS * GRAVITY * 2 * HALF_LENGTH
        assert np.abs(energy(path) - energy(states)[:, None]).max() < 2e-3 * span


def test_a_swing_against_a_fine_integration():
    states, pushes = RNG.uniform(-3, 3, (20, 4)), RNG.uniform(-1.5, 1.5, (20, 1))
    after, timestep = SWING(jnp.asarray(states, jnp.float32), jnp.asarray(pushes, jnp.float32))
    with jax.enable_x64(True):
        rate = jax.jit(cartpole_swing_up.rate_of_change)
        clipped = np.clip(pushes[:, 0], -1, 1)
        ends = np.array(
            [
                solve_ivp(lambda _, x, u=u: np.asarray(rate(x, FORCE * u)), (0, 0.05), s, rtol=1e-10, atol=1e-10).y[
                    :, -1
                ]
                for s, u in zip(states, clipped, strict=True)
            ]
        )
    assert np.allclose(after, ends, atol=1e-4)
    tips = np.stack([ends[:, 0] + np.sin(ends[:, 2]), np.cos(ends[:, 2])], 1)
    reward = np.exp(-((tips - [0.0, 1.0]) ** 2).sum(1)) - cartpole_swing_up.EFFORT * clipped**2
    assert np.allclose(timestep.reward, reward, atol=1e-4)
    assert not timestep.terminated.any() and not timestep.truncated.any()
    back = jax.vmap(CartPoleSwingUp().state_of)(timestep.observation)
    assert np.allclose(np.cos(back[:, 2]), np.cos(ends[:, 2]), atol=1e-4) and np.allclose(
        back[:, 3], ends[:, 3], atol=1e-4
    )


def test_the_pole_begins_hanging():
    states, seen = jax.jit(jax.vmap(CartPoleSwingUp().reset))(jax.random.split(KEY, 500))
    assert np.allclose(states.mean(0), [0, 0, np.pi, 0], atol=0.01) and float(seen[:, 2].max()) < -0.97
    assert float(jax.vmap(cartpole_swing_up.standing)(states).max()) < 0.03
    assert float(cartpole_swing_up.standing(jnp.zeros(4))) == 1.0


@pytest.mark.parametrize(("name", "seen", "acts"), [("Obstacles", 4, 2), ("Reacher", 10, 2), ("CartPoleSwingUp", 5, 1)])
def test_they_have_names(name, seen, acts):
    env = rtg.make(name, 2)
    assert env.observation_space.shape == (seen,) and env.action_space.shape == (acts,)
