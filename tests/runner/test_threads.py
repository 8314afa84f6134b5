"""Threads of the CPU: what is asked for is what XLA has, a run remembers it, and each algorithm gets the number that suits it."""

import json
import os
import subprocess
import sys

import pytest

import rewardtogo as rtg
from rewardtogo.catalogue import ALGORITHMS
from rewardtogo.cli.main import main
from rewardtogo.runner.folder import RunFolder
from rewardtogo.runner.threads import threads_for, used_threads

COUNT = """
import glob, json, os, sys
import rewardtogo as rtg
rtg.use_threads(int(sys.argv[1]))
import jax
jax.jit(lambda x: x @ x)(jax.numpy.ones((200, 200))).block_until_ready()
print(json.dumps([open(f).read().startswith("tf_XLAEigen") for f in glob.glob("/proc/self/task/*/comm")].count(True)))
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="threads are counted by Linux's files")
@pytest.mark.parametrize("number", [1, 3])
def test_xla_computes_with_as_many_threads(number: int) -> None:
    one_device = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    found = subprocess.run(
        [sys.executable, "-c", COUNT, str(number)],
        env=one_device,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert json.loads(found.stdout) == number


@pytest.mark.parametrize("wrong", [0, -1, True, 1.5])
def test_no_such_number_of_threads(wrong) -> None:
    with pytest.raises((ValueError, TypeError), match=r"threads|violates"):
        rtg.use_threads(wrong)


@pytest.mark.parametrize(
    "algorithm, env, seeds, threads",
    [
        ("sac", "Pendulum-v1", 1, 1),
        ("ppo", "CartPole-v1", 5, 1),
        ("ppo", "CartPole-v1", 64, None),
        ("pets", "Pendulum-v1", 1, None),
        ("dqn", "ALE/Pong-v5", 1, None),
    ],
)
def test_the_number_suits(algorithm: str, env: str, seeds: int, threads: int | None) -> None:
    assert threads_for(ALGORITHMS[algorithm].path, env, seeds) == threads


@pytest.mark.parametrize("given, asked, threads", [(None, [], 1), ("2", [], 2), ("2", ["--threads", "3"], 3)])
def test_a_run_remembers_its_threads(tmp_path, monkeypatch, given, asked, threads) -> None:
    """What is asked for wins over the environment, and that over what suits; a resumed run computes as it did before."""
    monkeypatch.delenv("NPROC", raising=False)
    if given:
        monkeypatch.setenv("NPROC", given)
    out = str(tmp_path / "run")
    assert main(["train", "reinforce", "CartPole-v1", "--steps", "2000", "--out", out, "--quiet", *asked]) == 0
    assert RunFolder(tmp_path / "run").config()["threads"] == threads
    monkeypatch.delenv("NPROC")
    assert main(["resume", out, "--steps", "3000", "--quiet"]) == 0
    assert used_threads() == threads


def test_a_number_that_is_none(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.delenv("NPROC", raising=False)
    assert main(["train", "reinforce", "CartPole-v1", "--threads", "0", "--out", str(tmp_path / "run")]) == 2
    assert "threads must be a whole number of at least 1" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
