import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo import core, ops


def values(schedule, *steps):
    return [float(schedule(step)) for step in steps]


def test_values_by_hand():
    assert values(ops.Constant(0.5), 0, 7, 10**9) == [0.5, 0.5, 0.5]
    assert values(ops.Linear(1.0, 0.0, 100), 0, 25, 50, 100, 1000) == [1.0, 0.75, 0.5, 0.0, 0.0]
    assert np.allclose(values(ops.Linear(1.0, 0.2, 100, 0.1), 0, 5, 10, 50, 100), [1.0, 0.6, 0.2, 0.2, 0.2])
    assert np.allclose(values(ops.Cosine(3.0, 1.0, 100), 0, 50, 100, 500), [3.0, 2.0, 1.0, 1.0])
    assert np.allclose(values(ops.Exponential(1.0, 0.01, 100), 0, 50, 100, 500), [1.0, 0.1, 0.01, 0.01])
    quarter = 1.0 + 1.0 + np.cos(np.pi / 4)
    assert float(ops.Cosine(3.0, 1.0, 100)(25)) == pytest.approx(quarter, rel=1e-6)


@pytest.mark.parametrize("make", [ops.Linear, ops.Cosine, ops.Exponential])
def test_the_ends_are_exact_and_the_way_is_monotone(make):
    schedule = make(3e-4, 1e-5, 777)
    path = np.array([float(x) for x in jax.vmap(schedule)(jnp.arange(900))])
    assert path[0] == pytest.approx(3e-4, rel=1e-6) and np.allclose(path[777:], 1e-5, rtol=1e-6)
    assert np.all(np.diff(path) <= 1e-10)
    assert schedule.extremes() == (1e-5, 3e-4)
    assert schedule(jnp.asarray(5)).dtype == jnp.float32


@pytest.mark.parametrize("make", [ops.Linear, ops.Cosine, ops.Exponential])
def test_a_schedule_without_a_horizon_gets_one(make):
    open_ended = make(1.0, 0.5)
    with pytest.raises(ValueError, match=r"has no horizon yet.*the runner fixes it"):
        open_ended(0)
    fixed = core.fix_horizon({"rate": open_ended, "other": 0.1}, 40)
    assert float(fixed["rate"](40)) == 0.5 and fixed["other"] == 0.1
    assert fixed["rate"].with_horizon(7).horizon == 40
    assert ops.Constant(1.0).with_horizon(3) == ops.Constant(1.0)


def test_the_fraction_survives_a_horizon():
    assert ops.Linear(1.0, 0.0, fraction=0.5).with_horizon(10) == ops.Linear(1.0, 0.0, 10, 0.5)


def test_new_numbers_do_not_recompile_and_a_sweep_is_a_vmap():
    traced = []

    @jax.jit
    def at(schedule, step):
        traced.append(step)
        return schedule(step)

    for start in (1.0, 0.5):
        for fraction in (0.5, 0.25):
            assert float(at(ops.Linear(start, 0.0, 10, fraction), jnp.asarray(0))) == start
    assert len(traced) == 1
    starts = jnp.array([1.0, 2.0, 4.0])
    sweep = jax.vmap(lambda start: ops.Linear(start, 0.0, 10)(5))(starts)
    assert np.allclose(sweep, 0.5 * starts)
    assert ops.Linear(starts, 0.0).extremes() == (0.0, 4.0)


def test_the_range_of_a_hyperparameter_holds_for_its_schedule():
    class Recipe(core.Configured):
        rate: core.Number = core.number(1e-3, "step size", above=0.0, at_most=1.0)

    Recipe(ops.Exponential(1.0, 1e-3))
    with pytest.raises(ValueError, match=r"Recipe\.rate must be in"):
        Recipe(ops.Linear(2.0, 0.5))


@pytest.mark.parametrize(
    ("text", "schedule"),
    [
        ("3e-4", 3e-4),
        (" 1 ", 1.0),
        ("-0.5", -0.5),
        ("constant:0.25", ops.Constant(0.25)),
        ("linear:3e-4:0", ops.Linear(3e-4, 0.0)),
        ("linear:1:0.05:0.1", ops.Linear(1.0, 0.05, None, 0.1)),
        ("linear:1:0.05:0.1@5000", ops.Linear(1.0, 0.05, 5000, 0.1)),
        ("Cosine:3e-4:0@5000", ops.Cosine(3e-4, 0.0, 5000)),
        ("exponential:1:1e-12", ops.Exponential(1.0, 1e-12)),
    ],
)
def test_text_round_trip(text, schedule):
    assert ops.parse_schedule(text) == schedule
    assert ops.parse_schedule(ops.to_text(schedule)) == schedule


def test_text_is_short():
    assert ops.to_text(ops.Linear(1.0, 0.05, 5000, 0.1)) == "linear:1:0.05:0.1@5000"
    assert ops.to_text(ops.Cosine(3e-4, 0.0)) == "cosine:0.0003:0"
    traced = jax.tree.map(jnp.float32, ops.Linear(1.0, 0.05, 5000, 0.1))
    assert ops.to_text(traced) == "linear:1:0.05:0.1@5000"
    assert ops.to_text(0.1) == "0.1" and ops.to_text(1e-8) == "1e-08"


@pytest.mark.parametrize("seed", range(20))
def test_any_number_survives_the_text(seed):
    start, end = np.random.default_rng(seed).lognormal(0.0, 8.0, 2)
    schedule = ops.Exponential(float(start), float(end), seed + 1)
    assert ops.parse_schedule(ops.to_text(schedule)) == schedule


@pytest.mark.parametrize(
    "text",
    (
        "",
        "fast",
        "linear",
        "linear:1",
        "linear:1:2:3:4",
        "linear:a:b",
        "linear:1:inf",
        "linear:1:0@",
        "linear:1:0@x",
        "linear:1:0@0",
        "linear:1:0@2.5",
        "linear:1:0:1.5",
        "cosine:1:0:0.5",
        "exponential:1:0",
        "sine:1:0",
        "constant:1@5",
        "0.1@50",
        "nan",
    ),
)
def test_bad_text_is_refused_in_one_sentence(text):
    with pytest.raises(ValueError) as caught:
        ops.parse_schedule(text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) > 20


def test_bad_numbers_are_refused():
    with pytest.raises(ValueError, match="at least 1 whole update"):
        ops.Linear(1.0, 0.0, 0)
    with pytest.raises(ValueError, match="at least 1 whole update"):
        ops.Cosine(1.0, 0.0, True)
    with pytest.raises(ValueError, match=r"fraction of the horizon in \(0, 1\]"):
        ops.Linear(1.0, 0.0, 10, 0.0)
    with pytest.raises(ValueError, match="positive start and end"):
        ops.Exponential(1.0, 0.0)
    with pytest.raises(ValueError, match="has no text"):
        ops.to_text(ops.Constant(jnp.ones(3)))
