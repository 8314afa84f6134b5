"""`kill -9` at random moments, SIGTERM and Ctrl-C: what is resumed becomes, bit for bit, the run that nothing interrupted."""

import json
import os
import random
import re
import signal
import time
from pathlib import Path

import pytest
from processes import DQN, OFTEN, PPO, checkpoints, differences, finish, start, wait_for_checkpoint

RUNS = {"ppo": [*PPO, "--steps", "64000"], "dqn": [*DQN, "--steps", "64000"]}
"""A second or two of training each, besides the ten evaluations."""


@pytest.fixture(scope="module")
def whole(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, float]]:
    """Runs that nothing interrupted, and about how long one trains once it has started."""
    found = {}
    for name, arguments in RUNS.items():
        run = tmp_path_factory.mktemp("whole") / name
        process = start(cache, "train", *arguments, *OFTEN, "--out", run)
        assert wait_for_checkpoint(process, run)
        began = time.monotonic()
        finish(process)
        found[name] = (run, time.monotonic() - began)
    return found


def kill_again_and_again(name: str, kills: int, cache: Path, whole: dict[str, tuple[Path, float]], run: Path) -> None:
    """Start a run, kill it at a random moment, resume it, kill it, and so on; then let it finish and compare."""
    reference, seconds = whole[name]
    moments = random.Random(name)
    process = start(cache, "train", *RUNS[name], *OFTEN, "--out", run)
    done = 0
    while done < kills:
        # One kill in four falls anywhere after the start, before there is anything, or while it is being loaded.
        early = moments.random() < 0.25
        if early:
            time.sleep(moments.uniform(0.0, 1.5))
        else:
            wait_for_checkpoint(process, run)
            time.sleep(moments.uniform(0.0, 0.8 * seconds / kills))
        if process.poll() is not None:  # a fast machine was done before the moment came
            break
        process.kill()
        process.communicate()
        done += 1
        command = ("resume", run) if (run / "config.json").exists() else ("train", *RUNS[name], "--out", run)
        process = start(cache, *command, *OFTEN, "--quiet")
    assert done >= max(1, kills // 2)
    finish(process)
    assert differences(reference, run) == []
    assert not list((run / "checkpoints").glob(".*")) and len(checkpoints(run)) == 2


@pytest.mark.parametrize("name", RUNS)
def test_kill_9_twice(name, cache, whole, workplace):
    kill_again_and_again(name, 2, cache, whole, workplace / "run")


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_kill_9_ten_times(name, cache, whole, workplace):
    """Twenty kills in all, ten for each kind of loop."""
    kill_again_and_again(name, 10, cache, whole, workplace / "run")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals between processes")
def test_a_signal_writes_a_checkpoint_and_leaves_with_130(cache, whole, workplace):
    """SIGTERM, then Ctrl-C in what was resumed."""
    run = workplace / "run"
    process = start(cache, "train", *RUNS["ppo"], "--checkpoint-every", "0.2", "--out", run)
    for number in (signal.SIGTERM, signal.SIGINT):
        assert wait_for_checkpoint(process, run)
        time.sleep(0.1)
        process.send_signal(number)
        error = process.communicate(timeout=60)[1]
        assert process.returncode == 130, error
        said = re.fullmatch(r"rtg: interrupted after (\d+) steps; a checkpoint is written: rtg resume (.*)\n", error)
        assert said and Path(said[2]) == run, error
        about = json.loads((run / "checkpoints" / checkpoints(run)[-1] / "about.json").read_text())
        assert about["env_steps"] == int(said[1]) < 64_000
        assert (run / "policy.safetensors").exists() and not (run / "evaluation.json").exists()
        process = start(cache, "resume", run, "--checkpoint-every", "0.2", "--quiet")
    finish(process)
    assert differences(whole["ppo"][0], run) == []
