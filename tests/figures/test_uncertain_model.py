"""Figure 8.2: bands for one dimension of a transition."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import uncertain_model
from rewardtogo.figures.uncertain_model import POSTERIORS, bands, cover, model, truth


@pytest.fixture(scope="module")
def models():
    return {name: model(name) for name in POSTERIORS}


@pytest.mark.parametrize("name", POSTERIORS)
def test_bands(item, models, name):
    seen, gap = np.array([-2.0, -1.5, -1.0, 0.7, 1.2, 1.7]), np.array([-3.0, 2.8, 3.0])
    on, off = bands(models[name], seen), bands(models[name], gap)
    with item("8.58") as check:
        check(abs(cover(models[name]) - 0.9), "<=", 0.08, f"{name}: cover of bands for 90 %, fresh data")
        check(np.abs(on.mean - truth(seen)[0]).max(), "<=", 0.15, f"{name}: mean at seen angles, from the truth")
        unknown = lambda found: (found.total**2 - found.noise**2).mean()  # noqa: E731
        # Weights that are independent, or dropped at random, know less of what they do not know: for them it is only drawn.
        if name == "bootstrap ensemble":
            check(unknown(off) / unknown(on), ">=", 3, f"{name}: epistemic variance off the data, times that on them")


def test_the_drawing(models):
    figure = uncertain_model.draw_models(models, 0)
    assert len(figure.axes) == 3
    for axis, regression in zip(figure.axes, models.values(), strict=True):
        mean = axis.get_lines()[0].get_ydata()
        assert np.array_equal(mean, bands(regression, uncertain_model.GRID).mean)
    FigureCanvasAgg(figure).draw()
