"""Planar navigation: where moves lead, by hand, and a picture that tells the position."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.envs import PlanarNavigation
from rewardtogo.envs.planar_navigation import BORDER, GOAL, OBSTACLES, RADIUS, blocked, picture

KEY = jax.random.key(0)
ENV = PlanarNavigation()
STEP = jax.jit(ENV.step)
PICTURES = jax.jit(jax.vmap(lambda p: picture(p, 16)))


def at(*numbers: float) -> jax.Array:
    return jnp.asarray(numbers, jnp.float32)


def test_moves_by_hand():
    """Free, too long, at the border, into an obstacle head-on and aslant; the reward is that of where it ends."""
    x, y = OBSTACLES[2]
    aslant = np.array([0.33 + 0.1, 0.5 + 0.02]) - (x, y)
    cases = [
        (at(0.5, 0.3), at(0.05, -0.02), (0.55, 0.28)),
        (at(0.5, 0.3), at(1.0, 0.0), (0.6, 0.3)),
        (at(0.12, 0.5), at(-0.1, 0.0), (BORDER, 0.5)),
        (at(0.3, 0.55), at(0.1, 0.0), (x - RADIUS, y)),
        (at(0.33, 0.5), at(0.1, 0.02), (x, y) + RADIUS * aslant / np.linalg.norm(aslant)),
    ]
    for start, move, end in cases:
        state, timestep = STEP(start, move, KEY)
        assert np.allclose(state, end, atol=1e-5), (start, move)
        assert float(timestep.reward) == pytest.approx(-((np.array(end) - GOAL) ** 2).sum(), abs=1e-5)
        assert not timestep.terminated and not timestep.truncated
        assert np.array_equal(timestep.observation, PICTURES(state[None])[0])


def test_starts_are_free_and_everywhere():
    states, pictures = jax.jit(jax.vmap(ENV.reset))(jax.random.split(KEY, 2000))
    assert not bool(jax.vmap(blocked)(states).any())
    assert float(states.min()) >= BORDER and float(states.max()) <= 1 - BORDER
    counts = np.histogram2d(*np.asarray(states).T, bins=3, range=[[BORDER, 1 - BORDER]] * 2)[0]
    assert counts.min() > 100 and pictures.shape == (2000, 16, 16, 1)


def test_no_walk_enters_an_obstacle():
    def walk(state, move):
        state, _ = ENV.step(state, move, KEY)
        return state, state

    moves = jax.random.uniform(KEY, (2000, 2), minval=-0.1, maxval=0.1)
    path = jax.jit(lambda s: jax.lax.scan(walk, s, moves)[1])(at(0.5, 0.4))
    gaps = np.linalg.norm(np.asarray(path)[:, None] - np.asarray(OBSTACLES), axis=-1)
    assert gaps.min() >= RADIUS - 1e-5 and (gaps.min(1) < RADIUS + 1e-5).any()


def test_the_picture_tells_the_position():
    """What brightens when the agent is drawn has its middle there, to a tenth of a pixel where no obstacle is near."""
    middle = np.random.default_rng(0).uniform(0.1, 0.9, (400, 2))
    far = np.linalg.norm(middle[:, None] - np.asarray(OBSTACLES), axis=-1).min(1) > 0.25
    middle = jnp.asarray(middle[far], jnp.float32)
    pictures = np.asarray(PICTURES(middle), float)[..., 0]
    bare = np.asarray(PICTURES(at(-1.0, -1.0)[None]), float)[0, ..., 0]
    agent, places = pictures - bare, (np.arange(16) + 0.5) / 16
    right, down = (agent.sum(1) * places).sum(1), (agent.sum(2) * places).sum(1)
    error = np.stack([right, down], 1) / agent.sum((1, 2))[:, None] - np.asarray(middle)
    assert len(middle) > 20 and np.abs(error).max() < 0.1 / 16
    assert bare.max() == 127 and pictures.max() == 255


def test_it_has_a_name():
    env = rtg.make("PlanarNavigation", 2)
    assert env.observation_space.shape == (16, 16, 1) and env.action_space.shape == (2,)
    with pytest.raises(ValueError, match="8 by 8"):
        PlanarNavigation(4)
