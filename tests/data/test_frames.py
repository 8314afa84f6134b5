"""Pictures stored once give, bit for bit, what storing everything gives: starts, both ends, the seam of the ring, sequences."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import MASK, Transition
from rewardtogo.data.replay import ReplayState

KEY = jax.random.key(0)
ENVS, SHAPE = 2, (3, 2)


def play(
    steps: int, frames: int, channels: int, shortest: int, blank: bool, both: bool = True, seed: int = 0
) -> Transition:
    """Random pictures, stacked as wrappers do, `[steps, B]`; episodes of `shortest` to twice as many steps, ending both ways."""
    rng = np.random.default_rng(seed)
    picture = lambda: rng.integers(1, 256, (*SHAPE, channels), dtype=np.uint8)  # noqa: E731
    columns = []
    for _ in range(ENVS):
        stack: list[np.ndarray] = []
        rows = []
        left = 0
        for _ in range(steps):
            if left == 0:
                first, left = picture(), int(rng.integers(shortest, 2 * shortest))
                stack = [np.zeros_like(first) if blank else first] * (frames - 1) + [first]
            following, left = [*stack[1:], picture()], left - 1
            cut = left == 0 and (rng.random() < 0.5 if both else True)
            ended = left == 0 and not cut
            join = lambda s: np.concatenate(s, -1)  # noqa: E731
            rows.append((join(stack), rng.integers(3), rng.normal(), ended, cut, join(following), rng.random()))
            stack = following
        columns.append([np.stack(x) for x in zip(*rows, strict=True)])
    see, act, reward, terminated, truncated, after, other = (np.stack(x, 1) for x in zip(*columns, strict=True))
    part = {"picture": jnp.asarray(see), "number": jnp.asarray(other, jnp.float32)}
    then = {"picture": jnp.asarray(after), "number": jnp.asarray(other + 1, jnp.float32)}
    flags = jnp.asarray(terminated), jnp.asarray(truncated)
    return Transition(part, jnp.asarray(act, jnp.int32), jnp.asarray(reward, jnp.float32), *flags, then, {})


def blocks(t: Transition, unroll: int) -> list[Transition]:
    return [jax.tree.map(lambda x: x[i : i + unroll], t) for i in range(0, len(t.reward), unroll)]  # noqa: B023


def assert_same(a: Any, b: Any) -> None:
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("frames", "channels", "unroll", "shortest"), [(3, 2, 3, 8), (4, 1, 2, 12), (4, 1, 12, 2), (1, 3, 3, 8)]
)
def test_batches_are_those_of_storing_everything(frames, channels, unroll, shortest, item):
    """Compared after every block, until the ring of 24 rows has gone round twice: every row is read, sequences of 5 too.

    Episodes as short as 2 are in: there a last picture may be lost, which the weight must say and the rest survive.
    """
    once, all_of_it = rtg.UniformReplay(24 * ENVS, frames=frames), rtg.UniformReplay(24 * ENVS)

    @jit
    def step(states: tuple[ReplayState, ReplayState], block: Transition) -> Any:
        states = once.add(states[0], block), all_of_it.add(states[1], block)
        drawn = [memory.sample(s, KEY, 64) for memory, s in zip((once, all_of_it), states, strict=True)]
        enough = [dataclasses.replace(s, filled=jnp.maximum(s.filled, 5)) for s in states]
        runs = [m.sample_sequences(s, KEY, 64, 5) for m, s in zip((once, all_of_it), enough, strict=True)]
        return states, drawn, runs

    compared = lost = 0
    for blank in (False, True):
        t = play(60 // unroll * unroll, frames, channels, shortest, blank)
        first = blocks(t, unroll)[0]
        states = once.init(first, unroll), all_of_it.init(first, unroll)
        for block in blocks(t, unroll):
            states, drawn, runs = step(states, block)
            for pair in (drawn, runs) if int(states[0].filled) >= 5 else (drawn,):
                kept = np.asarray(pair[0].weights) > 0
                compared, lost = compared + int(kept.sum()), lost + int((~kept).sum())
                ended = np.asarray(pair[1].transitions.terminated)
                for name in ("observation", "action", "reward", "terminated", "truncated"):
                    assert_same(getattr(pair[0].transitions, name), getattr(pair[1].transitions, name))
                seen, wanted = (np.asarray(p.transitions.next_observation["picture"]) for p in pair)
                look = kept[None] & ~ended if ended.ndim == 2 else kept & ~ended
                look = look if shortest < 8 else np.ones_like(look)
                np.testing.assert_array_equal(seen[look], wanted[look])
                assert_same(
                    pair[0].transitions.next_observation["number"], pair[1].transitions.next_observation["number"]
                )
    with item("6.2") as check:
        check(compared, ">", 1000, f"samples that are bit for bit those of storing everything, {frames} frames")
        check(lost, "==" if shortest >= 8 else ">=", 0, "samples with a lost last picture")


def test_lost_last_pictures_show_in_the_weights():
    """Room for 3 last pictures and an end at every second step: terminated steps keep their weight, truncated ones lose it."""
    memory, t = rtg.UniformReplay(24 * ENVS, frames=2), play(24, 2, 1, 2, False)
    state = memory.init(blocks(t, 3)[0], 3)
    for block in blocks(t, 3):
        state = jit(memory.add)(state, block)
    batch = jit(lambda s: memory.sample(s, KEY, 600))(state)
    weights, cut = np.asarray(batch.weights), np.asarray(batch.transitions.truncated)
    row = np.asarray(batch.indices) // ENVS
    assert set(weights.tolist()) == {0.0, 1.0}
    assert np.all(cut[weights == 0])
    assert np.all(weights[~cut] == 1)
    assert row[weights == 0].max() < row[cut & (weights == 1)].max()  # the newest are kept


def test_stacks_that_cannot_be_rebuilt_stop_the_run():
    """A reward of NaN, in the very step: a stack that skips a picture, and one that goes on with the episode before."""
    memory, t = rtg.UniformReplay(24 * ENVS, frames=3), play(24, 3, 1, 8, False)
    add = jit(lambda t: memory.add(memory.init(t, 24), t).storage.reward)
    assert np.isfinite(add(t)).all()
    skips = t.next_observation["picture"].at[5, 0, 0, 0, 0].add(1)
    found = add(dataclasses.replace(t, next_observation={**t.next_observation, "picture": skips}))
    assert np.argwhere(np.isnan(found)).tolist() == [[5, 0]]
    start = int(np.flatnonzero(np.asarray(t.done)[:, 1])[0]) + 1
    goes_on = t.observation["picture"].at[start, 1, 0, 0, 0].add(1)
    found = add(dataclasses.replace(t, observation={**t.observation, "picture": goes_on}))
    assert np.argwhere(np.isnan(found)).tolist() == [[start, 1]]


def test_a_million_atari_steps_take_7_gigabytes(item):
    stack, real = jnp.zeros((4, 1, 84, 84, 4), jnp.uint8), jnp.zeros((4, 1))
    example = Transition(stack, real.astype(jnp.int32), real, real > 0, real > 0, stack, {})

    def size(frames: int) -> float:
        """Only shapes are computed."""
        state = jax.eval_shape(lambda: rtg.UniformReplay(1_000_000, frames=frames).init(example, 4))
        return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)) / 1e9

    with item("6.2") as check:
        check(size(4), "<=", 7.4, "GB of a million stacks of four 84 x 84 pictures, each picture once")
        check(size(0), ">=", 56.0, "GB where everything is stored")


def test_masks_and_numbers_beside_pictures_are_kept_as_they_come():
    t = play(6, 2, 1, 3, False)
    t = dataclasses.replace(t, observation={**t.observation, MASK: jnp.ones((6, ENVS, 3), jnp.int8)})
    t = dataclasses.replace(t, next_observation={**t.next_observation, MASK: jnp.zeros((6, ENVS, 3), jnp.int8)})
    memory = rtg.PrioritisedReplay(12 * ENVS, frames=2, beta=0.5)
    batch = jit(lambda t: memory.sample(memory.add(memory.init(t, 6), t), KEY, 32))(t)
    assert batch.transitions.observation[MASK].min() == 1 and batch.transitions.next_observation[MASK].max() == 0
    row, env = np.asarray(batch.indices) // ENVS, np.asarray(batch.indices) % ENVS
    for name in ("picture", "number", MASK):
        assert_same(batch.transitions.observation[name], np.asarray(t.observation[name])[row, env])


@pytest.mark.parametrize(
    ("frames", "shape", "dtype"), [(3, (4, 4, 4), jnp.uint8), (4, (4, 4, 4), jnp.float32), (4, (4,), jnp.uint8)]
)
def test_what_is_no_stack_of_pictures_is_refused(frames, shape, dtype):
    look = jnp.zeros((2, 1, *shape), dtype)
    real, flag = jnp.zeros((2, 1)), jnp.zeros((2, 1), bool)
    t = Transition(look, real.astype(jnp.int32), real, flag, flag, look, {})
    with pytest.raises(ValueError, match=f"frames={frames} keeps pictures.*use frames=0"):
        rtg.UniformReplay(64, frames=frames).init(t, 2)
