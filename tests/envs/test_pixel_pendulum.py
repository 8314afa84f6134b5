"""The camera's pendulum: the same motion as the one that is told in numbers, and a picture that tells the angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.envs import Pendulum, PixelPendulum
from rewardtogo.envs.pixel_pendulum import picture

KEY = jax.random.key(0)


def test_it_moves_as_pendulum_does():
    actions = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (50, 1)), jnp.float32)
    run = lambda env, s: jax.lax.scan(lambda s, a: env.step(s, a, KEY), s, actions)  # noqa: E731
    state, _ = Pendulum().reset(KEY)
    seen, first = PixelPendulum().reset(KEY)
    assert jnp.array_equal(state, seen)
    end, plain = jax.jit(lambda s: run(Pendulum(), s))(state)
    last, pictures = jax.jit(lambda s: run(PixelPendulum(), s))(state)
    assert jnp.allclose(end, last, atol=1e-5) and jnp.allclose(plain.reward, pictures.reward, atol=1e-5)
    drawn = picture(jnp.arctan2(plain.observation[-1, 1], plain.observation[-1, 0]), 16)
    assert np.abs(np.asarray(pictures.observation[-1], int) - np.asarray(drawn, int)).max() <= 1
    assert first.shape == (16, 16, 1) and first.dtype == jnp.uint8


def test_the_picture_tells_the_angle():
    """The direction of the bright pixels is the rod's; neighbouring pictures of a turn differ, and no two of the circle are the same."""
    angles = jnp.linspace(-np.pi, np.pi, 101)[:-1]
    pictures = np.asarray(jax.jit(jax.vmap(lambda a: picture(a, 16)))(angles), float)[..., 0]
    at = np.arange(16) - 7.5
    x, y = (pictures * at[None, None, :]).sum((1, 2)), -(pictures * at[None, :, None]).sum((1, 2))
    error = (np.arctan2(-x, y) - np.asarray(angles) + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(error).max() < 0.1
    flat = pictures.reshape(100, -1)
    gaps = np.abs(flat[:, None] - flat[None]).sum(-1) + 1e9 * np.eye(100)
    assert gaps.min() > 100
    upright = pictures[50]
    assert upright[2, 7] == 255 and upright[12, 7] == 0


def test_it_has_names():
    two, one = rtg.make("PixelPendulum", 2), rtg.make("PixelPendulumOneFrame", 2)
    assert two.observation_space.shape == (16, 16, 2) and one.observation_space.shape == (16, 16, 1)
    with pytest.raises(ValueError, match="fewer than 4"):
        PixelPendulum(3)
