"""Prioritised replay against a NumPy oracle: probabilities, weights, new and evicted steps, sequences, the write position."""

import dataclasses
import itertools
import re
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import rewardtogo as rtg
from algorithms_under_test import jit, small, small_env
from recorder import Recorder
from rewardtogo.core import Batch, Transition
from rewardtogo.data import sum_tree
from rewardtogo.data.replay import ReplayState
from rewardtogo.envs.probes import CountingEnv

KEY = jax.random.key(0)
ROWS, ENVS, UNROLL = 12, 2, 3
ALPHA, BETA = 0.7, 0.5
MEMORY = rtg.PrioritisedReplay(ROWS * ENVS, alpha=ALPHA, beta=BETA, offset=0.01)


def block(first: int) -> Transition:
    """Rows `first`, `first + 1`, ...: the reward says which row and environment it was."""
    time = (first + jnp.arange(UNROLL, dtype=jnp.float32))[:, None] + 100.0 * jnp.arange(ENVS)[None]
    never = jnp.zeros((UNROLL, ENVS), bool)
    return Transition(time[..., None], time.astype(jnp.int32), time, never, never, time[..., None] + 1, {})


add = jit(lambda state, first: MEMORY.add(state, block(first)))
tell = jit(lambda state, index, error: MEMORY.feedback(state, batch_of(index), error))


def batch_of(index: Any) -> Batch:
    """Only where it lies and what it weighs counts here."""
    return Batch(block(0), index, jnp.ones(index.shape))


def fresh(length: int = 1) -> ReplayState:
    return MEMORY.init(block(0), UNROLL, length)


def leaves(state: ReplayState) -> np.ndarray:
    return np.ravel(state.order.tree[0])[: ROWS * ENVS].reshape(ROWS, ENVS)


class Oracle:
    """The same by the book: a table of priorities by row and environment."""

    def __init__(self, length: int) -> None:
        self.length, self.largest, self.time = length, 1.0, 0
        self.table = np.zeros((ROWS, ENVS), np.float32)

    def add(self) -> None:
        for _ in range(UNROLL):
            self.time += 1
            begun = self.time - self.length  # the newest row at which a whole sequence begins
            newest = (self.time - 1) % ROWS
            self.table[newest] = 0.0
            if begun >= 0:
                self.table[begun % ROWS] = self.largest
        if self.time >= ROWS:  # rows that a sequence would run over the write position from
            for back in range(1, self.length):
                self.table[(self.time - back) % ROWS] = 0.0

    def tell(self, index: np.ndarray, error: np.ndarray) -> None:
        power = (np.abs(error) + 0.01) ** ALPHA
        self.table[index // ENVS, index % ENVS] = power
        self.largest = max(self.largest, power.max())


@pytest.mark.parametrize("length", [1, 3, 7])
def test_priorities_are_those_of_the_oracle(length, item):
    """Twice round the ring, errors told in between; the largest so far goes to what is new, 0 to what cannot begin a sequence."""
    state, oracle, rng, worst = fresh(length), Oracle(length), np.random.default_rng(0), 0.0
    for i in range(3 * ROWS // UNROLL):
        state = add(state, UNROLL * i)
        oracle.add()
        worst = max(worst, np.abs(leaves(state) - oracle.table).max())
        some = np.flatnonzero(oracle.table.ravel() > 0)
        if len(some):
            index = rng.choice(some, 4)
            error = rng.normal(size=ROWS * ENVS).astype(np.float32)[index] * 3
            state = tell(state, jnp.asarray(index, jnp.int32), jnp.asarray(error))
            oracle.tell(index, error)
            worst = max(worst, np.abs(leaves(state) - oracle.table).max())
    for below, above in itertools.pairwise(state.order.tree):
        np.testing.assert_allclose(np.ravel(above)[: len(below)], below.sum(1), rtol=1e-6)
    with item("6.28") as check:
        check(worst, "<=", 1e-5, f"priorities of sequences of {length}: difference from the oracle")
        check(float(state.order.largest) - oracle.largest, "<=", 1e-5, "largest priority: difference from the oracle")


def filled(length: int = 1) -> ReplayState:
    """Gone once round, every place with an error of its own."""
    state = fresh(length)
    for i in range(ROWS // UNROLL + 1):
        state = add(state, UNROLL * i)
    index = np.flatnonzero(leaves(state).ravel())
    error = np.linspace(0.1, 4.0, len(index), dtype=np.float32)
    return tell(state, jnp.asarray(index, jnp.int32), jnp.asarray(error))


def test_drawing_and_weights_are_the_papers(item):
    state, draws = filled(), 50_000
    batch = jit(lambda s: MEMORY.sample(s, KEY, draws))(state)
    p = leaves(state).ravel().astype(np.float64)
    probability, index = p / p.sum(), np.asarray(batch.indices)
    counts = np.bincount(index, minlength=ROWS * ENVS)
    # Drawing from equal parts of the sum varies less than independent draws, so that the test errs on the side of passing: the counts
    # must lie within 1 of the expected ones besides.
    weight = (ROWS * ENVS * probability[index]) ** -BETA
    with item("6.28") as check:
        check(stats.chisquare(counts, draws * probability).pvalue, ">", 1e-3, "chi-square of draws against priorities")
        check(stats.chisquare(counts).pvalue, "<", 1e-9, "chi-square against uniform draws, which they are not")
        check(np.abs(counts - draws * probability).max(), "<=", 2.0, "draws beside the expected number, stratified")
        check(
            np.abs(batch.weights - weight / weight.max()).max(),
            "<=",
            1e-5,
            "(1 / N P)^beta / max: difference by sample",
        )
        check(float(batch.weights.max()), "==", 1.0, "largest weight")
    np.testing.assert_array_equal(batch.transitions.reward % 100 % ROWS, index // ENVS)
    np.testing.assert_array_equal(batch.transitions.reward // 100, index % ENVS)


def test_weights_make_expectations_those_of_uniform_draws(item):
    """At beta = 1 the weighted mean of anything is its mean over the memory: weights sum to N times the smallest P."""
    whole = dataclasses.replace(MEMORY, beta=1.0)
    state = filled()
    batch = jit(lambda s: whole.sample(s, KEY, 50_000))(state)
    p = leaves(state).ravel().astype(np.float64)
    place = np.asarray(batch.indices, np.float64)
    weighted, mean = float((batch.weights * place).mean() / batch.weights.mean()), (ROWS * ENVS - 1) / 2
    with item("6.28") as check:
        expected = len(p) * (p / p.sum()).min()
        check(abs(float(batch.weights.mean()) / expected - 1), "<=", 1e-3, "mean weight against N min P")
        check(abs(weighted / mean - 1), "<=", 1e-3, "weighted mean of the places against that of the memory")
        check(abs(float(place.mean()) / mean - 1), ">", 0.05, "unweighted it is another")


def test_alpha_0_draws_uniformly_with_weights_1():
    flat = dataclasses.replace(MEMORY, alpha=0.0)
    state = filled()
    index = jnp.arange(ROWS * ENVS, dtype=jnp.int32)
    state = jit(lambda s: flat.feedback(s, batch_of(index), 1.0 + index.astype(jnp.float32)))(state)
    batch = jit(lambda s: flat.sample(s, KEY, 2400))(state)
    np.testing.assert_allclose(batch.weights, 1.0, rtol=1e-6)
    assert np.abs(np.bincount(np.asarray(batch.indices), minlength=ROWS * ENVS) - 100).max() <= 2


def test_beta_follows_its_schedule():
    state, annealed = filled(), rtg.PrioritisedReplay(ROWS * ENVS)
    loop = rtg.OffPolicy(
        rtg.vectorize(small_env(), 1), rtg.DQN(network=small), annealed, updates=2, batch_size=8
    ).with_horizon(5)
    betas = []
    for batches in (0, 5, 10, 99):
        at = dataclasses.replace(state, order=dataclasses.replace(state.order, batches=jnp.asarray(batches, jnp.int32)))
        betas.append(float(loop.replay.at(at.order.batches).beta))
    np.testing.assert_allclose(betas, [0.4, 0.7, 1.0, 1.0], rtol=1e-5)


def test_sequences_are_consecutive_and_end_before_the_write_position():
    length, draws = 7, 2000
    state = filled(length)
    batch = jit(lambda s: MEMORY.sample_sequences(s, KEY, draws, length))(state)
    reward = np.asarray(batch.transitions.reward)
    np.testing.assert_array_equal(np.diff(reward, axis=0), 1.0)
    time, newest = reward % 100, ROWS + UNROLL - 1
    assert time.min() == UNROLL  # older rows are overwritten
    assert time.max() == newest
    assert len(set(np.asarray(batch.indices).tolist())) == (ROWS - length + 1) * ENVS


def test_a_sequences_priority_is_the_mixture():
    """0.9 of the largest error and 0.1 of the mean (Kapturowski et al. 2019)."""
    state, index = filled(3), jnp.asarray([6, 9], jnp.int32)
    error = np.asarray([[1.0, -2.0], [3.0, 0.5], [-2.0, 0.5]], np.float32)
    p = leaves(jit(lambda s: MEMORY.feedback(s, batch_of(index), jnp.asarray(error)))(state)).ravel()
    expected = (0.9 * np.array([3.0, 2.0]) + 0.1 * np.array([2.0, 1.0]) + 0.01) ** ALPHA
    np.testing.assert_allclose(p[np.asarray(index)], expected, rtol=1e-5)


class Erring(Recorder):
    """Says that its error is the reward."""

    def update(self, state: Any, batch: Any, key: jax.Array) -> Any:
        state, metrics, _ = Recorder.update(self, state, batch, key)
        return state, metrics, batch.transitions.reward


class Silent(Erring):
    """Gives only numbers as metrics."""

    def update(self, state: Any, batch: Any, key: jax.Array) -> Any:
        state, _, error = Erring.update(self, state, batch, key)
        return state, {"weight": batch.weights.min()}, error


@pytest.mark.parametrize("kind", ["transitions", "sequences"])
def test_the_loop_hands_the_errors_back(kind):
    """After an iteration exactly the places drawn have the priorities of what the learner said; the others are as new."""
    env, memory = rtg.vectorize(CountingEnv(9), 2), rtg.PrioritisedReplay(64, alpha=1.0, beta=0.5, offset=0.5)
    loop = rtg.OffPolicy(env, Erring(kind), memory, unroll=2, warm_up=32, batch_size=6, length=3)
    state, (metrics, _) = jit(lambda key: loop.step(loop.init(key), key))(KEY)
    index, reward = np.asarray(metrics["batch"].indices), np.asarray(metrics["batch"].transitions.reward)
    error = reward if kind == "transitions" else 0.9 * reward.max(0) + 0.1 * reward.mean(0)
    rows = 18  # 16 of warm-up and the block of this iteration
    expected = np.zeros(64)
    expected[: 2 * (rows if kind == "transitions" else rows - 2)] = 1.0
    expected[index] = error + 0.5
    np.testing.assert_allclose(np.ravel(state.replay.order.tree[0])[:64], expected, rtol=1e-6)
    assert int(state.replay.order.batches) == 1
    assert float(state.replay.order.largest) == pytest.approx(max(1.0, error.max() + 0.5))


def test_several_batches_in_an_iteration_see_each_others_errors():
    env, memory = rtg.vectorize(CountingEnv(9), 2), rtg.PrioritisedReplay(64, beta=0.5)

    loop = rtg.OffPolicy(env, Silent("transitions"), memory, unroll=2, updates=3, warm_up=32, batch_size=16)
    state, (metrics, _) = jit(lambda key: loop.step(loop.init(key), key))(KEY)
    assert int(state.replay.order.batches) == 3
    # The first batch finds all priorities alike, and so all weights 1; the later ones do not.
    assert float(metrics["weight"]) < 0.95


def test_a_small_ring_with_long_sequences():
    """Where the run of changed places is longer than the ring, each of them is changed once."""
    memory = rtg.PrioritisedReplay(8)
    one = jax.tree.map(lambda x: jnp.concatenate([x, x[:1]])[:, :1], block(0))
    state = memory.init(one, 4, 7)
    for _ in range(5):
        state = jit(memory.add)(state, one)
    p = np.ravel(state.order.tree[0])[:8]
    assert p.tolist() == [0, 0, 0, 0, 1, 1, 0, 0] or sorted(p.tolist()) == [0] * 6 + [1] * 2
    assert float(sum_tree.total(state.order.tree)) == 2.0


def test_large_blocks_leave_every_sum_right():
    """Blocks of 15 rows in 5 environments, of whose places only every 16th is looked at: through the seam, twice."""
    memory, rows, envs, unroll, length = rtg.PrioritisedReplay(30 * 5, beta=0.5), 30, 5, 15, 4
    wide = jax.tree.map(lambda x: jnp.zeros((unroll, envs, *x.shape[2:]), x.dtype), block(0))
    state, grow = memory.init(wide, unroll, length), jit(memory.add)
    for i in range(1, 6):
        state = dataclasses.replace(
            state, order=dataclasses.replace(state.order, largest=jnp.asarray(float(i), jnp.float32))
        )
        state = grow(state, wide)
        for below, above in itertools.pairwise(state.order.tree):
            np.testing.assert_allclose(np.ravel(above)[: len(below)], below.sum(1), rtol=1e-6)
        p = np.ravel(state.order.tree[0])[: rows * envs].reshape(rows, envs)
        assert (p > 0).sum() == envs * (min(rows, unroll * i) - length + 1)
        assert (p == i).sum() == envs * (unroll if i > 1 else unroll - length + 1)


def test_nothing_is_copied_in_a_compiled_loop():
    """The tree of a million priorities and the ring are changed in place: the program has no copy of either."""
    memory = rtg.PrioritisedReplay(2**20, beta=0.5)
    loop = rtg.OffPolicy(rtg.vectorize(CountingEnv(9), 2), Silent("transitions"), memory, unroll=2, warm_up=32)
    many = lambda s, k: jax.lax.fori_loop(0, 9, lambda i, s: loop.step(s, jax.random.fold_in(k, i))[0], s)  # noqa: E731
    for updates in (1, 2):
        loop = dataclasses.replace(loop, updates=updates)
        text = jit(many, donate_argnums=0).lower(jax.eval_shape(loop.init, KEY), KEY).compile().as_text()
        assert "f32[65536,16]" in text and "scatter" in text
        assert not re.findall(r"= \w+\[(?:65536,16|524288,2)[^=]* copy\(.*", text)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: rtg.PrioritisedReplay(0), "PrioritisedReplay.capacity must be"),
        (lambda: rtg.PrioritisedReplay(alpha=1.5), r"PrioritisedReplay.alpha must be in \[0, 1\], not 1.5"),
        (lambda: rtg.PrioritisedReplay(alpha=-0.1), "PrioritisedReplay.alpha must be"),
        (lambda: rtg.PrioritisedReplay(beta=2), "PrioritisedReplay.beta must be"),
        (lambda: rtg.PrioritisedReplay(beta="half"), "PrioritisedReplay.beta must be a number"),
        (lambda: rtg.PrioritisedReplay(offset=0.0), "PrioritisedReplay.offset must be"),
        (lambda: rtg.PrioritisedReplay(mix=1.1), "PrioritisedReplay.mix must be"),
        (lambda: rtg.PrioritisedReplay(frames=-1), "PrioritisedReplay.frames must be"),
        (lambda: loop_of(Recorder("transitions")), "this learner gives none: use the uniform replay"),
        (lambda: loop_of(rtg.DQN(network=small), capacity=3), "cannot hold one block .* at least 4"),
    ],
)
def test_what_cannot_be_is_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()


def loop_of(learner: Any, capacity: int = 64) -> None:
    """Put together and traced, as the runner does before it compiles or writes anything."""
    env = rtg.vectorize(small_env(), 2)
    loop = rtg.OffPolicy(env, learner, rtg.PrioritisedReplay(capacity, beta=0.5), unroll=2, warm_up=8, batch_size=4)
    state = jax.eval_shape(loop.init, KEY)
    jax.eval_shape(loop.step, state, KEY)


@pytest.mark.slow
def test_a_million_priorities_at_most_double_an_iteration_of_dqn(item):
    """CartPole, one environment, batches of 64 every 4 steps; medians in turns, the best of a few attempts. And a million uniform ones
    cost what ten thousand do.
    """
    memories = {
        "ten thousand": rtg.UniformReplay(10_000),
        "uniform": rtg.UniformReplay(1_000_000),
        "prioritised": rtg.PrioritisedReplay(1_000_000),
    }
    laps = {}
    for name, memory in memories.items():
        loop = rtg.OffPolicy(rtg.make("CartPole-v1", 1), rtg.DQN(target_period=250), memory, unroll=4, warm_up=1000)
        laps[name] = stopwatch(loop.with_horizon(10_000), 500)
    ratios = []
    for _ in range(5):
        times = {name: lap() for name, lap in laps.items()}
        ratios.append((times["prioritised"] / times["uniform"], times["uniform"] / times["ten thousand"]))
    with item("6.28") as check:
        check(
            min(a for a, _ in ratios), "<=", 2.0, "an iteration of DQN at a million entries, prioritised over uniform"
        )
    with item("6.2") as check:
        check(min(b for _, b in ratios), "<=", 1.5, "an iteration of DQN, a million transitions over ten thousand")


def stopwatch(loop: rtg.OffPolicy, count: int) -> Any:
    """Measures the median time of an iteration, compiled with all optimisation, its state donated."""
    many = lambda s: jax.lax.fori_loop(0, count, lambda i, s: loop.step(s, jax.random.fold_in(KEY, i))[0], s)  # noqa: E731
    step = jax.jit(many, donate_argnums=0, compiler_options={"xla_backend_optimization_level": 3})
    state = step(jit(loop.init)(KEY))

    def measure() -> float:
        nonlocal state
        times = []
        for _ in range(5):
            began = time.perf_counter()
            state = jax.block_until_ready(step(state))
            times.append((time.perf_counter() - began) / count)
        return statistics.median(times)

    return measure
