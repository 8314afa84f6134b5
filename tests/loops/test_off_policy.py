import dataclasses

import jax
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from recorder import Recorder
from rewardtogo.envs.probes import CountingEnv
from rewardtogo.ops import Linear

ENV = rtg.vectorize(CountingEnv(5), 2)
KEY = jax.random.key(0)


def loop(kind: str = "transitions", capacity: int = 40, **options: int) -> rtg.OffPolicy:
    options = {"unroll": 3, "warm_up": 20, "batch_size": 32, "length": 8} | options
    return rtg.OffPolicy(ENV, Recorder(kind), rtg.UniformReplay(capacity), **options)


def test_warm_up_fills_the_replay_with_random_steps():
    off = loop()
    assert (off.steps_per_iteration, off.initial_steps, off.default_num_envs()) == (6, 24, 1)
    state = jit(off.init)(KEY)
    assert int(state.replay.filled) == 12
    stored = jax.tree.map(lambda x: x[:12], state.replay.storage)
    np.testing.assert_array_equal(stored.observation[:, 0, 0], np.arange(12) % 5)
    assert set(np.asarray(stored.action).ravel().tolist()) == {0, 1}
    np.testing.assert_array_equal(stored.extras["updates"], 0)


@pytest.mark.parametrize("kind", ["transitions", "sequences"])
def test_batches_are_consecutive_steps_that_happened(kind):
    """Through the seam of the ring, which holds 18 rows of 2: after 10 iterations it has gone round."""
    off = loop(kind)
    state, step = jit(off.init)(KEY), jit(lambda s, k: off.step(s, k))
    seen = set()
    for i in range(10):
        state, (metrics, _) = step(state, jax.random.fold_in(KEY, i))
        t = metrics["batch"].transitions
        np.testing.assert_array_equal(t.reward, t.observation[..., 0] + 1)
        np.testing.assert_array_equal(t.next_observation, t.observation + 1)
        np.testing.assert_array_equal(t.terminated, t.observation[..., 0] == 4)
        if kind == "sequences":
            assert t.reward.shape == (8, 32)
            np.testing.assert_array_equal(t.observation[1:, :, 0], (t.observation[:-1, :, 0] + 1) % 5)
            np.testing.assert_array_equal(t.extras["carry"], t.observation[..., 0])
            age = np.asarray(t.extras["updates"])
            assert np.all(np.diff(age, axis=0) >= 0)  # no sequence runs over the place where the next row goes
        np.testing.assert_array_equal(metrics["batch"].weights, 1.0)
        seen |= set(np.asarray(t.extras["updates"]).ravel().tolist())
    assert int(state.replay.filled) == 18
    assert int(metrics["updates"]) == 10
    assert max(seen) == 9  # the newest policy's steps are learnt from at once
    assert min(np.asarray(t.extras["updates"]).ravel()) >= 4  # 18 rows are the last 6 iterations


def test_every_row_is_drawn():
    off = loop()
    batch = jit(lambda k: off.replay.sample(off.step(off.init(k), k)[0].replay, k, 2000))(KEY)
    counts = np.bincount(np.asarray(batch.indices), minlength=30)
    assert len(counts) == 30
    assert counts.min() > 30
    assert counts.max() < 110


def test_updates_are_those_asked_for():
    off = loop(updates=1)
    several = dataclasses.replace(off, learner=Mean("transitions"), updates=4)
    state, (metrics, _) = jit(lambda k: several.step(several.init(k), k))(KEY)
    assert int(several.learned(state)["updates"]) == 4
    assert float(metrics["updates"]) == 2.5


class Mean(Recorder):
    """Gives only numbers as metrics."""

    def update(self, state, batch, key):
        state, metrics, feedback = Recorder.update(self, state, batch, key)
        return state, {"updates": metrics["updates"]}, feedback


def test_schedules_are_stretched_over_the_updates():
    off = dataclasses.replace(
        loop(updates=4), learner=dataclasses.replace(Recorder("transitions"), rate=Linear(1.0, 0.0))
    )
    assert off.with_horizon(30).learner.rate.horizon == 120


def test_warm_up_is_long_enough_for_a_sequence():
    off = loop("sequences", warm_up=1)
    assert off.initial_steps == 18
    assert loop("transitions", warm_up=1).initial_steps == 6


@pytest.mark.parametrize(
    ("kind", "options", "match"),
    [
        ("transitions", {"capacity": 5}, "capacity of at least 6"),
        ("transitions", {"batch_size": 41}, "smaller than a batch of 41"),
        ("sequences", {"capacity": 12, "batch_size": 4}, "holds no sequence of 8 steps"),
        ("sequences", {"unroll": 0}, "OffPolicy.unroll must be"),
        ("transitions", {"unroll": 0}, "OffPolicy.unroll must be"),
        ("transitions", {"batch_size": 0}, "OffPolicy.batch_size must be"),
        ("transitions", {"updates": 0}, "OffPolicy.updates must be"),
        ("transitions", {"warm_up": 0}, "OffPolicy.warm_up must be"),
        ("sequences", {"length": 0}, "OffPolicy.length must be"),
    ],
)
def test_what_cannot_be_is_refused(kind, options, match):
    with pytest.raises(ValueError, match=match):
        loop(kind, **options)


def test_the_advice_about_capacity_is_good():
    """What the error says would do, does."""
    with pytest.raises(ValueError, match="at least") as error:
        loop("sequences", capacity=12, batch_size=4)
    advice = int(str(error.value).split("at least ")[1])
    loop("sequences", capacity=advice, batch_size=4)
