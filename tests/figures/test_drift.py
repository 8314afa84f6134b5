"""Figure 2.1: the copy drifts, DAgger does not (items 2.5 and 2.6)."""

import jax
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.core import env_spec
from rewardtogo.envs.imitation_problems import Lane, steer
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.figures import drift
from rewardtogo.imitation import as_expert


@pytest.fixture(scope="module")
def found():
    return drift.measure(0)


def ranks(values: np.ndarray) -> np.ndarray:
    return np.argsort(np.argsort(values))


def test_the_copy_drifts(found, item):
    cloned, asked = found.deviation(found.cloned), found.deviation(found.asked)
    with item("2.6") as check:
        check(np.abs(found.trained).max(), "<=", 1e-3, "the training trajectory: the middle of the lane")
        check(
            np.corrcoef(ranks(cloned), np.arange(len(cloned)))[0, 1],
            ">",
            0.8,
            "rank correlation of BC's deviation with t",
        )
        check(cloned[-1] / asked[-1], ">=", 5, "BC's deviation at the end, in DAgger's")
        check(
            np.abs(found.asked).max(), "<", 1, "DAgger's greatest distance from the middle in 50 winds, the edge at 1"
        )


def test_everybody_has_the_same_wind(key):
    """The expert deviates from itself by nothing, and its wind is what it is in the environment: sd 0.02 a step."""
    expert, env = as_expert(steer, env_spec(vectorize(Lane(), 1))), Lane()
    one, two = (drift.drive(expert, env, key, 20) for _ in range(2))
    assert np.array_equal(one, two) and not np.array_equal(one, drift.drive(expert, env, jax.random.key(7), 20))
    first = jax.vmap(lambda k: drift.drive(expert, env, k, 1)[0])(jax.random.split(key, 2000))
    # y_1 = 0.2 sin(wind - 0.05 kappa_0), kappa_0 = 0, and the expert's answer to y = theta = 0 is 0.
    assert np.std(np.asarray(first)) == pytest.approx(0.2 * 0.02, rel=0.05)


def test_the_drawing_shows_what_was_measured(found, monkeypatch):
    monkeypatch.setattr(drift, "measure", lambda seed: found)
    figure = drift.draw()
    FigureCanvasAgg(figure).draw()
    lines = {line.get_label(): line.get_ydata() for line in figure.axes[1].get_lines()}
    assert np.allclose(lines["BC"], found.deviation(found.cloned))
    assert np.allclose(lines["DAgger"], found.deviation(found.asked))
