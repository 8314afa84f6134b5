"""Runs that labels drive: with files between, the same as an expert who is a function; resumed, several labellers, refused requests."""

import contextlib
import csv
import json
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

import rewardtogo as rtg
from rewardtogo.core import env_spec
from rewardtogo.data.files import Damaged
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.imitation import BC, DAgger, Fallible, as_expert
from rewardtogo.label import LabelledRun, answer_by, open_labelling, start_labelling
from rewardtogo.nn import MLP
from rewardtogo.runner.collect import collect_demonstrations
from rewardtogo.runner.engine import run as train
from rewardtogo.runner.evaluate import Evaluator

LEARNER = {"network": {"sizes": [8]}, "learning_rate": 0.01}
LOOP = {"updates": 5, "batch_size": 16}


def balance(observation):
    """Pushes towards where the pole falls."""
    return (jnp.dot(jnp.asarray([0.1, 0.4, 3.0, 1.0]), observation) > 0).astype(jnp.int32)


def in_numpy(observation: np.ndarray) -> int:
    return int(np.asarray(balance(jnp.asarray(observation))))


def begin(out: Path, **options) -> LabelledRun:
    options = {"rounds": 3, "size": 20, "num_envs": 2, "learner": LEARNER, "loop": LOOP, "quiet": True, **options}
    return start_labelling("CartPole-v1", out=out, **options)


def differences(one: Path, other: Path) -> list[str]:
    """Files of two runs that are not equal, bit for bit; seconds do not count."""
    wrong = []
    for name in ("policy.safetensors", "best/policy.safetensors"):
        ours, theirs = load_file(one / name), load_file(other / name)
        wrong += [f"{name}: {k}" for k in ours if ours[k].tobytes() != theirs[k].tobytes()]
    tables = []
    for run in (one, other):
        with (run / "metrics.csv").open(newline="") as file:
            tables.append([{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)])
    return wrong + ["metrics.csv"] * (tables[0] != tables[1])


@pytest.fixture(scope="module")
def scripted(tmp_path_factory) -> Path:
    """A run that a script labelled in one sitting."""
    with begin(tmp_path_factory.mktemp("scripted") / "run") as run:
        while run.round is not None:
            answer_by(in_numpy, run.round.queue)
            run.finish_round()
        return run.folder.path


def test_a_script_gives_what_an_expert_who_is_a_function_gives(scripted, tmp_path, item):
    loop = {**LOOP, "unroll": 10, "beta": 0.0}
    known = rtg.train(
        "dagger", "CartPole-v1", expert=balance, steps=60, num_envs=2, out=tmp_path / "known", learner=LEARNER, loop=loop, quiet=True
    )  # fmt: skip
    with item("2.10") as check:
        ours, theirs = load_file(scripted / "policy.safetensors"), load_file(known.path / "policy.safetensors")
        wrong = sum(ours[k].tobytes() != theirs[k].tobytes() for k in theirs)
        check(len(theirs), ">=", 4, "arrays of the policy")
        check(wrong, "==", 0, "arrays that differ between a scripted labeller with files and DAgger with the function")
    ours, theirs = rtg.Run(scripted, None).metrics, known.metrics
    for name in ("mistakes", "labels", "bc_loss", "return_mean", "env_steps"):
        np.testing.assert_array_equal(ours[name], theirs[name])


def test_the_folder_is_a_run(scripted):
    policy = rtg.load(scripted)
    assert policy(np.zeros(4, np.float32)) in (0, 1)
    assert json.loads((scripted / "evaluation.json").read_text())["env_steps"] == 60
    assert rtg.Run(scripted, None).metrics["labels"].tolist() == [20, 40, 60]
    assert (scripted / "curve.png").exists()
    folders = sorted(p.name for p in (scripted / "labels").iterdir() if p.is_dir())
    assert folders == ["00000001", "00000002", "00000003"]
    lines = (scripted / "labels" / "00000002" / "answers.jsonl").read_text().splitlines()
    assert len(lines) == 20 and {"item", "by", "action"} == set(json.loads(lines[0]))


def test_resumed_it_is_the_run_that_was_not_interrupted(scripted, tmp_path):
    """Left in the middle of a batch, between two, and after the last: nothing is asked twice, and the result is the same."""
    path = tmp_path / "run"
    with begin(path) as run:
        assert run.round is not None
        answer_by(in_numpy, run.round.queue, at_most=7)
    asked = 7
    for stop in (13, 4, 1000, 1000):
        with open_labelling(path, quiet=True) as run:
            if run.round is None:
                break
            asked += answer_by(in_numpy, run.round.queue, at_most=stop)
            if run.round.queue.done:
                run.finish_round()
    assert asked == 60 and differences(scripted, path) == []
    with open_labelling(path, quiet=True) as run:
        assert run.round is None and run.finished == 3
        with pytest.raises(ValueError, match=r"all 3 rounds of .* are done: give more rounds"):
            run.finish_round()


def test_what_was_passed_is_left_out(tmp_path):
    with begin(tmp_path / "run", rounds=2) as run:
        assert run.round is not None
        with pytest.raises(ValueError, match=r"no label in this round yet"):
            run.finish_round()
        answer_by(lambda o: in_numpy(o) if o[0] > 0 else None, run.round.queue)
        labelled = run.round.queue.progress()["labelled"]
        assert 0 < labelled < 20 and run.round.queue.done
        row = run.finish_round()
        assert row["labels"] == labelled
        # A round that is finished early.
        answer_by(in_numpy, run.round.queue, at_most=3)
        assert run.finish_round()["labels"] == labelled + 3
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["env_steps"] == 40


def test_the_observations_before(tmp_path):
    with begin(tmp_path / "run", size=120) as run:
        batch = run.round
        assert batch is not None and batch.queue.size == 120
        ends = batch._ends
        for index in (0, 5, 37, 59, 60, 61, 99):
            before = batch.before(index, 8)
            assert before == list(range(index - len(before), index)) and len(before) <= 8
            assert not any(ends[i] for i in before)
            whole = len(before) == 8 or index - len(before) in (0, 60) or ends[index - len(before) - 1]
            assert whole
        observation = np.asarray(batch.queries.observations)
        assert np.array_equal(batch.queue.observations[61], observation[1, 1])


def test_demonstrations_begin_it_and_more_rounds_follow(scripted, tmp_path):
    path = collect_demonstrations(scripted, episodes=3, out=tmp_path / "data")[0]
    with begin(tmp_path / "run", data=str(path), rounds=1, loop={**LOOP, "capacity": 1000}) as run:
        assert run.round is not None
        answer_by(in_numpy, run.round.queue)
        run.finish_round()
        assert run.round is None
    with pytest.raises(ValueError, match=r"the run has 1 rounds already: --rounds can add some, and 0 is less"):
        open_labelling(tmp_path / "run", rounds=0)
    with pytest.raises(ValueError, match=r"room for the labels of [0-9]+ rounds, not of 400"):
        open_labelling(tmp_path / "run", rounds=400)
    with open_labelling(tmp_path / "run", rounds=2, quiet=True) as run:
        assert run.round is not None and run.round.number == 2
        answer_by(in_numpy, run.round.queue)
        run.finish_round()
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["env_steps"] == 40


def test_one_process_at_a_time(tmp_path):
    with begin(tmp_path / "run"):
        with pytest.raises(ValueError, match=r"another process is labelling .*: use its page, or stop it first"):
            open_labelling(tmp_path / "run")
    open_labelling(tmp_path / "run", quiet=True).close()


def test_gymnasiums_environments_are_filmed(tmp_path):
    pytest.importorskip("pygame", reason="pictures need the extra render")
    with begin(tmp_path / "run", backend="gymnasium", size=6, num_envs=2, rounds=2) as run:
        assert run.round is not None
        frames = sorted(p.name for p in (run.round.folder / "frames").iterdir())
        assert frames == [f"{i:06d}.png" for i in range(6)]
        answer_by(in_numpy, run.round.queue, at_most=2)
    with open_labelling(tmp_path / "run", quiet=True) as run:
        assert run.round is not None
        answer_by(in_numpy, run.round.queue)
        run.finish_round()
        answer_by(in_numpy, run.round.queue)
        run.finish_round()
    assert "render_mode" not in json.loads((tmp_path / "run" / "config.json").read_text())["env"]["kwargs"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rounds": 0}, "the number of rounds must be at least 1"),
        ({"size": 0}, "the number of observations in a round must be at least 1"),
        ({"votes": 0}, "answered by 1 to 99 labellers, not 0"),
        ({"num_envs": 0}, "at least one environment"),
        ({"loop": {"beta": 0.5}}, "a person labels and does not act"),
        ({"loop": {"unrol": 5}}, "unrol"),
        ({"learner": {"network": "nosuch"}}, "nosuch"),
    ],
)
def test_what_is_refused_writes_nothing(options, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        begin(tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()


def test_other_runs_and_damaged_ones(scripted, tmp_path):
    with pytest.raises(Damaged, match=r"there is no run folder"):
        open_labelling(tmp_path / "nowhere")
    config = json.loads((scripted / "config.json").read_text())
    other = tmp_path / "other"
    other.mkdir()
    (other / "config.json").write_text(json.dumps({**config, "algorithm": "ppo", "expert": None}))
    with pytest.raises(ValueError, match=r"a run of ppo that no person labels: name its environment instead"):
        open_labelling(other)
    with begin(tmp_path / "run"):
        pass
    (tmp_path / "run" / "labels" / "00000001" / "queries.safetensors").write_bytes(b"nothing")
    with pytest.raises(Damaged, match=r"queries.safetensors is damaged"):
        open_labelling(tmp_path / "run")
    with pytest.raises(ValueError, match=r"a person gives them with `rtg label`"):
        rtg.resume(tmp_path / "run")
    with contextlib.suppress(FileNotFoundError):
        (tmp_path / "run" / "labels" / "00000001" / "round.json").unlink()
    with pytest.raises(Damaged, match=r"round.json is damaged or missing"):
        open_labelling(tmp_path / "run")


@pytest.mark.slow
def test_how_wrong_a_labeller_may_be(item):
    """Return against the share of random labels, median of three seeds, and what a majority of nine mends."""
    env = vectorize(TimeLimit(CartPole(), 200), 2)
    spec, evaluate = env_spec(env), Evaluator(vectorize(TimeLimit(CartPole(), 200), 50), 50)

    def returns(noise: float, votes: int = 1) -> list[float]:
        expert = Fallible(as_expert(balance, spec), spec, noise=noise, votes=votes)
        asking = DAgger(env, BC(network=MLP(32), learning_rate=3e-3), expert, unroll=40, updates=300, beta=0.0)
        states = [train(asking, jax.random.key(seed), 6)[0] for seed in range(3)]
        return sorted(float(evaluate(asking.policy(state), jax.random.key(9))[0].mean()) for state in states)

    medians = [returns(noise)[1] for noise in (0.0, 0.2, 0.5, 0.8, 1.0)]
    mended = returns(0.2, votes=9)
    with item("2.9") as check:
        check(medians[0] / 200, ">=", 0.95, "return without noise, in the expert's")
        check(
            max(b - a for a, b in pairwise(medians)), "<=", 10, "rise of the return from one noise to the next, of 200"
        )
        check(medians[-1] / 200, "<=", 0.2, "return where every label is random, in the expert's")
        check(mended[0] / 200, ">=", 0.95, "worst of three seeds, every fifth label random, majority of nine")


def test_a_majority_of_labellers_mends_their_errors(tmp_path, item):
    """Five people, each wrong in one answer of five, through the queue: the settled labels are the expert's almost everywhere."""
    draws = np.random.default_rng(0)
    with begin(tmp_path / "run", rounds=1, size=300, votes=5) as run:
        assert run.round is not None
        queue = run.round.queue
        right = np.asarray(jax.vmap(balance)(jnp.asarray(queue.observations)))
        for who in "abcde":
            wrong = draws.random(queue.size) < 0.2
            for index in range(queue.size):
                queue.label(index, int(right[index]) ^ int(wrong[index]), who)
        labels, known = queue.labels()
        with item("2.9") as check:
            check(known.sum(), "==", 300, "observations settled by five votes")
            check(
                (labels != right).mean(),
                "<=",
                0.1,
                "errors of the majority, where each is wrong in 0.2: 0.058 expected",
            )
        assert queue.progress()["disputed"] > 100
