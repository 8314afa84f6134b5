"""Exploration policies: probabilities by hand, frequencies by chi-square, limits, masks, ties, schedules."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from algorithms_under_test import jit
from rewardtogo.core import fix_horizon
from rewardtogo.ops.schedules import Linear
from rewardtogo.runner.config import build, describe
from rewardtogo.value.exploration import Boltzmann, EpsilonGreedy, Exploration, Greedy, greedy_probabilities

Q = jnp.asarray([0.3, 1.0, -0.5, 1.0])
MASK = jnp.asarray([1, 0, 1, 1], jnp.int8)
DRAWS = 40_000

CASES = [
    (EpsilonGreedy(0.2), Q, None, [0.05, 0.85, 0.05, 0.05]),
    (EpsilonGreedy(0.2, "uniform"), Q, None, [0.05, 0.45, 0.05, 0.45]),
    (EpsilonGreedy(0.3), Q, MASK, [0.1, 0.0, 0.1, 0.8]),
    (EpsilonGreedy(1.0), Q, None, [0.25] * 4),
    (Boltzmann(0.5), Q, None, np.exp(np.asarray(Q, np.float64) / 0.5) / np.exp(np.asarray(Q, np.float64) / 0.5).sum()),
    (
        Boltzmann(2.0),
        Q,
        MASK,
        np.exp(np.asarray(Q, np.float64) / 2) * np.asarray(MASK) / (np.exp(np.asarray(Q, np.float64) / 2) * MASK).sum(),
    ),
    (Boltzmann(0.0), Q, None, [0, 0.5, 0, 0.5]),
    (Greedy(), Q, None, [0, 1, 0, 0]),
    (Greedy("uniform"), Q, None, [0, 0.5, 0, 0.5]),
    (Greedy(), Q, MASK, [0, 0, 0, 1]),
]


@pytest.fixture(scope="module")
def drawn() -> list[tuple[np.ndarray, np.ndarray]]:
    """Probabilities and frequencies of every case, from one program."""

    def run(keys: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
        return [
            (
                e.probabilities(q, mask),
                jnp.bincount(jax.vmap(lambda k, e=e, q=q, mask=mask: e(q, k, mask))(keys), length=4),
            )
            for e, q, mask, _ in CASES
        ]

    found = jit(run)(jax.random.split(jax.random.key(0), DRAWS))
    return [(np.asarray(p, np.float64), np.asarray(n)) for p, n in found]


def test_frequencies_are_the_probabilities(drawn, item):
    with item("5.20") as check:
        for (explore, _, _, expected), (probabilities, counts) in zip(CASES, drawn, strict=True):
            expected = np.asarray(expected, np.float64)
            what = f"{type(explore).__name__}{' with a mask' if 0 in expected else ''}"
            check(np.abs(probabilities - expected).max(), "<=", 1e-6, f"{what}: probability, worked out by hand")
            possible = expected > 0
            check(counts[~possible].sum(), "==", 0, f"{what}: draws of an impossible action")
            if possible.sum() > 1:
                p = stats.chisquare(counts[possible], expected[possible] / expected.sum() * DRAWS).pvalue
                check(p, ">", 1e-3, f"{what}: chi-square p of {DRAWS} draws")


def test_a_cold_boltzmann_is_greedy(item):
    temperatures = jnp.asarray([1.0, 1e-1, 1e-2, 1e-3, 1e-20, 1e-42])
    q = jnp.asarray([0.3, 1.0, -0.5, 0.9])
    laws = jit(jax.vmap(lambda t: Boltzmann(t).probabilities(q)))(temperatures)
    gaps = np.abs(np.asarray(laws) - np.asarray(greedy_probabilities(q))).max(1)
    with item("5.20") as check:
        check(gaps[0], ">", 0.3, "T = 1, distance to greedy")
        check(np.diff(gaps).max(), "<=", 0, "the distance falls with T")
        check(gaps[3:].max(), "<=", 1e-30, "T <= 1e-3")
        check(np.abs(gaps[-1]), "==", 0, "a temperature below the least normal number, no NaN")


def test_schedules_move_it():
    explore = fix_horizon(EpsilonGreedy(Linear(1.0, 0.1)), 10)
    assert [float(explore.at(i).metrics()["epsilon"]) for i in (0, 5, 10, 99)] == pytest.approx([1, 0.55, 0.1, 0.1])
    cooled = fix_horizon(Boltzmann(Linear(1.0, 0.0)), 4)
    assert float(cooled.at(3).metrics()["temperature"]) == pytest.approx(0.25)
    assert not Greedy().metrics()


def test_they_are_plain_data_and_back():
    """As the parts of a learner they go into config.json and come from the command line."""
    for explore in (EpsilonGreedy(0.1), Boltzmann(Linear(1.0, 0.1)), Greedy("uniform")):
        assert describe(build(type(explore), describe(explore))) == describe(explore)
        assert isinstance(explore, Exploration)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: EpsilonGreedy(1.5), "EpsilonGreedy.epsilon [0, 1] 1.5"),
        (lambda: Boltzmann(-1.0), "Boltzmann.temperature [0, inf) -1"),
        (lambda: Boltzmann(float("nan")), "Boltzmann.temperature nan"),
        (lambda: Greedy("last"), "Greedy.ties first uniform 'last'"),
        (lambda: greedy_probabilities(Q, ties="last"), "first uniform 'last'"),
    ],
)
def test_wrong_numbers_are_refused(make, words):
    with pytest.raises(ValueError) as refused:
        make()
    assert all(word in str(refused.value) for word in words.split())
