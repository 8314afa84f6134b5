"""Mistakes against T: what is drawn is exact, and what is learnt lies where it should (items 2.27 and 2.28)."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import tightrope_mistakes
from rewardtogo.figures.tightrope_mistakes import EPS, copy_policy, learn, mistakes, repaired_policy
from rewardtogo.imitation import error_bounds

HORIZONS = np.array([8, 16, 32, 64])


def slope(values: np.ndarray) -> float:
    return float(np.polyfit(np.log(HORIZONS), np.log(values), 1)[0])


def test_what_is_learnt(item, monkeypatch):
    found = learn(0)
    cloned, asked = mistakes(found.cloned, HORIZONS), mistakes(found.asked, HORIZONS)
    with item("2.27") as check:
        check(
            abs(found.cloned[0, 1] - EPS),
            "<=",
            0.005,
            "chance of a mistake on the rope, BC from labels that are wrong in 1 %",
        )
        check(found.cloned[1, 0], ">=", 0.8, "chance of a mistake on the ground, of which its data knows nothing")
        check(
            slope(cloned),
            ">=",
            1.3,
            "slope of its log mistakes against log T, T = 8..64 (it gets back on in one step of eleven)",
        )
    with item("2.28") as check:
        check(slope(asked), "<=", 1.1, "slope of DAgger's log mistakes against log T")
        check(slope(asked), ">=", 0.9, "the same")
        check((asked - EPS * HORIZONS).max(), "<=", 2, "DAgger's mistakes beyond eps T")
    monkeypatch.setattr(tightrope_mistakes, "learn", lambda seed: found)
    figure = tightrope_mistakes.draw()
    FigureCanvasAgg(figure).draw()
    lines = {line.get_label(): line.get_ydata() for line in figure.axes[0].get_lines()}
    assert np.allclose(lines["DAgger, learnt"], mistakes(found.asked, tightrope_mistakes.HORIZONS[::3]))
    assert np.allclose(lines["a copy on the tightrope"], mistakes(copy_policy(EPS), tightrope_mistakes.HORIZONS))


def test_the_curves_are_those_of_the_calculator(item):
    bounds = [error_bounds(EPS, int(n)) for n in HORIZONS]
    with item("2.28") as check:
        gap = np.abs(mistakes(repaired_policy(EPS), HORIZONS) - [b.linear for b in bounds])
        check(gap.max(), "<=", 1e-12, "mistakes of a copy that knows the ground, from eps T")
    assert np.allclose(mistakes(copy_policy(EPS), HORIZONS), [b.tightrope for b in bounds], atol=1e-12)
