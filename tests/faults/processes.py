"""Runs of the command in processes of their own, which may be killed, and the comparison of what they leave."""

import csv
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

COMMON = ["--preset", "none", "--learner.network.sizes", "8", "--quiet"]
PPO = ["ppo", "CartPole-v1", "--num-envs", "2", "--loop.unroll", "16", *COMMON]
PPO += ["--learner.epochs", "1", "--learner.minibatches", "1", "--learner.learning-rate", "linear:1e-3:0"]
DQN = ["dqn", "CartPole-v1", "--num-envs", "2", "--loop.warm-up", "100", "--loop.batch-size", "8", *COMMON]
DQN += ["--loop.replay.capacity", "1000", "--learner.epsilon", "linear:1:0.05"]
OFTEN = ["--checkpoint-every", "0.05"]


def start(cache: Path, *arguments: object) -> subprocess.Popen:
    """`rtg ...`, which keeps compiled programs in `cache`."""
    command = [sys.executable, "-m", "rewardtogo.cli.main", *map(str, arguments)]
    environment = os.environ | {"RTG_CACHE": str(cache), "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen) -> str:
    """What it said on stderr; it must end with status 0."""
    error = process.communicate(timeout=300)[1]
    assert process.returncode == 0, error
    return error


def checkpoints(run: Path) -> list[str]:
    """Names of the checkpoints, in order."""
    folder = run / "checkpoints"
    return sorted(p.name for p in folder.iterdir() if p.name.isdigit()) if folder.exists() else []


def wait_for_checkpoint(process: subprocess.Popen, run: Path) -> bool:
    """Wait until there is a checkpoint that was not there before; False where the process ended first."""
    before = checkpoints(run)[-1:]
    while process.poll() is None:
        if checkpoints(run)[-1:] > before:
            return True
        time.sleep(0.01)
    return False


def differences(one: Path, other: Path) -> list[str]:
    """Everything in which two finished runs differ, bit by bit; seconds do not count."""
    wrong = [] if checkpoints(one)[-1] == checkpoints(other)[-1] else ["the last iteration"]
    for name in (
        f"checkpoints/{checkpoints(one)[-1]}/state.safetensors",
        "policy.safetensors",
        "best/policy.safetensors",
    ):
        ours, theirs = load_file(one / name), load_file(other / name)
        wrong += [] if ours.keys() == theirs.keys() else [f"{name}: names"]
        wrong += [f"{name}: {key}" for key in ours if ours[key].tobytes() != theirs[key].tobytes()]
        assert sum(np.size(array) for array in ours.values()) > 50
    rows, others = table(one), table(other)
    wrong += [] if rows == others else ["metrics.csv"]
    assert len(rows) > 20
    same = (one / "evaluation.json").read_bytes() == (other / "evaluation.json").read_bytes()
    return wrong + ([] if same else ["evaluation.json"])


def table(run: Path) -> list[dict[str, str]]:
    """The rows of metrics.csv without the column of seconds."""
    with (run / "metrics.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]
