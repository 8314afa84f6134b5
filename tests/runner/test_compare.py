"""`rtg compare`: interquartile means, intervals, and when not to trust them."""

import json

import numpy as np
import pytest
from scipy import stats

from rewardtogo.runner.compare import compare, final_return, interquartile_mean, probability_of_improvement, table
from rewardtogo.runner.folder import RunFolder

CONFIG = {"row_every": 1, "eval_every": 1, "eval_episodes": 20, "iterations": 1, "loop": {"class": "Loop"}}
ENV = {"backend": "jax", "num_envs": 1, "kwargs": {}, "by_name": True}


@pytest.fixture
def make_run(tmp_path):
    def make(algorithm, score, seed=0, env="CartPole-v1", steps=1000, learner=None):
        path = tmp_path / f"run-{len(list(tmp_path.iterdir()))}"
        path.mkdir()
        config = {
            "algorithm": algorithm,
            "env": {"id": env, **ENV},
            "seed": seed,
            "steps": steps,
            "learner": learner or {},
        }
        RunFolder(path).write_config({**CONFIG, **config})
        (path / "evaluation.json").write_text(json.dumps({"return_mean": score, "env_steps": steps}))
        return path

    return make


def test_interquartile_mean_is_the_trimmed_mean():
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 4, 5, 10, 13):
        values = rng.normal(size=(3, n))
        np.testing.assert_allclose(
            interquartile_mean(values, axis=1), stats.trim_mean(values, 0.25, axis=1), rtol=1e-12
        )


def test_probability_of_improvement_is_mann_whitneys():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 6, 9), rng.integers(0, 5, 7)
    probability, (low, high) = probability_of_improvement(x, y)
    assert probability == pytest.approx(stats.mannwhitneyu(x, y).statistic / 63)
    assert low < probability < high
    resampled = [
        np.mean((a[:, None] > b[None]) + 0.5 * (a[:, None] == b[None]))
        for a, b in ((rng.choice(x, 9), rng.choice(y, 7)) for _ in range(4000))
    ]
    np.testing.assert_allclose([low, high], np.quantile(resampled, [0.025, 0.975]), atol=0.02)


def test_groups_pairs_and_numbers(make_run):
    runs = [make_run("ppo", score, seed) for seed, score in enumerate((500, 490, 480, 100, 495))]
    runs += [make_run("dqn", score, seed) for seed, score in enumerate((200, 210, 220, 230, 240))]
    runs += [make_run("ppo", -300 - seed, seed, env="Pendulum-v1") for seed in range(5)]
    found = compare([*runs, runs[0]])
    ppo = next(g for g in found["groups"] if (g["algorithm"], g["env"]) == ("ppo", "CartPole-v1"))
    assert (ppo["seeds"], ppo["steps"], ppo["mean"], ppo["median"]) == (5, 1000, 413.0, 490.0)
    assert ppo["iqm"] == pytest.approx(np.mean([480, 490, 495]))
    assert 100 <= ppo["iqm_ci95"][0] < ppo["iqm"] < ppo["iqm_ci95"][1] <= 500
    (pair,) = found["comparisons"]
    assert (pair["better"], pair["worse"], pair["probability"]) == ("ppo", "dqn", pytest.approx(20 / 25))
    assert found["warning"] is None and json.loads(json.dumps(found)) == found


def test_the_table_is_aligned(make_run):
    runs = [make_run("ppo", 500.0 + seed, seed) for seed in range(5)] + [make_run("a-longer-name", -12345.6, 0)]
    lines = table(compare(runs)).splitlines()
    head, rows = lines[0], lines[1:3]
    for name in ("seeds", "steps", "IQM", "95 % interval"):
        end = head.index(name) + len(name)
        assert all(row[end - 1] != " " and row[end : end + 2] in ("  ", "") for row in rows)
    assert "-12,345.6" in rows[0] and "unknown" in rows[0] and "a-longer-name over" not in lines[-1]
    assert any(line.startswith("CartPole-v1  ppo over a-longer-name") for line in lines)
    assert lines[-1] == "warning: a-longer-name in CartPole-v1: one seed says little about others, train at least 5"


def test_warnings(make_run):
    few = [make_run("ppo", 1.0, seed) for seed in range(4)]
    assert "4 seeds say little" in compare(few)["warning"]
    assert "seed 0 is there more than once" in compare([*few, make_run("ppo", 1.0, 0)])["warning"]
    assert "between 1,000 and 5,000 steps" in compare([*few, make_run("ppo", 1.0, 9, steps=5000)])["warning"]
    other = make_run("ppo", 1.0, 9, learner={"network": {"sizes": [8]}, "gamma": 0.9})
    assert "the runs differ in learner." in (compare([other, *few])["warning"] or "")
    longer = [make_run("dqn", 1.0, seed, steps=3000) for seed in range(5)]
    five = [*few, make_run("ppo", 1.0, 4)]
    assert "took different numbers of steps, 1,000 and 3,000" in compare([*five, *longer])["warning"]


def test_trained_runs(trained):
    found = compare([trained / "seeds", trained / "ppo", trained / "other"])
    counts = {g["algorithm"]: g["seeds"] for g in found["groups"]}
    assert counts == {"ppo": 4, "dqn": 1} and "seed 0" in found["warning"]


def test_without_evaluation(make_run):
    run = make_run("ppo", 1.0)
    (run / "evaluation.json").unlink()
    with pytest.raises(ValueError, match="has not been evaluated yet: finish it with `rtg resume"):
        compare([run])
    RunFolder(run).append_rows(
        [
            {"iteration": i, "env_steps": 10 * i, "return_mean": 1.0, "eval_return_mean": value}
            for i, value in enumerate((5.0, 7.0, float("nan")))
        ]
    )
    assert final_return(RunFolder(run)) == (7.0, 10)


def test_wrong_requests(tmp_path, make_run):
    with pytest.raises(ValueError, match="at least one run folder"):
        compare([])
    with pytest.raises(ValueError, match="there is no run folder"):
        compare([tmp_path / "nothing"])
    run = make_run("ppo", 1.0)
    (run / "evaluation.json").write_text('{"return_mean": "high"}')
    with pytest.raises(ValueError, match="is damaged: it has no numbers"):
        compare([run])
