"""`rtg solve`: what it prints, as a board and as JSON, and what it draws."""

import json

import numpy as np
import pytest

from rewardtogo.cli.main import SOLVERS, main
from rewardtogo.envs.toy_text import gymnasium_table
from rewardtogo.runner.solve import SWEEPING, report, solve_by_name


@pytest.mark.parametrize("method", SOLVERS)
def test_every_method_solves_the_lake(method, capsys):
    assert main(["solve", "FrozenLake-v1", "--method", method, "--json"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert not err and found["converged"] and len(found["values"]) == len(found["policy"]) == 16
    expected = 0.7441902878 if method == "backward_induction" else 14 / 17
    assert found["expected_return"] == pytest.approx(expected, abs=1e-7)
    assert found["horizon"] == (100 if method == "backward_induction" else None)


def test_the_board(capsys, tmp_path):
    picture = tmp_path / "deep" / "cliff.png"
    assert main(["solve", "CliffWalking-v1", "--method", "policy_iteration", "--out", str(picture)]) == 0
    out = capsys.readouterr().out
    board = [line for line in out.splitlines() if "C" in line and "G" in line]
    assert "expected return -13" in out and len(board) == 1
    assert board[0].split() == ["-13", "↑", *"C" * 10, "G"]
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_arguments_of_the_environment_and_plain_letters():
    found = solve_by_name("FrozenLake-v1", "policy_iteration", map_name="8x8", is_slippery=False)
    assert found.expected_return == pytest.approx(1.0)
    text = report(found, arrows=False)
    assert text.isascii() and len(text.splitlines()) == 11
    # A walk by the actions shown gets to the goal in 14 moves, although every way there has the same value.
    state, moves = 0, 0
    while not found.problem.terminal[state]:
        state, moves = int(found.problem.successors[state, found.actions[state], 0]), moves + 1
    assert (state, moves) == (63, 14)


def test_a_taxi_has_two_boards_and_a_discount():
    found = solve_by_name("Taxi-v4", "modified_policy_iteration", gamma=0.9)
    text = report(found)
    assert text.count("the passenger") == 2 and "discount 0.9" in text and " P" in text and " D" in text
    # No way leads across a wall, and a way leads across every other side.
    P, board = gymnasium_table("Taxi-v4").P, found.panels[0]
    walls = {(r, c) for r in range(5) for c in range(4) if P[board.states[r, c]][2][0][1] == board.states[r, c]}
    assert board.walls == walls and len(walls) == 6 and text.count("|") == 12
    best = [solve_by_name("Taxi-v4", m, gamma=0.9).expected_return for m in ("value_iteration", "policy_iteration")]
    assert np.ptp([*best, found.expected_return]) <= 1e-8
    assert set(SWEEPING) < set(SOLVERS)
