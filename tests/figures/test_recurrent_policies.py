"""Figure 2.2: what a memory learns and what it costs (items 2.12 to 2.15)."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import history
from rewardtogo.figures.history import HISTORIES, LENGTH, NETWORKS, accuracy, costs, demonstrations


def test_the_data_is_the_xor(key):
    data = demonstrations(key)
    bit = np.asarray(data.transitions.observation)[:, 0].reshape(-1, LENGTH).astype(int)
    answer = np.asarray(data.transitions.action).reshape(-1, LENGTH)
    assert not answer[:, 0].any() and np.array_equal(answer[:, 1:], bit[:, 1:] ^ bit[:, :-1])


def test_the_last_two_are_enough(item):
    with item("2.13") as check:
        check(
            accuracy(NETWORKS["of the last two"])[-1],
            ">=",
            0.95,
            "right answers of the curve that is drawn, windows that begin anywhere",
        )


def test_costs(item):
    stacks, lstm = costs()
    with item("2.15") as check:
        growth = np.diff(stacks) / np.diff(HISTORIES)
        check(
            np.abs(growth - 4 * 4 * 16).max(),
            "==",
            0,
            "parameters a picture, from those of a channel of the first convolution",
        )
    assert stacks[0] < lstm < stacks[-1]


def test_the_drawing_shows_these_curves(monkeypatch):
    curves = {
        network: np.linspace(0.5, 0.6 + 0.1 * i, history.ITERATIONS) for i, network in enumerate(NETWORKS.values())
    }
    monkeypatch.setattr(history, "accuracy", lambda network, seed: curves[network])
    figure = history.draw()
    FigureCanvasAgg(figure).draw()
    lines = [line.get_ydata() for line in figure.axes[1].get_lines()][:3]
    assert all(np.array_equal(a, b) for a, b in zip(lines, curves.values(), strict=True))
