"""The uniform replay: draws, eviction, next observations, and what a batch's steps have to do with each other (notes 6 and 6.1)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import rewardtogo as rtg
from algorithms_under_test import jit
from recorder import Recorder
from rewardtogo.core import Transition
from rewardtogo.data.replay import ReplayState
from rewardtogo.envs.probes import CountingEnv
from rewardtogo.envs.time_limit import TimeLimit

KEY = jax.random.key(0)
ROWS, ENVS, UNROLL = 12, 2, 3
MEMORY = rtg.UniformReplay(ROWS * ENVS)


def block(first: Any) -> Transition:
    """Rows `first`, `first + 1`, ...: the reward says which row and environment it was."""
    time = (first + jnp.arange(UNROLL, dtype=jnp.float32))[:, None] + 100.0 * jnp.arange(ENVS)[None]
    never = jnp.zeros((UNROLL, ENVS), bool)
    return Transition(time[..., None], time.astype(jnp.int32), time, never, never, time[..., None] + 1, {})


add = jit(lambda state, first: MEMORY.add(state, block(first)))


def after(blocks: int) -> ReplayState:
    state = MEMORY.init(block(0), UNROLL)
    for i in range(blocks):
        state = add(state, UNROLL * i)
    return state


def test_draws_are_uniform(item):
    draws = 20_000
    sample = jit(lambda s: MEMORY.sample(s, KEY, draws))
    for blocks in (2, 7):
        batch = sample(after(blocks))
        rows = min(UNROLL * blocks, ROWS)
        counts = np.bincount(np.asarray(batch.indices), minlength=rows * ENVS)
        assert len(counts) == rows * ENVS
        with item("6.2") as check:
            check(stats.chisquare(counts).pvalue, ">", 1e-3, f"chi-square of draws from {rows} rows: uniform")
        np.testing.assert_array_equal(batch.weights, 1.0)


def test_the_oldest_go_first(item):
    """Blocks are overwritten in the order in which they came, exactly; nothing else is."""
    wrong = 0
    for blocks in range(1, 10):
        state = after(blocks)
        kept = np.asarray(state.storage.reward)[: int(state.filled)]
        last = UNROLL * blocks
        expected = {float(t + 100 * e) for t in range(max(0, last - ROWS), last) for e in range(ENVS)}
        wrong += set(kept.ravel().tolist()) != expected
    with item("6.2") as check:
        check(wrong, "==", 0, "fillings in which not exactly the newest steps are kept")
        check(MEMORY.init(block(0), UNROLL).storage.reward.size, "==", ROWS * ENVS, "capacity")


def test_the_next_observation_of_an_end_is_from_before_the_reset(item):
    """Episodes of 9 are cut after 4: what is stored is where the action led, and both ends stay apart."""
    wrong, ends = 0, 0
    for limit, ends_by in ((4, "truncated"), (20, "terminated")):
        env = rtg.vectorize(TimeLimit(CountingEnv(9), limit), 2)
        loop = rtg.OffPolicy(env, Recorder("transitions"), rtg.UniformReplay(512), unroll=3, warm_up=30, batch_size=500)
        _, (metrics, _) = jit(lambda key, loop=loop: loop.step(loop.init(key), key))(KEY)
        t = jax.device_get(metrics["batch"].transitions)
        last = t.observation[:, 0] == min(limit, 9) - 1
        wrong += int((t.next_observation != t.observation + 1).sum())
        wrong += int((getattr(t, ends_by) != last).sum()) + int((t.truncated & t.terminated).sum())
        ends += int(last.sum())
    with item("6.2") as check:
        check(wrong, "==", 0, "next observations or flags that are not the environment's own")
        check(ends, ">", 50, "ends of episodes among the draws")


def lag(values: np.ndarray) -> float:
    """Correlation of neighbours."""
    return float(np.corrcoef(values[:-1], values[1:])[0, 1])


def test_neighbours_in_a_batch_have_nothing_to_do_with_each_other(item):
    """As steps come, an index is the one before plus one, and states hardly differ; out of the replay neither is so."""
    env = rtg.make("Pendulum-v1", 1)
    loop = rtg.OffPolicy(env, Watching(), rtg.UniformReplay(2000), unroll=4, warm_up=2000, batch_size=2000)
    state, (metrics, _) = jit(lambda key: loop.step(loop.init(key), key))(KEY)
    online = np.asarray(state.replay.storage.observation)[:, 0, 2]
    batch = metrics["batch"]
    with item("6.1") as check:
        check(lag(np.arange(2000.0)), ">", 0.99, "autocorrelation of indices, as steps come")
        check(abs(lag(np.asarray(batch.indices, float))), "<", 0.08, "autocorrelation of minibatch indices")
        check(lag(online), ">", 0.8, "autocorrelation of a state, as steps come")
        check(
            abs(lag(np.asarray(batch.transitions.observation)[:, 2])),
            "<",
            0.08,
            "autocorrelation of a state in a batch",
        )


class Watching(Recorder):
    """Acts in Pendulum, at random."""

    kind: str = "transitions"

    def policy(self, state: Any, explore: bool) -> Any:
        del state, explore
        from rewardtogo.core import env_spec
        from rewardtogo.loops import RandomPolicy

        return RandomPolicy(env_spec(rtg.make("Pendulum-v1", 1)))


@pytest.mark.parametrize(
    ("frames", "match"), [(-1, "UniformReplay.frames must be"), (2, r"this environment observes float32 \(1,\)")]
)
def test_frames_of_what_is_no_picture_are_refused(frames, match):
    with pytest.raises(ValueError, match=match):
        rtg.UniformReplay(64, frames=frames).init(block(0), UNROLL)
