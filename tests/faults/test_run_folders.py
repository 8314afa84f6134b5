"""Run folders and checkpoints that cannot be used: the sentence names the file, and nothing is changed."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from faulty import SMALL, Leaner, files_under
from safetensors.numpy import load_file, save_file

import rewardtogo as rtg
from rewardtogo.cli.main import main
from rewardtogo.data.files import Damaged

LAST = "checkpoints/00000004"
STATE = f"{LAST}/state.safetensors"


@pytest.fixture
def run(small_ppo: Path, workplace: Path) -> Path:
    """A run of 4 iterations with checkpoints 3 and 4, which may be damaged."""
    shutil.copytree(small_ppo, workplace / "run")
    return workplace / "run"


def cut(name: str, keep: float = 0.5) -> Callable[[Path], None]:
    def damage(run: Path) -> None:
        data = (run / name).read_bytes()
        (run / name).write_bytes(data[: int(len(data) * keep)])

    return damage


def write(name: str, data: bytes) -> Callable[[Path], None]:
    return lambda run: (run / name).write_bytes(data) and None


def remove(name: str) -> Callable[[Path], None]:
    return lambda run: shutil.rmtree(run / name) if (run / name).is_dir() else (run / name).unlink()


def change(name: str, **entries: object) -> Callable[[Path], None]:
    """Other entries in a JSON file; `...` takes one away, and `env__id` means the entry `id` of `env`."""

    def damage(run: Path) -> None:
        data = json.loads((run / name).read_text())
        for path, value in entries.items():
            *above, last = path.split("__")
            place = data
            for step in above:
                place = place[step]
            place.pop(last) if value is ... else place.update({last: value})
        (run / name).write_text(json.dumps(data))

    return damage


def rewrite(name: str, metadata: dict[str, str] | None = None, **arrays: np.ndarray | None) -> Callable[[Path], None]:
    """The same arrays under another header, with others in their places, or without some."""

    def damage(run: Path) -> None:
        old = load_file(run / name)
        found = next(n for n in old if n.endswith("bias"))
        new = {n: a for n, a in {**old, **{found: arrays["bias"]}}.items() if a is not None} if arrays else old
        save_file(new, run / name, {"format": "1"} if metadata is None else metadata)

    return damage


GO_ON = "resume run --steps 64"
CASES = {
    # Checkpoints: the sentence also says that the one before is whole, but is never taken in silence.
    "state cut in half": (cut(STATE), GO_ON, f"{STATE} damaged delete {LAST} iteration 3"),
    "state cut in its header": (cut(STATE, 0.01), GO_ON, f"{STATE} damaged delete"),
    "state empty": (cut(STATE, 0.0), GO_ON, f"{STATE} damaged"),
    "state gone": (remove(STATE), GO_ON, f"{STATE} missing delete {LAST} iteration 3"),
    "state is text": (write(STATE, b"once upon a time, there was a checkpoint"), GO_ON, f"{STATE} damaged"),
    "state of another writer": (rewrite(STATE, {}), GO_ON, f"{STATE} rewardtogo"),
    "state newer": (rewrite(STATE, {"format": "999"}), GO_ON, f"{STATE} 999 newer install"),
    "state lacks an array": (rewrite(STATE, bias=None), GO_ON, f"{STATE} bias another"),
    "state of another shape": (rewrite(STATE, bias=np.zeros(7, np.float32)), GO_ON, f"{STATE} bias float32[7]"),
    "state of another type": (rewrite(STATE, bias=np.zeros(4, np.int32)), GO_ON, f"{STATE} bias int32[4]"),
    "about gone": (remove(f"{LAST}/about.json"), GO_ON, f"{LAST}/about.json missing delete"),
    "about cut": (cut(f"{LAST}/about.json"), GO_ON, f"{LAST}/about.json damaged delete"),
    "about of another iteration": (change(f"{LAST}/about.json", iteration=3), GO_ON, f"{LAST}/about.json damaged"),
    # What the run is.
    "config gone": (remove("config.json"), GO_ON, "run config.json"),
    "config cut": (cut("config.json"), GO_ON, "config.json damaged JSON"),
    "config binary": (write("config.json", b"\xff\x00\xfe"), GO_ON, "config.json damaged"),
    "config is a list": (write("config.json", b"[]"), GO_ON, "config.json configuration"),
    "config newer": (change("config.json", format=999), GO_ON, "config.json 999 newer install"),
    "config without seed": (change("config.json", seed=...), GO_ON, "config.json 'seed' missing"),
    "config with a wrong env": (change("config.json", env=3), GO_ON, "config.json 'env' 3"),
    "config without an id": (change("config.json", env__id=...), GO_ON, "config.json 'id' missing"),
    "config with no rows": (change("config.json", row_every=0), GO_ON, "config.json 'row_every' 0"),
    "config of an unknown env": (change("config.json", env__id="CartPol-v1"), GO_ON, "CartPol-v1 CartPole-v1"),
    "config out of range": (change("config.json", learner__gamma=7), GO_ON, "PPO.gamma [0, 1] 7"),
    "config of another network": (change("config.json", learner__network__sizes=[8]), GO_ON, f"{STATE} expected"),
    "config of another algorithm": (
        change("config.json", algorithm="reinforce", learner={}),
        GO_ON,
        f"{STATE} another algorithm",
    ),
    "config names code to run": (
        change("config.json", algorithm="os:system", learner={"class": "os:system"}),
        GO_ON,
        "os:system not part --learner-class",
    ),
    "config names another loop": (change("config.json", loop__class="os:system"), GO_ON, "os:system loops"),
    # The policy.
    "policy gone": (remove("policy.safetensors"), "eval run", "policy.safetensors missing"),
    "policy cut": (cut("policy.safetensors"), "eval run", "policy.safetensors damaged"),
    "policy newer": (rewrite("policy.safetensors", {"format": "999"}), "eval run", "policy.safetensors 999 newer"),
    "policy.json gone": (remove("policy.json"), "eval run", "policy.json"),
    "policy.json cut": (cut("policy.json"), "eval run", "policy.json damaged"),
    "policy.json newer": (change("policy.json", format=999), "eval run", "policy.json 999 newer"),
    "policy.json without spaces": (change("policy.json", action=...), "eval run", "policy.json spaces"),
    "policy.json of another network": (
        change("policy.json", learner__network__sizes=[8]),
        "eval run",
        "policy.safetensors",
    ),
    "best gone": (remove("best"), "eval run --checkpoint best", "best policy.json"),
    "no such checkpoint": (lambda run: None, "eval run --checkpoint 2", "checkpoint 2 3, 4"),
    "no such choice": (lambda run: None, "eval run --checkpoint worst", "'worst' best last"),
    # The table.
    "metrics empty": (write("metrics.csv", b""), "plot run --out new.png", "metrics.csv damaged"),
    "metrics of words": (
        write("metrics.csv", b"env_steps,return_mean\none,two\n"),
        "plot run --out new.png",
        "metrics.csv damaged 'one'",
    ),
    "metrics binary": (write("metrics.csv", b"\xff\xfe\x00"), "plot run --out new.png", "metrics.csv damaged"),
    "metrics binary, resumed": (write("metrics.csv", b"\xff\xfe\x00"), GO_ON, "metrics.csv damaged"),
    # Requests that do not fit the run.
    "finished": (lambda run: None, "resume run", "finished 32 --steps"),
    "a smaller budget": (lambda run: None, "resume run --steps 8", "32 8"),
    "another environment": (lambda run: None, "eval run --env Pendulum-v1", "another environment [4] [3]"),
    "an unknown environment": (lambda run: None, "eval run --env CartPol-v1", "'CartPol-v1' CartPole-v1"),
    "a policy that is no run": (remove("config.json"), "eval run", "config.json"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_folder_that_cannot_be_used_is_refused(refused, run, name):
    damage, command, fragments = CASES[name]
    damage(run)
    sentence = refused(*command.split()).replace(os.sep, "/")
    missing = [fragment for fragment in fragments.split() if fragment not in sentence]
    assert not missing, f"{missing} not in: {sentence}"


def test_deleting_the_damaged_checkpoint_is_enough(run, small_ppo):
    """What the sentence advises works, and gives what the run without damage gives."""
    cut(STATE)(run)
    assert main(["resume", "run", "--steps", "64", "--quiet"]) == 2
    shutil.rmtree(run / LAST)
    assert main(["resume", "run", "--quiet"]) == 0  # the checkpoint of iteration 3 had one iteration to go
    ours, theirs = load_file(run / STATE), load_file(small_ppo / STATE)
    assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)


def test_a_checkpoint_of_another_run_is_refused(refused, run, small_leaner):
    shutil.rmtree(run / LAST)
    shutil.copytree(small_leaner / LAST, run / LAST)
    assert "state.safetensors" in refused("resume", "run", "--steps", "64")


def test_a_checkpoint_that_was_half_written_by_a_killed_process_is_swept_away(small_leaner, workplace):
    shutil.copytree(small_leaner, workplace / "run")
    left = workplace / "run" / "checkpoints" / ".00000099.tmp"
    left.mkdir()
    (left / "state.safetensors").write_bytes(b"half of a che")
    rtg.resume(workplace / "run", steps=64, learner=Leaner(), quiet=True, checkpoint_every=1e-9)
    assert sorted(p.name for p in (workplace / "run" / "checkpoints").iterdir()) == ["00000007", "00000008"]


def test_a_run_that_was_killed_before_its_last_evaluation_is_finished_by_resume(small_leaner, workplace):
    shutil.copytree(small_leaner, workplace / "run")
    before = (small_leaner / "evaluation.json").read_bytes()
    for name in ("evaluation.json", "curve.png", "policy.safetensors", "policy.json"):
        (workplace / "run" / name).unlink()
    rtg.resume(workplace / "run", learner=Leaner(), quiet=True)
    assert (workplace / "run" / "evaluation.json").read_bytes() == before
    assert {p.name for p in (workplace / "run").iterdir()} == {p.name for p in small_leaner.iterdir()}


def test_half_a_row_is_written_again(small_leaner, workplace):
    shutil.copytree(small_leaner, workplace / "run")
    table = (workplace / "run" / "metrics.csv").read_text()
    (workplace / "run" / "metrics.csv").write_text(table[: len(table) - 7])
    shutil.rmtree(workplace / "run" / LAST)
    run = rtg.resume(workplace / "run", learner=Leaner(), quiet=True)
    assert run.metrics["iteration"].tolist() == [1, 2, 3, 4]


# --- where a run is to be written ----------------------------------------------------------------------------------------------

TRAIN = ("train", "ppo", "CartPole-v1", "--preset", "none")


def test_a_folder_with_something_in_it_is_left_alone(refused, workplace):
    (workplace / "mine").mkdir()
    (workplace / "mine" / "thesis.txt").write_text("years of work")
    for more in ((), ("--num-seeds", "2")):
        sentence = refused(*TRAIN, "--out", "mine", *more)
        assert "mine" in sentence and "not empty" in sentence and "rtg resume" in sentence


def test_a_file_is_no_folder(refused, workplace):
    (workplace / "file").write_text("x")
    assert "file" in refused(*TRAIN, "--out", "file")
    assert "cannot be made" in refused(*TRAIN, "--out", str(Path("file") / "run"))


def test_a_place_that_cannot_be_written(refused, monkeypatch):
    def mkdir(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "mkdir", mkdir)
    for out in (("--out", "mine"), ()):
        sentence = refused(*TRAIN, *out)
        assert "cannot be made" in sentence and "Permission denied" in sentence


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="permissions do not stop this user")
def test_a_folder_without_permission(refused, workplace):
    (workplace / "locked").mkdir(mode=0o500)
    assert "cannot be made" in refused(*TRAIN, "--out", str(Path("locked") / "run"))


def test_a_name_that_no_file_system_takes(refused):
    assert "cannot be made" in refused(*TRAIN, "--out", "x" * 5000)


def test_a_run_goes_into_an_empty_folder_and_numbers_count_on(workplace):
    (workplace / "mine").mkdir()
    assert rtg.train("faulty:Leaner", "CartPole-v1", out="mine", **SMALL).path == Path("mine")
    taken = [rtg.train("faulty:Leaner", "CartPole-v1", **SMALL).path.name for _ in range(2)]
    assert taken == ["faulty_Leaner-CartPole-v1-0-1", "faulty_Leaner-CartPole-v1-0-2"]


@pytest.mark.parametrize("name", ["nowhere", "a file", "an empty folder"])
@pytest.mark.parametrize("command", ["resume", "eval", "play", "plot", "compare", "export", "collect"])
def test_what_is_no_run_folder(refused, workplace, command, name):
    (workplace / "a file").write_text("x")
    (workplace / "an empty folder").mkdir()
    sentence = refused(command, name)
    assert name in sentence and ("run folder" in sentence or "policy.json" in sentence)


def test_from_python_it_is_an_exception_with_a_name(run):
    before = files_under(run)
    cut(STATE)(run)
    with pytest.raises(Damaged, match="delete the folder"):
        rtg.resume(run, steps=64)
    cut("policy.safetensors")(run)
    with pytest.raises(Damaged, match="damaged"):
        rtg.load(run)
    assert files_under(run).keys() == before.keys()
