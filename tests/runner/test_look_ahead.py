"""`rtg plan`: what it plays, prints and draws, and what it refuses."""

import json

import pytest

from rewardtogo.cli.main import PLANNERS, main
from rewardtogo.planning import mpc
from rewardtogo.runner.look_ahead import plan_by_name, plannable


def test_the_command_knows_every_planner():
    assert set(mpc.PLANNERS) == set(PLANNERS)
    assert "Pendulum-v1" in plannable() and "Catch" not in plannable()


def test_a_pendulum_is_planned_up(capsys, tmp_path, item):
    film = tmp_path / "plan.gif"
    arguments = [
        "plan",
        "ilqr",
        "Pendulum-v1",
        "--episodes",
        "4",
        "--planner.iterations",
        "10",
        "--json",
        "--out",
        str(film),
    ]
    assert main(arguments) == 0
    out, _ = capsys.readouterr()
    found = json.loads(out)
    assert found["episodes"] == 4 and found["length_mean"] == 200 and found["planner"] == "ilqr"
    assert found["seconds_per_plan"] > 0
    assert film.read_bytes()[:6] == b"GIF89a"
    with item("8.45") as check:
        check(
            found["return_mean"],
            ">=",
            -250,
            "Pendulum-v1 by iLQR in its own dynamics, 4 episodes (the optimum is about -140)",
        )


def test_lines_for_people(capsys):
    assert (
        main(
            [
                "plan",
                "cem",
                "CartPole-v1",
                "--episodes",
                "1",
                "--horizon",
                "10",
                "--every",
                "10",
                "--planner.samples",
                "30",
            ]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert "CartPole-v1 by cem, 10 steps ahead, a plan every 10 steps: return" in out and "ms a plan" in out
    assert main(["plan", "mppi", "--help"]) == 0
    assert "--planner.temperature 1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["ilqrr", "Pendulum-v1"], "did you mean ilqr"),
        (["ilqr", "Foo-v1"], "there is no compiled"),
        (["ilqr", "Catch"], "does not tell its state"),
        (["ilqr", "CartPole-v1"], "these are discrete"),
        (["cem"], "which environment"),
        (["cem", "Pendulum-v1", "--horizon", "0"], "a horizon is a whole number"),
        (["cem", "Pendulum-v1", "--every", "30"], "not for 30"),
        (["cem", "Pendulum-v1", "--gamma", "2"], "must be a number in [0, 1]"),
        (["cem", "Pendulum-v1", "--planner.elites", "500"], "cannot choose 500 elites"),
        (["cem", "Pendulum-v1", "--planner.elite", "5"], "no option 'elite'"),
        (["cem", "Pendulum-v1", "--out", "x.png"], "a film is written to"),
    ],
)
def test_requests_that_cannot_be(capsys, arguments, words):
    assert main(["plan", *arguments]) == 2
    _, err = capsys.readouterr()
    assert words in err and err.count("\n") == 1


def test_a_plan_is_a_policy_with_a_value():
    played = plan_by_name(
        "cem", "Pendulum-v1", episodes=1, horizon=5, options={"samples": 20, "elites": 4, "iterations": 1}
    )
    assert played.returns.shape == (1,) and played.seconds_per_plan > 0
