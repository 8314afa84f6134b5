"""The figures of chapter 5: what is drawn is what was computed, and shows what it is said to show."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import bellman_projection, divergences
from rewardtogo.figures.bellman_projection import FEATURES, example, one_step, path
from rewardtogo.value.operators import bellman_backup, projection, sup_norm


def test_the_picture_is_to_scale(item):
    figure = bellman_projection.draw(seed=0)
    FigureCanvasAgg(figure).draw()
    axes = figure.axes[0]
    dots = [np.asarray(line.get_xydata())[0] for line in axes.get_lines() if line.get_marker() == "o"]
    value = FEATURES[:, 0]
    backed_up = bellman_backup(example(0.9), value)
    computed = [value, backed_up, projection(FEATURES) @ backed_up, np.array([0.5, 0.2])]
    line = np.asarray(axes.get_lines()[0].get_xydata())
    step = one_step()
    with item("5.26") as check:
        check(
            max(np.abs(a - b).max() for a, b in zip(dots, computed, strict=True)),
            "<=",
            1e-12,
            "points drawn, from those computed",
        )
        check(np.abs(line[:, 1] - 2 * line[:, 0]).max(), "==", 0, "the line Ω")
        for norm, name in ((sup_norm, "sup"), (np.linalg.norm, "L2")):
            gained = float(norm(step.projected - step.optimum) - norm(step.value - step.optimum))
            check(gained, ">", 0, f"how much further from V* than V is V' = ΠBV, {name} norm")
        ratio = sup_norm(step.backed_up - step.optimum) / sup_norm(step.value - step.optimum)
        check(ratio, "<=", 0.9, "how near BV is, to V's distance")
        assert np.array_equal(path(0.9, 2, True)[1], step.projected)


def test_the_curves_diverge_and_converge(item):
    figure = divergences.draw(seed=0)
    FigureCanvasAgg(figure).draw()
    curves = {line.get_label(): np.asarray(line.get_ydata()) for line in figure.axes[0].get_lines()}
    fits = {line.get_label(): np.asarray(line.get_ydata()) for line in figure.axes[1].get_lines()}
    with item("5.28") as check:
        check(
            curves["semi-gradient TD"][-1] / curves["semi-gradient TD"][0],
            ">",
            100,
            "growth of semi-gradient TD, as drawn",
        )
        check(curves["semi-gradient TD, a table"][-1], "<", 1e-1, "error of a table, as drawn")
    with item("5.32") as check:
        for name in ("TDC", "GTD2", "residual gradient"):
            check(curves[name][-1], "<", curves[name][0], f"error of {name} at the end, as drawn")
    with item("5.27") as check:
        check(fits["γ = 0.9"][-1] / 1.08**100, "<=", 1 + 1e-9, "w after 100 fits, over 1.08^100, as drawn")
        check(np.abs(fits["γ = 5/6"] - 1).max(), "<=", 1e-9, "w at γ = 5/6, from 1")
