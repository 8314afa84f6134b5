"""The queue of observations and the log of answers: nothing said is lost, nothing that cannot be is taken, everybody gets their own."""

import json
import os
import random
import subprocess
import sys
import threading
import time
from pathlib import Path

import gymnasium.spaces as spaces
import numpy as np
import pytest

from rewardtogo.core import MASK, EnvSpec
from rewardtogo.core.spec import from_space
from rewardtogo.data.files import Damaged
from rewardtogo.label import LabelQueue, answer_by

DISCRETE = EnvSpec(from_space(spaces.Box(-1.0, 1.0, (3,))), from_space(spaces.Discrete(3)))
BOX = EnvSpec(from_space(spaces.Box(-1.0, 1.0, (3,))), from_space(spaces.Box(-2.0, 2.0, (2,))))


def queue(folder: Path, size: int = 6, spec: EnvSpec = DISCRETE, votes: int = 1, **options) -> LabelQueue:
    observations = np.linspace(-1.0, 1.0, size * 3, dtype=np.float32).reshape(size, 3)
    own = np.zeros((size, *spec.action.shape), spec.action.dtype)
    return LabelQueue(folder / "answers.jsonl", spec, observations, own, votes, **options)


def said(q: LabelQueue) -> list[dict[str, object]]:
    return [
        {who: None if a.action is None else a.action.tolist() for who, a in q.answers(i).items()} for i in range(q.size)
    ]


def test_label_skip_undo_go_back(tmp_path):
    q = queue(tmp_path)
    assert [q.next("ann"), q.next("ann")] == [0, 0]
    q.label(0, 2, "ann")
    q.skip(1, "ann")
    q.label(2, 0, "ann")
    q.label(0, 1, "ann")  # back to the first, with another answer
    assert said(q)[:4] == [{"ann": 1}, {"ann": None}, {"ann": 0}, {}]
    assert q.undo("ann") == 0 and said(q)[0] == {"ann": 2}  # what was said before
    assert q.undo("ann") == 2 and q.next("ann") == 2
    assert q.undo("ann") == 1 and q.undo("ann") == 0 and q.undo("ann") is None
    assert said(q) == [{}] * 6 and q.next("ann") == 0
    assert q.progress() == {
        "size": 6, "done": 0, "labelled": 0, "passed": 0, "answers": {}, "disputed": 0, "agreement": None,
    }  # fmt: skip


def test_what_is_read_again_is_what_stood_there(tmp_path):
    """After any sequence of requests, the log read by another process says the same as memory."""
    draws, q = random.Random(0), queue(tmp_path, votes=2)
    for _ in range(300):
        who = draws.choice(["ann", "bob", "cy"])
        request = draws.random()
        if request < 0.2:
            q.undo(who)
        elif request < 0.35:
            q.skip(draws.randrange(6), who)
        else:
            q.label(draws.randrange(6), draws.randrange(3), who)
    again = queue(tmp_path, votes=2)
    assert said(again) == said(q) and again.progress() == q.progress() and again.disputed == q.disputed
    assert again.done == q.done
    assert all(np.array_equal(a, b) for a, b in zip(again.labels(), q.labels(), strict=True))
    assert again.undo("bob") == q.undo("bob") and said(again) == said(q)


def test_progress_and_agreement(tmp_path):
    q = queue(tmp_path)
    for index, action in enumerate((0, 0, 0, 1)):
        q.label(index, action, "ann")
    q.skip(4, "ann")
    found = q.progress()
    assert (found["done"], found["labelled"], found["passed"], found["agreement"]) == (5, 4, 1, 0.75)
    assert not q.done
    q.label(5, 1, "bob")
    labels, known = q.labels()
    assert q.done and labels.tolist() == [0, 0, 0, 1, 0, 1] and known.tolist() == [True] * 4 + [False, True]
    assert q.progress()["answers"] == {"ann": 5, "bob": 1}


def test_several_labellers_get_different_items(tmp_path):
    now = [0.0]
    q = queue(tmp_path, clock=lambda: now[0])
    assert [q.next(who) for who in ("ann", "bob", "cy")] == [0, 1, 2]
    q.label(0, 1, "ann")
    assert q.next("ann") == 3 and q.next("bob") == 1
    now[0] = 1000.0  # bob has gone home
    assert q.next("dan") == 1


def test_labellers_at_once(tmp_path):
    """Four threads, 200 observations: each is answered once."""
    q = queue(tmp_path, 200)
    workers = [threading.Thread(target=answer_by, args=(lambda o: 1, q, name)) for name in "abcd"]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert q.done and all(len(answers) == 1 for answers in said(q))
    assert said(queue(tmp_path, 200)) == said(q)


def test_votes_majority_and_dispute(tmp_path):
    q = queue(tmp_path, 3, votes=3)
    for who, answers in {"ann": (1, 2, 0), "bob": (2, 2, 1), "cy": (2, 0, 2)}.items():
        assert answer_by(lambda o, a=iter(answers): next(a), q, who) == 3
    labels, known = q.labels()
    assert labels.tolist() == [2, 2, 0] and known.all()  # of three different ones, the first that was said
    assert q.disputed == [0, 1, 2] and q.progress()["disputed"] == 3
    assert q.next("ann") is None and q.done
    b = LabelQueue(tmp_path / "b", BOX, np.zeros((1, 3)), np.zeros((1, 2)), 3)
    for who, action in (("ann", [0.0, 1.0]), ("bob", [1.0, -1.0]), ("cy", [2.0, 0.5])):
        b.label(0, action, who)
    assert b.labels()[0].tolist() == [[1.0, 0.5]]
    assert b.progress()["agreement"] == pytest.approx(1 - (0.5 + 0.25) / 2)


def test_a_killed_labeller_loses_nothing(tmp_path):
    """`kill -9` at random moments: every answer that was acknowledged is there, and no more than one that was not."""
    program = f"""
import sys, numpy as np
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_label_queue import queue
from pathlib import Path
q = queue(Path(sys.argv[1]), 5000)
while (i := q.next("ann")) is not None:
    q.label(i, i % 3, "ann")
    sys.stdout.write(f"{{i}}\\n"); sys.stdout.flush()
"""
    acknowledged: list[int] = []
    for moment in (0.05, 0.15):
        process = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(moment)
        process.kill()
        rest = process.communicate()[0]
        acknowledged += [int(line) for line in (first + rest).split("\n")[:-1]]
        q = queue(tmp_path, 5000)
        stands = [i for i, answers in enumerate(said(q)) if answers]
        assert set(acknowledged) <= set(stands) and len(stands) <= len(acknowledged) + 3
        assert all(said_to == {"ann": i % 3} for i, said_to in enumerate(said(q)) if said_to)
        q.close()
    assert len(acknowledged) > 20 and len(set(acknowledged)) == len(acknowledged)


def test_a_line_that_was_not_finished_is_cut_off(tmp_path):
    q = queue(tmp_path)
    q.label(0, 1, "ann")
    q.close()
    with q.log.open("ab") as file:
        file.write(b'{"item":1,"by":"an')
    again = queue(tmp_path)
    again.label(1, 2, "ann")
    assert said(queue(tmp_path))[:2] == [{"ann": 1}, {"ann": 2}]


def test_a_full_disk_takes_no_answer(tmp_path, monkeypatch):
    q = queue(tmp_path)
    q.label(0, 1, "ann")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match=r"could not be written"):
            q.label(1, 1, "ann")
    assert said(q)[1] == {} and q.next("ann") == 1
    q.label(1, 2, "ann")
    assert said(queue(tmp_path)) == said(q)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"item":9,"by":"ann","action":1}', "line 1 is no answer .there is no observation 9"),
        ('{"item":1,"by":"ann","action":7}', "a whole number from 0 to 2, not 7"),
        ('{"item":1,"by":"ann","undo":true}', "takes back what was not said last"),
        ('{"item":1,"by":"ann"}', "neither an action"),
        ('{"by":"ann","action":1}', "'item'"),
        ("[1]", "line 1"),
        ("nonsense", "line 1"),
    ],
)
def test_a_damaged_log_is_refused(line, words, tmp_path):
    (tmp_path / "answers.jsonl").write_text(line + "\n")
    with pytest.raises(Damaged, match=words):
        queue(tmp_path)


@pytest.mark.parametrize("value", [3, -1, 0.5, "left", None, [1], True + 2, float("nan")])
def test_actions_that_are_none(value, tmp_path):
    q = queue(tmp_path)
    with pytest.raises(ValueError, match=r"an action here is a whole number from 0 to 2"):
        q.label(0, value, "ann")
    assert not q.log.exists()


def test_other_spaces(tmp_path):
    q = LabelQueue(tmp_path / "a", BOX, np.zeros((2, 3)), np.zeros((2, 2)))
    q.label(0, [0.1, -2.0], "ann")
    assert q.labels()[0][0].tolist() == [np.float32(0.1), -2.0]
    assert json.loads(q.log.read_text())["action"] == [float(np.float32(0.1)), -2.0]
    for wrong in ([0.1], [0.1, 2.5], [[0.1, 0.1]], 0.3, [0.1, float("inf")]):
        with pytest.raises(ValueError, match=r"2 numbers of shape"):
            q.label(1, wrong, "ann")
    several = EnvSpec(BOX.observation, from_space(spaces.MultiDiscrete([2, 3])))
    m = LabelQueue(tmp_path / "b", several, np.zeros((2, 3)), np.zeros((2, 2), np.int32))
    m.label(0, [1, 2], "ann")
    with pytest.raises(ValueError, match=r"each a choice that there is"):
        m.label(0, [2, 2], "ann")
    bits = EnvSpec(BOX.observation, from_space(spaces.MultiBinary(2)))
    m = LabelQueue(tmp_path / "c", bits, np.zeros((2, 3)), np.zeros((2, 2), np.int8))
    m.label(0, [1, 0], "ann")
    with pytest.raises(ValueError, match=r"each a choice that there is"):
        m.label(0, [2, 0], "ann")


def test_a_forbidden_action(tmp_path):
    seen = from_space(spaces.Dict({"board": spaces.Box(0, 1, (2,)), MASK: spaces.MultiBinary(3)}))
    observations = {"board": np.zeros((2, 2)), MASK: np.array([[1, 0, 1], [1, 1, 1]], np.int8)}
    q = LabelQueue(tmp_path / "a", EnvSpec(seen, DISCRETE.action), observations, np.zeros(2, np.int32))
    with pytest.raises(ValueError, match=r"action 1 is forbidden at observation 0: allowed are \[0, 2\]"):
        q.label(0, 1, "ann")
    q.label(1, 1, "ann")


@pytest.mark.parametrize("index", [6, -1, True, 1.0, "1", None])
def test_observations_that_do_not_exist(index, tmp_path):
    q = queue(tmp_path)
    for request in (lambda: q.label(index, 1, "ann"), lambda: q.skip(index, "ann"), lambda: q.answers(index)):
        with pytest.raises(ValueError, match=r"there is no observation .* they are numbered from 0 to 5"):
            request()


@pytest.mark.parametrize("who", ["", "  ", "x" * 65, "a\nb"])
def test_labellers_without_a_name(who, tmp_path):
    with pytest.raises(ValueError, match=r"a labeller has a name"):
        queue(tmp_path).label(0, 1, who)


def test_closed(tmp_path):
    q = queue(tmp_path)
    q.close()
    with pytest.raises(ValueError, match=r"this batch is closed"):
        q.label(0, 1, "ann")
