"""What must hold of every algorithm, whatever it computes."""

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType

import rewardtogo as rtg
from algorithms_under_test import ALGORITHMS_UNDER_TEST, jit, on_policy, small_env
from rewardtogo.catalogue import ALGORITHMS, LOOPS
from rewardtogo.core import Algorithm, Episodes
from rewardtogo.runner.config import build, options, resolve
from rewardtogo.runner.policy import load, policies, save_policy

HORIZON = 10
KEYS = [jax.random.key(seed) for seed in (0, 1)]
every = pytest.mark.parametrize("name", ALGORITHMS_UNDER_TEST)
VARIANTS = {"ppo-gru", "dqn", "dqn-lstm", "qr-dqn", "bc-gru", "per-dqn-lstm", "ddpg", "naf"}
"""Rows of algorithms that another row stands for in the tests that compile a program of their own."""
each_algorithm = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in VARIANTS else n for n in ALGORITHMS_UNDER_TEST]
)


@functools.cache
def algorithm(name: str) -> Algorithm:
    return ALGORITHMS_UNDER_TEST[name]().with_horizon(HORIZON)


@functools.cache
def program(name: str) -> Any:
    """One iteration, its state donated."""
    del name
    return jit(lambda a, s, k: a.step(s, k), donate_argnums=1)


@functools.cache
def start(name: str, seed: int) -> Any:
    return jit(lambda a, k: a.init(k))(algorithm(name), KEYS[seed])


def copy(tree: Any) -> Any:
    return jax.tree.map(jnp.copy, tree)


def iterations(name: str, seed: int, count: int, a: Algorithm | None = None) -> list[Any]:
    """The state after each iteration, on the host."""
    state, states = copy(start(name, seed)), []
    for i in range(count):
        state, _ = program(name)(algorithm(name) if a is None else a, state, jax.random.fold_in(KEYS[seed], i))
        states.append(jax.device_get(copy(state)))
    return states


def distance(a: Any, b: Any) -> float:
    """Greatest difference of two trees, in units of max(1, |a|)."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    gaps = [
        np.max(np.abs(np.float64(x) - np.float64(y)) / np.maximum(1.0, np.abs(np.float64(x))), initial=0.0)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    ]
    return float(max(gaps))


def same_bits(a: Any, b: Any) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)


@every
def test_its_policy_is_stored_and_loaded(name, tmp_path):
    """With what a planner holds as numbers of Python's, too."""
    a = algorithm(name)
    learner, learned = a.learner, a.learned(start(name, 0))  # type: ignore[attr-defined]
    save_policy(tmp_path, learner, learned, a.spec, {})
    loaded, stored = load(tmp_path, learner)._policies, policies(learner, learned)
    numbers = lambda x: jax.random.key_data(x) if jnp.issubdtype(jnp.asarray(x).dtype, jax.dtypes.prng_key) else x  # noqa: E731
    for mine, theirs in zip(jax.tree.leaves(stored), jax.tree.leaves(loaded), strict=True):
        np.testing.assert_array_equal(np.asarray(numbers(mine), jnp.asarray(numbers(mine)).dtype), numbers(theirs))


@every
def test_every_leaf_of_the_state_is_an_array(name):
    state = start(name, 0)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(state))
    after, (metrics, episodes) = jax.eval_shape(lambda a, s, k: a.step(s, k), algorithm(name), state, KEYS[0])
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)  # noqa: E731
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert shapes(after) == shapes(state)
    assert all(value.shape == () for value in metrics.values())
    assert isinstance(episodes, Episodes)
    # A state that is weakly typed on its way in and not on its way out is compiled twice.
    assert [x.weak_type for x in jax.tree.leaves(state)] == [x.weak_type for x in jax.tree.leaves(after)]


@every
def test_a_step_learns_and_stays_finite(name):
    first, second = iterations(name, 0, 2)
    before = jax.device_get(start(name, 0))
    a = algorithm(name)
    assert distance(a.learned(before), a.learned(first)) > 0
    assert distance(a.learned(first), a.learned(second)) > 0
    for leaf in jax.tree.leaves(a.learned(second)):
        assert np.all(np.isfinite(leaf))


@every
def test_same_seed_same_bits(name):
    assert same_bits(iterations(name, 0, 2), iterations(name, 0, 2))
    assert not same_bits(iterations(name, 0, 1), iterations(name, 1, 1))


@every
def test_the_state_is_donated(name):
    """Whatever the program can reuse is gone afterwards, and the numbers are right (the other tests look at them)."""
    state = copy(start(name, 0))
    program(name)(algorithm(name), state, KEYS[0])
    gone = [leaf.is_deleted() for leaf in jax.tree.leaves(state)]
    assert sum(gone) >= 0.5 * len(gone)


@every
def test_a_new_number_compiles_nothing(name):
    iterations(name, 0, 1)
    compiled = program(name)._cache_size()
    assert compiled == 1
    learner = algorithm(name).learner  # type: ignore[attr-defined]
    traced = {
        f.name: 0.9 * getattr(learner, f.name)
        for f in dataclasses.fields(learner)
        if f.metadata.get("traced") and isinstance(getattr(learner, f.name), float)
    }
    assert traced
    other = dataclasses.replace(algorithm(name), learner=dataclasses.replace(learner, **traced))
    changed, old = iterations(name, 0, 1, other), iterations(name, 0, 1)
    assert program(name)._cache_size() == compiled
    assert not same_bits(other.learned(changed[0]), other.learned(old[0]))


@each_algorithm
def test_seeds_train_together_in_a_scan(name):
    """`vmap` over two seeds of a `scan` over two iterations, nothing donated: seed k is the single run to 1e-5 after one update."""

    def one(a: Algorithm, state: Any, key: jax.Array) -> Any:
        def body(state: Any, i: jax.Array) -> tuple[Any, Any]:
            state, _ = a.step(state, jax.random.fold_in(key, i))
            return state, a.learned(state)

        return jax.lax.scan(body, state, jnp.arange(2))[1]

    a = algorithm(name)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), start(name, 0), start(name, 1))
    together = jax.device_get(jit(jax.vmap(one, in_axes=(None, 0, 0)))(a, states, jnp.stack(KEYS)))
    for seed in (0, 1):
        alone = iterations(name, seed, 2)
        for i, bound in ((0, 1e-5), (1, 1e-3)):
            one_state = jax.tree.map(lambda x: x[seed, i], together)  # noqa: B023
            assert distance(one_state, a.learned(alone[i])) <= bound


@each_algorithm
def test_two_devices_give_the_numbers_of_one(name):
    assert jax.device_count() >= 2
    a = algorithm(name)
    alone = iterations(name, 0, 1)[0]
    mesh = jax.make_mesh((2,), ("devices",), axis_types=(AxisType.Auto,), devices=jax.devices()[:2])
    with jax.set_mesh(mesh):
        after = jit(lambda a, s, k: a.step(s, k)[0])(a, start(name, 0), jax.random.fold_in(KEYS[0], 0))
    assert distance(a.learned(alone), a.learned(jax.device_get(after))) <= 1e-5
    if isinstance(a, (rtg.OnPolicy, rtg.OffPolicy)):
        assert not any(leaf.sharding.is_fully_replicated for leaf in jax.tree.leaves(after.actor) if leaf.size)


def test_a_sweep_is_a_vmap():
    """Two learning rates in one program, each as if alone."""
    rates = (1e-3, 1e-2)
    a = algorithm("ppo")
    state, key = start("ppo", 0), jax.random.fold_in(KEYS[0], 0)
    rate_of = lambda a: a.learner.learning_rate  # noqa: E731
    many = eqx.tree_at(rate_of, a, jnp.asarray(rates))
    axes = eqx.tree_at(rate_of, jax.tree.map(lambda _: None, a), 0, is_leaf=lambda x: x is None)
    swept = jit(jax.vmap(lambda a, s, k: a.step(s, k)[0], in_axes=(axes, None, None)))(many, state, key)
    for i, rate in enumerate(rates):
        alone = iterations("ppo", 0, 1, eqx.tree_at(rate_of, a, rate))[0]
        assert distance(jax.tree.map(lambda x: x[i], a.learned(swept)), a.learned(alone)) <= 1e-5  # noqa: B023


def test_the_catalogue_says_what_learners_do():
    loops = {
        "rollout": ("on_policy", "asynchronous"),
        "transitions": ("off_policy", "offline", "dagger", "distill", "self_play"),
        "sequences": ("off_policy", "offline"),
    }
    tested = {type(algorithm(name).learner) for name in ALGORITHMS_UNDER_TEST}  # type: ignore[attr-defined]
    for name, row in ALGORITHMS.items():
        learner = build(resolve(row.path), row.learner)
        assert type(learner) in tested, f"{name} has no row in tests/algorithms_under_test.py"
        kinds = ("discrete",) if row.loop == "distill" else learner.action_kinds  # a search wants numbered actions
        assert kinds == row.actions
        assert row.loop in loops[learner.batch]
        assert set(row.loop_options) <= set(options(resolve(LOOPS[row.loop])))


# --- scaling ---------------------------------------------------------------------------------------------------------


def stopwatch(a: Algorithm, count: int) -> Callable[[], float]:
    """Measures the median time of an iteration, its state donated."""
    key = jax.random.key(0)
    advance = lambda a, s: jax.lax.fori_loop(0, count, lambda i, s: a.step(s, jax.random.fold_in(key, i))[0], s)  # noqa: E731
    step = jit(advance, donate_argnums=1)
    state = jax.block_until_ready(step(a, jit(lambda a, k: a.init(k))(a, key)))

    def measure() -> float:
        nonlocal state
        times = []
        for _ in range(7):
            began = time.perf_counter()
            state = jax.block_until_ready(step(a, state))
            times.append((time.perf_counter() - began) / count)
        return statistics.median(times)

    return measure


def scales(small: Algorithm, large: Algorithm, factor: float, count: int) -> bool:
    """Whether the large one costs at most 1.5 times `factor` as much as the small one, at the best of a few attempts."""
    one, other = stopwatch(small, count), stopwatch(large, count)
    return any(other() <= 1.5 * factor * one() for _ in range(10))


def test_a_larger_replay_costs_nothing():
    make = lambda capacity: rtg.OffPolicy(  # noqa: E731
        rtg.vectorize(small_env(), 4),
        rtg.DQN(network=rtg.MLP(8)),
        rtg.UniformReplay(capacity),
        unroll=4,
        batch_size=16,
        warm_up=16,
    ).with_horizon(1000)
    assert scales(make(200_000), make(400_000), 1.0, 50)


def test_a_longer_scan_costs_no_more_a_step():
    learner = rtg.PPO(network=rtg.MLP(8), epochs=1, minibatches=1)
    assert scales(on_policy(learner, unroll=1000), on_policy(learner, unroll=2000), 2.0, 2)
