"""The camera's double integrator: moves by hand, a picture that tells the position, and regulators that forces do not bound."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.envs import PixelDoubleIntegrator
from rewardtogo.envs.pixel_double_integrator import MOST, NOISE, START, VIEW, cost, dynamics, noise, picture
from rewardtogo.planning import LQProblem, riccati

KEY = jax.random.key(0)
ENV = PixelDoubleIntegrator()
STEP = jax.jit(jax.vmap(ENV.step))
PICTURES = jax.jit(jax.vmap(lambda p: picture(p, 16)))


def test_moves_by_hand():
    """In the mean over noise, whose deviation is right; forces are clipped and paid for as clipped; rewards are of the state left."""
    state, force = jnp.asarray([0.5, -0.3, 0.2, 0.1]), jnp.asarray([1.0, -9.0])
    states, timestep = STEP(jnp.tile(state, (4000, 1)), jnp.tile(force, (4000, 1)), jax.random.split(KEY, 4000))
    wanted = [0.5 + 0.08 + 0.08, -0.3 + 0.04 - 0.12, 0.2 + 0.4, 0.1 - 0.6]
    assert np.allclose(states.mean(0), wanted, atol=4 * NOISE / 4000**0.5)
    assert np.allclose(states.std(0), [0, 0, NOISE, NOISE], atol=1e-3)
    paid = 0.5 * (0.25 + 0.09 + 0.1 * (0.04 + 0.01) + 0.5 * (1.0 + MOST**2))
    assert np.allclose(timestep.reward, -paid, atol=1e-5)
    assert not timestep.terminated.any() and not timestep.truncated.any()
    assert np.array_equal(timestep.observation, PICTURES(states[:, :2]))


def test_the_picture_tells_the_position():
    """The middle of the bright pixels, to a tenth of a pixel."""
    middle = jnp.asarray(np.random.default_rng(0).uniform(-1.1, 1.1, (300, 2)), jnp.float32)
    pictures = np.asarray(PICTURES(middle), float)[..., 0]
    at = ((np.arange(16) + 0.5) / 16 * 2 - 1) * VIEW
    right, down = (pictures.sum(1) * at).sum(1), (pictures.sum(2) * at).sum(1)
    error = np.stack([right, down], 1) / pictures.sum((1, 2))[:, None] - np.asarray(middle)
    assert np.abs(error).max() < 0.1 * 2 * VIEW / 16
    assert pictures.max() == 255 and PICTURES(jnp.full((1, 2), 3.0)).max() == 0


def test_starts():
    states, pictures = jax.jit(jax.vmap(ENV.reset))(jax.random.split(KEY, 500))
    assert pictures.shape == (500, 16, 16, 1) and np.all(np.asarray(states[:, 2:]) == 0)
    assert 0.9 * START < float(jnp.abs(states[:, :2]).max()) <= START


def test_the_regulator_keeps_within_the_forces_and_the_picture():
    """From every corner: so that bounds matter to no optimal policy, and the regulator's cost is the least."""
    problem = LQProblem(dynamics(), cost(), 15, noise=noise())
    regulator = riccati(problem).value
    for corner in ([START, START], [START, -START], [-START, START], [-START, -START]):
        x = np.array([*corner, 0.0, 0.0])
        for t in range(15):
            u = np.asarray(regulator.K[t]) @ x
            assert np.abs(u).max() < 0.75 * MOST and np.abs(x[:2]).max() <= START + 1e-6
            x = dynamics() @ np.concatenate([x, u])
        assert np.linalg.norm(x[:2]) < 0.1


def test_it_has_a_name():
    env = rtg.make("PixelDoubleIntegrator", 2)
    assert env.observation_space.shape == (16, 16, 2) and env.action_space.shape == (2,)
    with pytest.raises(ValueError, match="8 by 8"):
        PixelDoubleIntegrator(4)
