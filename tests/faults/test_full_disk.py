"""A disk that is full: one sentence, status 1, and the last checkpoint is whole and can be gone on from."""

import errno
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from faulty import SMALL, Leaner
from safetensors.numpy import load_file

import rewardtogo as rtg
from rewardtogo.cli.main import main
from rewardtogo.runner import folder as run_folder
from rewardtogo.runner import policy as run_policy
from rewardtogo.runner import train as run_train

TRAIN = ("train", "faulty:Leaner", "CartPole-v1", "--num-envs", "2", "--loop.unroll", "4", "--steps", "32", "--quiet")
EVERY = ("--checkpoint-every", "0.000001", "--out")
GO_ON = ("--learner-class", "faulty:Leaner", "--quiet")


def full(path: object = None) -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), None if path is None else str(path))


@pytest.mark.parametrize("where", ["the state", "what is said of it", "the policy", "the table", "the renaming"])
def test_no_space_at_any_write_leaves_the_last_checkpoint(workplace, small_leaner, monkeypatch, capsys, where):
    """The third write of its kind fails."""
    calls = {"n": 0}

    def failing(function):
        def call(*arguments, **keywords):
            calls["n"] += 1
            if calls["n"] == 3:
                raise full(arguments[0])
            return function(*arguments, **keywords)

        return call

    with monkeypatch.context() as patch:
        if where == "the state":
            patch.setattr(run_folder, "save_tree", failing(run_folder.save_tree))
        if where == "what is said of it":
            # The configuration is the first of these.
            patch.setattr(run_folder, "write_json", failing(run_folder.write_json))
        if where == "the policy":
            patch.setattr(run_train, "save_policy", failing(run_policy.save_policy))
        if where == "the table":
            patch.setattr(run_folder.RunFolder, "append_rows", failing(run_folder.RunFolder.append_rows))
        if where == "the renaming":
            patch.setattr(Path, "rename", failing(Path.rename))
        assert main([*TRAIN, *EVERY, "run"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("rtg: ") and error.count("\n") == 1 and os.strerror(errno.ENOSPC) in error
    assert "whole" in error and "free some space" in error
    kept = sorted(p.name for p in (workplace / "run" / "checkpoints").iterdir())
    assert kept and all(name.isdigit() for name in kept)
    assert main(["resume", "run", *GO_ON]) == 0
    assert same_end(workplace / "run", small_leaner)


def test_no_space_from_the_beginning_leaves_nothing(workplace, monkeypatch, capsys):
    def no_space(path, *_, **__):
        raise full(path)

    with monkeypatch.context() as patch:
        patch.setattr(run_folder, "write_json", no_space)
        assert main([*TRAIN, *EVERY, "run"]) == 1
    assert os.strerror(errno.ENOSPC) in capsys.readouterr().err
    assert not (workplace / "run").exists()


def test_a_failure_of_the_writer_of_arrays_is_an_oserror(workplace, monkeypatch):
    from safetensors import SafetensorError

    def broken(*_, **__):
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    for module in (run_folder, run_policy):
        with monkeypatch.context() as patch:
            patch.setattr(module, "save_tree", broken)
            with pytest.raises(OSError, match="No space left"):
                rtg.train(Leaner(), "CartPole-v1", out=workplace / module.__name__, **SMALL)


def same_end(run: Path, reference: Path) -> bool:
    """Whether two finished runs ended with the same bits."""
    name = "checkpoints/00000004/state.safetensors"
    ours, theirs = load_file(run / name), load_file(reference / name)
    same = all(ours[key].tobytes() == theirs[key].tobytes() for key in theirs)
    return same and (run / "evaluation.json").read_bytes() == (reference / "evaluation.json").read_bytes()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 1 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    if os.name != "posix" or shutil.which("mount") is None:
        pytest.skip("there is no mount here")
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(place)]
    if subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("this user may not mount a tmpfs")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_small_disk_fills_up(small_disk, capsys):
    """DQN's replay makes a checkpoint of 0.4 MB: two of them fit, a third beside them does not."""
    run = small_disk / "run"
    command = ("train", "dqn", "CartPole-v1", "--learner.network.sizes", "4", "--loop.replay.capacity", "8000")
    options = ("--loop.warm-up", "8", "--loop.batch-size", "4", "--steps", "60", "--preset", "none", "--quiet")
    assert main([*command, *options, *EVERY, str(run)]) == 1
    error = capsys.readouterr().err
    assert error.startswith("rtg: ") and error.count("\n") == 1 and "whole" in error
    kept = sorted(p.name for p in (run / "checkpoints").iterdir())
    assert len(kept) == 2 and all(name.isdigit() for name in kept)
    assert not list(run.rglob(".*"))
    # With more room the run goes on from there to its end.
    subprocess.run(["mount", "-o", "remount,size=8m", str(small_disk)], check=True)
    assert main(["resume", str(run), "--quiet"]) == 0
    elsewhere = small_disk / "elsewhere"
    assert main([*command, *options, *EVERY, str(elsewhere)]) == 0
    last = sorted((elsewhere / "checkpoints").iterdir())[-1].name
    ours, theirs = (load_file(r / "checkpoints" / last / "state.safetensors") for r in (run, elsewhere))
    assert ours.keys() == theirs.keys() and all(ours[k].tobytes() == theirs[k].tobytes() for k in ours)
