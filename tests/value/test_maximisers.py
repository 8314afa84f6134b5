"""The three ways to the largest Q over continuous actions, at the rates that theory gives."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.value.maximisers import ascended_maximum, cem_maximum, sampled_maximum

KEY = jax.random.key(0)
TOP = 0.2
"""Where the quadratic has its maximum, in each direction."""


def hill(action: jax.Array) -> jax.Array:
    return 1.0 - jnp.sum(jnp.square(action - TOP))


def box(d: int) -> tuple[jax.Array, jax.Array]:
    return -jnp.ones(d), jnp.ones(d)


def test_random_shooting_has_the_rates_of_the_nearest_of_k_points(item):
    """The nearest of K uniform points is at r with P(distance > r) = (1 - c r^d)^K, c the share of the unit ball of the box: E r =
    Gamma(1 + 1/d) (K c)^(-1/d), and E r^2 = Gamma(1 + 2/d) (K c)^(-2/d), which is the loss in value.
    """
    counts, keys = (64, 1024), jax.random.split(KEY, 1500)

    def measure(keys: jax.Array) -> dict[tuple[int, int], tuple[jax.Array, jax.Array]]:
        found = {}
        for d in (1, 2, 4):
            for k in counts:
                best = jax.vmap(lambda key: sampled_maximum(hill, *box(d), key, k))(keys)  # noqa: B023
                found[d, k] = (jnp.linalg.norm(best.action - TOP, axis=-1).mean(), (1.0 - best.value).mean())
        return found

    found = jax.device_get(jit(measure)(keys))
    with item("6.21") as check:
        for d in (1, 2, 4):
            share = math.pi ** (d / 2) / math.gamma(1 + d / 2) / 2**d
            for k in counts:
                for power, error in zip((1, 2), found[d, k], strict=True):
                    # Four dimensions and 64 points: the ball reaches the walls of the box, and theory is not exact.
                    expected = math.gamma(1 + power / d) * (k * share) ** (-power / d)
                    off = abs(float(error) / expected - 1)
                    what = ("action", "value")[power - 1]
                    if (d, k) != (4, 64):
                        check(off, "<=", 0.1, f"{what} error in {d} dimensions with {k} samples, relative to theory")
            for power in (1, 2):
                few, many = (float(found[d, k][power - 1]) for k in counts)
                slope = math.log(many / few) / math.log(counts[1] / counts[0])
                check(abs(slope * d / power + 1), "<=", 0.1, f"exponent -{power}/{d}: relative error")
        best = jit(jax.vmap(lambda key: sampled_maximum(hill, *box(1), key, 1000).value))(keys)
        check(
            float(best.min()), ">=", 0.99, "value of the best of 1000, d = 1, of the maximum 1: the worst of 1500 times"
        )


SLOPE = np.array([[2.0, 0.6, 0.2], [0.6, 1.0, -0.3], [0.2, -0.3, 0.15]], np.float32)
CENTRE = np.array([0.3, -0.5, 0.6], np.float32)


@pytest.mark.parametrize("newton", [False, True])
def test_ascent_comes_to_the_top_of_a_concave_quadratic(newton, item):
    curvature = SLOPE + 0.1 * np.eye(3, dtype=np.float32)
    assert np.linalg.eigvalsh(curvature).min() > 0.05
    f = lambda a: -0.5 * (a - CENTRE) @ curvature @ (a - CENTRE)  # noqa: E731
    # In a box that is not the unit one, as scaling may hide a mistake.
    low, high = jnp.asarray([-1.0, -2.0, 0.0]), jnp.asarray([1.0, 1.0, 4.0])
    steps = 15 if newton else 300
    best = jit(lambda k: ascended_maximum(f, low, high, k, 2, steps, newton))(KEY)
    with item("6.22") as check:
        check(
            np.abs(best.action - CENTRE).max(), "<=", 1e-4, f"error of the action, {'Newton' if newton else 'gradient'}"
        )
        check(-float(best.value), "<=", 1e-7, "loss in value")


@pytest.mark.parametrize("newton", [False, True])
def test_ascent_stops_at_the_faces_of_the_box(newton):
    """With the optimum outside, what is left of the gradient points outwards, and inside faces it is 0."""
    curvature = SLOPE + 0.1 * np.eye(3, dtype=np.float32)
    centre = np.array([1.5, -0.2, 0.3], np.float32)
    f = lambda a: -0.5 * (a - centre) @ curvature @ (a - centre)  # noqa: E731
    best = jit(lambda k: ascended_maximum(f, *box(3), k, 2, 30 if newton else 300, newton))(KEY)
    gradient = -curvature @ (np.asarray(best.action) - centre)
    assert np.abs(best.action).max() <= 1.0
    at_face = np.abs(np.asarray(best.action)) >= 1.0
    assert at_face.any()
    assert np.abs(gradient[~at_face]).max(initial=0.0) < 2e-3
    assert np.all(gradient[at_face] * np.asarray(best.action)[at_face] > 0)


def test_restarts_find_the_highest_of_many_hills(item):
    f = lambda a: jnp.sum(jnp.cos(7.0 * a) - jnp.square(a - 0.1)) + 4.0  # noqa: E731
    line = np.linspace(-1, 1, 20001)
    highest = 2 * np.max(np.cos(7.0 * line) - (line - 0.1) ** 2) + 4.0
    keys = jax.random.split(KEY, 100)
    many, one = jit(
        lambda keys: tuple(jax.vmap(lambda k: ascended_maximum(f, *box(2), k, n, 40).value)(keys) for n in (32, 1))  # noqa: B023
    )(keys)
    with item("6.22") as check:
        check(
            (np.asarray(many) / highest).min(),
            ">=",
            0.95,
            "share of the highest hill, 32 starts: the worst of 100 times",
        )
        check((np.asarray(one) / highest).mean(), "<", 0.95, "one start does not do it: mean share of the highest hill")


def test_cem_comes_near_in_five_generations(item):
    keys = jax.random.split(KEY, 200)
    search = lambda d: jax.vmap(lambda k: cem_maximum(hill, *box(d), k, 5, 64))  # noqa: E731
    found = jit(lambda keys: {d: search(d)(keys) for d in (1, 2)})(keys)
    with item("6.23") as check:
        for d, best in found.items():
            error = np.abs(np.asarray(best.action) - TOP).max(-1)
            what = f"after 5 generations of 64, d = {d}"
            check(np.median(error), "<=", 1e-2, f"error of the action {what}: median of 200 times")
            check(1.0 - float(best.value.min()), "<=", 1e-2, f"loss in value {what}: the worst of 200 times")
            if d == 1:
                check(error.max(), "<=", 1e-2, f"error of the action {what}: the worst of 200 times")


@pytest.mark.parametrize("recipe", [rtg.Sampled(8), rtg.Ascent(2, 4), rtg.CEM(2, 8, 3)], ids=lambda r: type(r).__name__)
def test_recipes_stay_inside_the_box_and_say_their_value(recipe):
    steep = lambda a: jnp.sum(3.0 * a[0] - a[1])  # noqa: E731
    best = jit(lambda k: recipe(steep, (2, 2), k))(KEY)
    assert best.action.shape == (2, 2)
    assert np.abs(best.action).max() <= 1.0
    np.testing.assert_allclose(best.value, steep(best.action), rtol=1e-6)


def test_more_elites_than_samples_are_refused():
    with pytest.raises(ValueError, match="cannot choose 9 elites among 8 samples"):
        rtg.CEM(samples=8, elites=9)
