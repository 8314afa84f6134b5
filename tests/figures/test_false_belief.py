"""Figures 8.1 and 8.2: how wrong plans in an overfitted model are, and what bands cover."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import false_belief
from rewardtogo.figures.false_belief import COLOURS, GRID, beliefs, true_reward


@pytest.fixture(scope="module")
def found():
    return [beliefs(seed) for seed in range(8)]


def test_an_ensemble_is_fooled_less(item, found):
    gap = {name: float(np.mean([each[name].gap for each in found])) for name in COLOURS}
    with item("8.49") as check:
        check(
            gap["one network"], ">", 0.1, "one network: predicted less true reward of the plan, mean of 8 sets of data"
        )
        shrunk = 1 - gap["ensemble"] / gap["one network"]
        check(shrunk, ">=", 0.5, "share of it that is gone with an ensemble")
        over = {name: np.mean([each[name].plan[0] > false_belief.CLIFF for each in found]) for name in COLOURS}
        check(over["one network"], ">", 0, "one network: share of the plans that go over the cliff")
        check(over["ensemble"] - over["one network"], "<=", 0, "ensemble: less that")
    with item("8.51") as check:
        check(
            gap["ensemble, less a deviation"] - gap["ensemble"],
            "<",
            0,
            "pessimistic less expected, predictions less truth",
        )
        for each in found:
            lower = each["ensemble"].believed - each["ensemble, less a deviation"].believed
            check(lower.min(), ">=", 0, "expected less pessimistic, everywhere")


def test_the_drawing_is_of_these_numbers(found):
    figure = false_belief.draw_found(found, 0)
    left, right = figure.axes
    worst = max(found, key=lambda each: each["one network"].gap)
    drawn = [line.get_ydata() for line in left.get_lines() if len(line.get_xdata()) == len(GRID)]
    assert all(
        np.array_equal(line, worst[name].along(worst[name].plan)[0]) for line, name in zip(drawn, COLOURS, strict=True)
    )
    assert true_reward(np.array([1.4, 1.6])).tolist() == [1.4, -1.0]
    assert sum(line.get_linewidth() == 3 for line in right.get_lines()) == 3
    FigureCanvasAgg(figure).draw()
