import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithms_under_test import jit
from rewardtogo.envs.catch import Catch

ENV = Catch()


def play(key, policy):
    """Pictures, rewards and ends of an episode of the default board."""

    def step(loop, _):
        state, t = ENV.step(loop[0], policy(loop[0]), key)
        return (state, t.observation), (t.observation, t.reward, t.terminated)

    state, first = ENV.reset(key)
    return first, *jax.lax.scan(step, (state, first), None, length=9)[1]


def test_a_game_by_hand():
    """The ball falls a row a step; chasing it always catches it, fleeing from it never does."""
    chase = lambda s: jnp.sign(s.column - s.paddle) + 1  # noqa: E731
    flee = lambda s: jnp.where(s.column < 2, 2, 0)  # noqa: E731
    keys = jax.random.split(jax.random.key(0), 40)
    for policy, worth in ((chase, 1.0), (flee, -1.0)):
        first, pictures, rewards, ends = jit(jax.vmap(lambda k: play(k, policy)))(keys)  # noqa: B023
        np.testing.assert_array_equal(rewards, [[0.0] * 8 + [worth]] * 40)
        np.testing.assert_array_equal(ends, [[False] * 8 + [True]] * 40)
    assert first.dtype == jnp.uint8
    columns = np.asarray(first[:, 0, :, 0]).argmax(1)
    assert set(columns.tolist()) == set(range(5))
    for i in range(8):
        np.testing.assert_array_equal(np.asarray(pictures[:, i, i + 1, :, 0]).argmax(1), columns)
    assert np.all(np.asarray(first).sum((1, 2, 3)) == 2 * 255)


def test_a_board_that_is_too_low_is_refused():
    with pytest.raises(ValueError, match="2 rows and 7 columns"):
        Catch(2, 7)
