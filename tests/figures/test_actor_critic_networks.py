"""Figure 4.1: a value network fitted to the exact V of a linear-quadratic problem."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import actor_critic_networks
from rewardtogo.figures.actor_critic_networks import (
    GAMMA,
    REACH,
    A,
    B,
    K,
    exact_value,
    fit,
    rollouts,
    value_of,
    weights_of,
)


@pytest.fixture(scope="module")
def fits():
    return fit(0, 1.0), fit(0, 0.0)


def test_exact_values():
    """Against long rollouts, and the equation that V solves: the mean of r + γ V(s') is V(s)."""
    long = rollouts(5, number=4000, steps=120)
    sums = np.einsum("t,tb->b", GAMMA ** np.arange(120), np.asarray(long.reward, np.float64))
    error = sums - value_of(np.asarray(long.observation[0], np.float64))
    now, after = (value_of(np.asarray(x, np.float64)) for x in (long.observation, long.next_observation))
    delta = (np.asarray(long.reward, np.float64) + GAMMA * after - now).ravel()
    assert abs(error.mean()) <= 4 * error.std() / np.sqrt(len(error))
    assert abs(delta.mean()) <= 4 * delta.std() / np.sqrt(len(delta))
    p, c = exact_value()
    assert np.linalg.eigvalsh(p).min() > 0 and c > 0 and np.abs(np.linalg.eigvals(A - np.outer(B, K))).max() < 1


def test_the_network_fits_v(item, fits):
    sums, bootstrapped = fits
    with item("4.7") as check:
        check(sums.r_squared, ">", 0.99, "R² in fresh rollouts, fitted to reward sums (4.12)")
        check(bootstrapped.r_squared, ">", 0.99, "R² in fresh rollouts, bootstrapped (4.13)")
    with item("4.11") as check:
        single = sums.error(sums.sums)
        check(sums.error(sums.values), "<", single, "MSE to V: fitted to single reward sums, the sums themselves")
        check(bootstrapped.error(bootstrapped.values), "<", single, "MSE to V: bootstrapped, single reward sums")


def test_the_drawing_shows_the_network(monkeypatch, fits):
    monkeypatch.setattr(actor_critic_networks, "fit", lambda seed, lambda_: fits[0 if lambda_ == 1 else 1])
    figure = actor_critic_networks.draw(0)
    FigureCanvasAgg(figure).draw()
    net, contours, scatter = figure.axes[:3]
    matrices = weights_of(fits[0].network)
    assert len(net.get_lines()) == sum(m.size for m in matrices) == 2 * 8 + 8 * 8 + 8
    assert len(net.patches) == 2 + 8 + 8 + 1
    assert contours.get_xlim() == (-REACH, REACH)
    assert f"{fits[1].r_squared:.3f}" in scatter.get_legend().get_texts()[2].get_text()
