"""The tree of sums against NumPy: sums, places, what rounding may do, and drawing in proportion."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from algorithms_under_test import jit
from rewardtogo.data import sum_tree

SIZE = 5_000
KEY = jax.random.key(0)
assign, find = jit(sum_tree.assign), jit(sum_tree.find)


def tree_of(numbers: np.ndarray) -> sum_tree.Levels:
    return assign(sum_tree.zeros(len(numbers)), jnp.arange(len(numbers)), jnp.asarray(numbers, jnp.float32))


def numbers() -> np.ndarray:
    """A third of them 0."""
    rng = np.random.default_rng(0)
    return np.where(rng.random(SIZE) < 1 / 3, 0.0, rng.lognormal(0, 2, SIZE)).astype(np.float32)


def assert_whole(levels: sum_tree.Levels, expected: np.ndarray) -> None:
    """Every level holds the sums of the one below, exactly, and the lowest what was put there."""
    np.testing.assert_array_equal(np.ravel(levels[0])[: len(expected)], expected)
    assert not np.ravel(levels[0])[len(expected) :].any()
    for below, above in itertools.pairwise(levels):
        np.testing.assert_allclose(np.ravel(above)[: len(below)], np.asarray(below, np.float64).sum(1), rtol=1e-6)
    assert levels[-1].shape[0] == 1


def test_sums_stay_right_through_many_changes():
    """A thousand changes of numbers of very different size leave no trace: they are summed afresh."""
    rng, expected = np.random.default_rng(1), numbers()
    levels = tree_of(expected)
    for _ in range(60):
        index = rng.integers(0, SIZE, 16)
        new = rng.lognormal(0, 8, SIZE).astype(np.float32)[index]
        levels, expected[index] = assign(levels, jnp.asarray(index, jnp.int32), jnp.asarray(new)), new
    assert_whole(levels, expected)


def test_places_are_those_of_running_sums():
    """Away from the seams every height falls where NumPy's running sum in float64 says."""
    given = numbers()
    levels, running = tree_of(given), np.cumsum(given.astype(np.float64))
    height = np.random.default_rng(2).random(SIZE) * running[-1] * (1 - 1e-6)
    found, expected = (
        np.asarray(find(levels, jnp.asarray(height, jnp.float32))),
        np.searchsorted(running, height, "right"),
    )
    near = np.abs(running[np.minimum(found, SIZE - 1)] - height) < 1e-6 * running[-1]
    near |= np.abs(running[np.maximum(found - 1, 0)] - height) < 1e-6 * running[-1]
    assert near.mean() < 0.1
    np.testing.assert_array_equal(found[~near], expected[~near])
    assert np.all(given[found] > 0)


@pytest.mark.parametrize("height", [0.0, 1.0, 1.001, np.inf])
def test_nothing_of_priority_0_is_found_at_the_seams(height):
    """The ends of the sum, and beyond them, where rounding may lead."""
    given = numbers()
    given[[0, 1, -1, -2]] = 0.0
    levels = tree_of(given)
    found = find(levels, jnp.full(3, height) * sum_tree.total(levels))
    assert np.all(given[np.asarray(found)] > 0)
    single = tree_of(np.where(np.arange(SIZE) == 777, 1e-20, 0.0))
    assert set(np.asarray(find(single, jnp.asarray([0.0, 5e-21, 1e-20])))) == {777}


def test_draws_are_in_proportion():
    weights = numbers()[:40] + np.float32(0.5)
    levels, draws = tree_of(weights), 40_000
    found = find(levels, jax.random.uniform(KEY, (draws,)) * sum_tree.total(levels))
    counts = np.bincount(np.asarray(found), minlength=40)
    assert stats.chisquare(counts, draws * weights / weights.sum()).pvalue > 1e-3
    assert stats.chisquare(counts, np.full(40, draws / 40)).pvalue < 1e-9  # the test would tell
