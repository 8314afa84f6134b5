"""Learning curves: what is drawn, and where to."""

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from rewardtogo.runner.folder import RunFolder
from rewardtogo.runner.plot import band, curve, draw_curves, evaluations, run_folders, smooth, student


def test_students_quantiles():
    for freedom in (1, 2, 4, 9, 10, 11, 20, 100, 10_000):
        assert student(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), abs=3e-3)


def test_running_mean():
    np.testing.assert_allclose(smooth(np.full(37, 3.0)), 3.0)
    line = np.arange(100.0)
    np.testing.assert_allclose(smooth(line)[5:-5], line[5:-5])
    noise = np.random.default_rng(0).normal(size=1000)
    assert smooth(noise).std() < 0.2 and len(smooth(noise)) == 1000
    assert smooth(np.array([2.0])) == [2.0]


def test_the_band_is_the_interval_of_the_mean():
    steps = np.array([0.0, 10.0, 20.0])
    curves = [(steps, steps + shift) for shift in (0.0, 1.0, 2.0)] + [(steps[:2], steps[:2] + 3.0)]
    grid, mean, half = band(curves)
    assert grid[0] == 0 and grid[-1] == 10
    np.testing.assert_allclose(mean, grid + 1.5)
    low, high = stats.t.interval(0.95, 3, loc=1.5, scale=stats.sem([0, 1, 2, 3]))
    np.testing.assert_allclose([1.5 - half[0], 1.5 + half[0]], [low, high], rtol=1e-3)


def test_what_a_curve_is(trained):
    folder = RunFolder(trained / "ppo")
    steps, returns = curve(folder)
    assert len(steps) and np.all(np.diff(steps) > 0) and np.all(np.isfinite(returns))
    assert len(evaluations(folder)[0]) >= 5


@pytest.mark.parametrize("names", [("ppo",), ("seeds",), ("seeds", "ppo", "other")])
@pytest.mark.parametrize("ending", ["png", "svg"])
def test_pictures(trained, tmp_path, names, ending):
    out = tmp_path / "new" / f"curves.{ending}"
    assert draw_curves([trained / name for name in names], out) == out
    if ending == "svg":
        text = out.read_text()
        assert "<svg" in text and "environment steps" in text and "return of an episode" in text
        assert ("dqn" in text) == ("other" in names)
    else:
        with Image.open(out) as picture:
            colours = len(set(picture.convert("RGB").resize((200, 120)).get_flattened_data()))
        assert picture.size[0] > 900 and colours > 20


def test_a_folder_of_runs_stands_for_them(trained):
    folders = run_folders([trained / "seeds", trained / "seeds" / "seed-1", trained / "ppo"])
    assert [f.path.name for f in folders] == ["seed-0", "seed-1", "seed-2", "ppo"]


def test_a_run_without_rows(untrained, tmp_path):
    out = draw_curves([untrained("ppo", "CartPole-v1")], tmp_path / "a.svg")
    assert "no episode has ended yet" in out.read_text()


def test_wrong_requests(trained, tmp_path):
    with pytest.raises(ValueError, match=r"ending in \.png, \.svg, \.pdf, \.jpg, \.webp, not to"):
        draw_curves([trained / "ppo"], tmp_path / "a.xyz")
    with pytest.raises(ValueError, match="there is no run folder"):
        draw_curves([tmp_path / "nothing"], tmp_path / "a.png")
