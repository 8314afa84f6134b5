"""Figure 4.2: who acted with which parameters, as counted by the programs themselves."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import parallel_workers
from rewardtogo.figures.parallel_workers import SHOWN, WORKERS, Rollouts, asynchronous, synchronous


@pytest.fixture(scope="module")
def counted():
    return {
        "sync": synchronous(1, 40),
        "in_turn": asynchronous("in_turn", 1, 400),
        "random": asynchronous("random", 1, 400),
    }


def test_synchronous_workers_act_with_the_newest_parameters(item, counted):
    rollouts = counted["sync"]
    with item("4.25") as check:
        check(np.bincount(rollouts.update).min(), "==", WORKERS, "rollouts in each update, least")
        check(np.bincount(rollouts.update).max(), "==", WORKERS, "rollouts in each update, most")
        check(np.abs(rollouts.lag).max(), "==", 0, "lag")


def test_no_rollout_is_lost(item, counted):
    with item("4.26") as check:
        for name in ("in_turn", "random"):
            rollouts = counted[name]
            check(np.abs(rollouts.update - np.arange(400)).max(), "==", 0, f"{name}: updates are 0, 1, 2, ...")
            wrong = 0
            for worker in range(WORKERS):
                mine = rollouts.worker == worker
                # What a worker acts with is what came out of its last delivery.
                wrong += (rollouts.version[mine][1:] != rollouts.update[mine][:-1] + 1).sum() + rollouts.version[mine][
                    0
                ]
            check(wrong, "==", 0, f"{name}: versions that are not those of the worker's last delivery")


def test_lags(item, counted):
    turns, drawn = counted["in_turn"].lag, counted["random"].lag
    with item("4.27") as check:
        check(np.abs(turns[WORKERS:] - (WORKERS - 1)).max(), "==", 0, "in turn: lag is W - 1 after the first round")
        # The lag is geometric with chance 1 / W: mean W - 1, variance W (W - 1).
        error = abs(drawn.mean() - (WORKERS - 1)) / np.sqrt(WORKERS * (WORKERS - 1) / len(drawn))
        check(error, "<=", 4, "random order: standard errors of the mean lag from W - 1")
        share = np.bincount(drawn, minlength=8)[:8] / len(drawn)
        exact = (1 / WORKERS) * (1 - 1 / WORKERS) ** np.arange(8)
        spread = np.sqrt(exact * (1 - exact) / len(drawn))
        check(
            (np.abs(share - exact) / spread).max(), "<=", 4, "standard errors of the histogram from (1/W)(1 - 1/W)^lag"
        )


def test_the_timeline_shows_these_numbers(monkeypatch, counted):
    made = {"in_turn": counted["in_turn"], "random": counted["random"]}
    monkeypatch.setattr(parallel_workers, "asynchronous", lambda order, seed, updates: made[order])
    monkeypatch.setattr(parallel_workers, "synchronous", lambda seed, updates: counted["sync"])
    figure = parallel_workers.draw(1, 400)
    FigureCanvasAgg(figure).draw()
    for axis, rollouts in zip(figure.axes, (counted["sync"], None, counted["in_turn"]), strict=False):
        if isinstance(rollouts, Rollouts):
            shown = rollouts.version < SHOWN
            lefts = np.array([bar.get_x() for bar in axis.patches])
            widths = np.array([bar.get_width() for bar in axis.patches])
            assert np.allclose(np.round(lefts), rollouts.version[shown])
            assert np.allclose(widths + 0.14, rollouts.lag[shown] + 1)
