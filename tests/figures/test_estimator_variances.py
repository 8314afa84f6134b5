"""The table of estimators: exact moments of what learners use, against the oracles and against each other."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.exact import v_values
from rewardtogo.exact.estimators import batch_moments, estimator_moments, subtract_batch_mean, subtract_others_mean
from rewardtogo.exact.signals import n_step_returns, rewards_to_go, total_returns, values_at
from rewardtogo.exact.softmax import softmax_policy
from rewardtogo.figures import estimator_variances
from rewardtogo.figures.estimator_variances import BATCH, exact_moments, problem
from rewardtogo.ops.estimators import BASELINES

UNBIASED = ("none", "leave_one_out", "value")


@pytest.fixture(scope="module")
def table():
    return exact_moments(0)


def test_the_table_against_the_oracles(item, table):
    found, gradient = table
    mdp, logits = problem(0)
    values = v_values(mdp, softmax_policy(logits))
    each = lambda compare: batch_moments(mdp, logits, total_returns, BATCH, compare=compare)  # noqa: E731
    alone = lambda weights: estimator_moments(mdp, logits, weights)  # noqa: E731
    oracles = {
        ("full", "none"): (alone(total_returns), BATCH),
        ("reward_to_go", "none"): (alone(rewards_to_go), BATCH),
        ("reward_to_go", "value"): (alone(lambda τ: rewards_to_go(τ) - values_at(τ, values)), BATCH),
        ("n_step", "value"): (alone(lambda τ: n_step_returns(τ, values, 2) - values_at(τ, values)), BATCH),
        ("full", "mean"): (each(subtract_batch_mean), 1),
        ("full", "leave_one_out"): (each(subtract_others_mean), 1),
    }
    worst, bias = 0.0, 0.0
    for name, (oracle, size) in oracles.items():
        apart = (found[name].mean - oracle.mean.ravel(), found[name].variance - oracle.variance.ravel() / size)
        worst = max(worst, *(np.abs(x).max() for x in apart))
    for (_, baseline), m in found.items():
        bias = max(bias, np.abs(m.mean - gradient).max() if baseline in UNBIASED else 0.0)
    with item("3.23") as check:
        check(len(found), "==", 4 * len(BASELINES), "estimators in the table")
        check(worst, "<=", 1e-12, "mean and variance of six of them against the oracles")
        check(bias, "<=", 1e-12, "bias without a baseline, with leave one out and with V")


def test_what_the_table_shows(item, table):
    found, gradient = table
    total = {name: m.total_variance for name, m in found.items()}
    shrunk = max(
        np.abs(found[r, "time_mean"].mean - gradient / 2).max() for r in ("full", "reward_to_go", "n_step", "gae")
    )
    with item("3.18") as check:
        check(
            total["reward_to_go", "none"],
            "<",
            total["full", "none"],
            "variance of reward-to-go against the full return",
        )
    with item("4.2") as check:
        check(shrunk, "<=", 1e-12, "mean at each time: E[g] = (1 - 1/N) ∇J, N = 2, for all four returns")
    with item("4.3") as check:
        check(total["reward_to_go", "value"], "<", total["reward_to_go", "none"], "variance with V against none")
    with item("4.33") as check:
        check(total["gae", "value"], "<", total["reward_to_go", "value"], "variance of λ = .5 against λ = 1, exact V")


def test_the_drawing_shows_these_numbers(monkeypatch, table):
    monkeypatch.setattr(estimator_variances, "exact_moments", lambda seed: table)
    figure = estimator_variances.draw(0)
    FigureCanvasAgg(figure).draw()
    written = [text.get_text() for text in figure.axes[0].texts]
    assert written == [f"{m.total_variance:.2f}" for m in table[0].values()]
