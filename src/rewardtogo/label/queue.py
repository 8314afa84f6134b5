"""Observations that wait for somebody's label, and the log of what was said: one folder a batch (item 2.10).

The log is append-only JSON, a line an answer, on the disk before it counts: a process that is killed loses none. What stands in
memory is always what reading the log again would give, undone answers included.
"""

import dataclasses
import json
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import PyTree

from ..core import EnvSpec
from ..data.files import Damaged, sync
from .actions import allowed, element

LEASE = 120.0
"""Seconds for which an observation that somebody is looking at is given to nobody else."""
LONGEST_NAME = 64


@dataclasses.dataclass(frozen=True)
class Answer:
    """What one labeller says to one observation: an action, or None where they pass."""

    action: np.ndarray | None

    @property
    def passed(self) -> bool:
        """Whether there is no label."""
        return self.action is None


class LabelQueue:
    """N observations, who has said what to them, and who looks at which. Safe to use from several threads.

    - `log`: the file of answers, which is read first if there is one.
    - `observations`: a tree of arrays `[N, ...]`; `own`: what the current policy would do, `[N, ...]`.
    - `votes`: labellers who have to answer an observation before it is done.

    An answer is settled by the majority: the action named most often, the one named first among equals; in a box the median of
    each entry. Raises `Damaged` where the log is none of these observations.
    """

    def __init__(
        self,
        log: Path,
        spec: EnvSpec,
        observations: PyTree[np.ndarray],
        own: np.ndarray,
        votes: int = 1,
        clock: Callable[[], float] = time.monotonic,
    ):
        if votes < 1:
            raise ValueError(f"there is at least one vote for a label, not {votes}")
        self.log, self.spec, self.observations, self.own, self.votes = log, spec, observations, np.asarray(own), votes
        self.size = len(self.own)
        self._clock, self._lock = clock, threading.RLock()
        self._answers: list[dict[str, Answer]] = [{} for _ in range(self.size)]
        self._history: dict[str, list[tuple[int, Answer | None]]] = {}
        self._leases: dict[int, tuple[str, float]] = {}
        self._first_open = 0
        self._done = 0
        self._scores: dict[int, float] = {}
        self._disputed: set[int] = set()
        self._closed = False
        self._read()

    # --- the log ---------------------------------------------------------------------------------------------------------------

    def _read(self) -> None:
        """Take in what the log says, and cut off a line that was not finished."""
        if not self.log.exists():
            return
        text = self.log.read_bytes()
        whole = text.rfind(b"\n") + 1
        if whole < len(text):
            with self.log.open("r+b") as file:
                file.truncate(whole)
                os.fsync(file.fileno())
        for number, line in enumerate(text[:whole].splitlines(), 1):
            try:
                event = json.loads(line)
                self._apply(*self._understood(event))
            except (ValueError, TypeError, KeyError) as error:
                raise Damaged(f"{self.log} is damaged: line {number} is no answer ({error})") from error

    def _understood(self, event: dict[str, Any]) -> tuple[str, int, Answer | None]:
        """Who, which observation, and what; None where the last answer is taken back."""
        who = self.labeller(event["by"])
        kinds = [kind for kind in ("action", "skip", "undo") if kind in event]
        if len(kinds) != 1:
            raise ValueError("it is neither an action, nor a pass, nor taken back")
        index = self.index(event["item"])
        if kinds[0] == "undo":
            return who, index, None
        return who, index, Answer(None if kinds[0] == "skip" else self.action(index, event["action"]))

    def _write(self, event: dict[str, Any]) -> None:
        if self._closed:
            raise ValueError("this batch is closed: its labels are being learnt from")
        # One write and one sync: a line is in the file whole, or it is cut off when it is read.
        line, new = json.dumps(event, separators=(",", ":")).encode() + b"\n", not self.log.exists()
        with self.log.open("ab", buffering=0) as file:
            length = file.tell()
            try:
                if file.write(line) != len(line):
                    raise OSError("the disk is full")
                os.fsync(file.fileno())
            except OSError as error:
                file.truncate(length)
                raise OSError(f"the answer could not be written to {self.log}: {error.strerror or error}") from error
        if new:
            sync(self.log.parent)

    def close(self) -> None:
        """Take no more answers."""
        with self._lock:
            self._closed = True

    # --- what is asked for, checked -----------------------------------------------------------------------------------------------

    def labeller(self, name: Any) -> str:
        """A labeller's name. Raises `ValueError` where it is none."""
        if not isinstance(name, str) or not name.strip() or len(name) > LONGEST_NAME or not name.isprintable():
            raise ValueError(f"a labeller has a name of 1 to {LONGEST_NAME} characters, not {name!r}")
        return name.strip()

    def index(self, value: Any) -> int:
        """The number of an observation. Raises `ValueError` where there is none such."""
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < self.size:
            raise ValueError(
                f"there is no observation {value!r} in this batch: they are numbered from 0 to {self.size - 1}"
            )
        return value

    def action(self, index: int, value: Any) -> np.ndarray:
        """An action for an observation, as an array of the action space. Raises `ValueError` where it is not in it."""
        return element(self.spec.action, value, self.allowed(index), f"at observation {index}")

    def allowed(self, index: int) -> np.ndarray | None:
        """Which actions are allowed at an observation, where it says so."""
        return allowed(self.spec.action, one_of(self.observations, index))

    # --- questions and answers ------------------------------------------------------------------------------------------------------

    def next(self, who: Any) -> int | None:
        """The first observation that waits for this labeller and that nobody else is looking at; None where there is none."""
        who = self.labeller(who)
        with self._lock:
            now = self._clock()
            for index in self._waiting(who):
                holder, until = self._leases.get(index, (who, 0.0))
                if holder == who or until <= now:
                    self._leases = {i: h for i, h in self._leases.items() if h[0] != who and h[1] > now}
                    self._leases[index] = (who, now + LEASE)
                    return index
            return None

    def _waiting(self, who: str) -> Iterator[int]:
        for index in range(self._first_open, self.size):
            if len(self._answers[index]) < self.votes and who not in self._answers[index]:
                yield index

    def label(self, index: Any, action: Any, who: str) -> None:
        """Answer an observation; an earlier answer of the same labeller is replaced. On the disk when this returns."""
        with self._lock:
            who, index = self.labeller(who), self.index(index)
            answer = Answer(self.action(index, action))
            self._write({"item": index, "by": who, "action": answer.action.tolist()})  # type: ignore[union-attr]
            self._apply(who, index, answer)

    def skip(self, index: Any, who: str) -> None:
        """Pass: this labeller does not know."""
        with self._lock:
            who, index = self.labeller(who), self.index(index)
            self._write({"item": index, "by": who, "skip": True})
            self._apply(who, index, Answer(None))

    def undo(self, who: str) -> int | None:
        """Take this labeller's last answer back, and give the observation it was to; None where there is nothing to take back."""
        with self._lock:
            who = self.labeller(who)
            if not self._history.get(who):
                return None
            index = self._history[who][-1][0]
            self._write({"item": index, "by": who, "undo": True})
            self._apply(who, index, None)
            self._leases[index] = (who, self._clock() + LEASE)
            return index

    def _apply(self, who: str, index: int, answer: Answer | None) -> None:
        history, answers = self._history.setdefault(who, []), self._answers[index]
        was_done = len(answers) >= self.votes
        if answer is not None:
            history.append((index, answers.get(who)))
        else:
            if not history or history[-1][0] != index:
                raise ValueError(f"{who!r} takes back what was not said last")
            answer = history.pop()[1]
        if answer is None:
            del answers[who]
        else:
            answers[who] = answer
        self._leases.pop(index, None)
        self._done += (len(answers) >= self.votes) - was_done
        self._first_open = min(self._first_open, index)
        while self._first_open < self.size and len(self._answers[self._first_open]) >= self.votes:
            self._first_open += 1
        self._count(index)

    def _count(self, index: int) -> None:
        said = [a.action for a in self._answers[index].values() if a.action is not None]
        self._disputed.discard(index)
        self._scores.pop(index, None)
        if said:
            if any(not np.array_equal(said[0], other) for other in said[1:]):
                self._disputed.add(index)
            self._scores[index] = self._agreement(self._majority(said), np.asarray(self.own[index]))

    def _agreement(self, label: np.ndarray, own: np.ndarray) -> float:
        """Share of entries that are alike; in a box, one less the mean distance in half widths, at least 0."""
        spec = self.spec.action
        if spec.kind != "box":
            return float(np.mean(label == own))
        low, high = spec.bounds()
        bounded = np.isfinite(low) & np.isfinite(high)
        half = np.where(bounded, (np.where(bounded, high, 1.0) - np.where(bounded, low, -1.0)) / 2, 1.0)
        distance = np.abs(np.clip(own, low, high) - label) / half
        return float(max(0.0, 1.0 - distance.mean()))

    def _majority(self, said: list[np.ndarray]) -> np.ndarray:
        if self.spec.action.kind == "box":
            return np.median(np.stack(said), axis=0).astype(self.spec.action.dtype)
        flat = np.stack([np.ravel(a) for a in said])
        # `Counter` keeps the order of first mention, which decides among equals.
        settled = [Counter(entry.tolist()).most_common(1)[0][0] for entry in flat.T]
        return np.asarray(settled, self.spec.action.dtype).reshape(self.spec.action.shape)

    # --- where it stands ---------------------------------------------------------------------------------------------------------------

    def answers(self, index: Any) -> dict[str, Answer]:
        """What each labeller says to an observation."""
        with self._lock:
            return dict(self._answers[self.index(index)])

    def previous(self, who: str) -> int | None:
        """The observation that this labeller answered last."""
        history = self._history.get(who)
        return history[-1][0] if history else None

    @property
    def done(self) -> bool:
        """Whether every observation has as many answers as it needs."""
        return self._done == self.size

    @property
    def disputed(self) -> list[int]:
        """Observations to which labellers say different things."""
        with self._lock:
            return sorted(self._disputed)

    def progress(self) -> dict[str, Any]:
        """Counts: `size`, `done`, `labelled`, `passed`, `answers` by labeller, `disputed`, and `agreement` with the current policy.

        `agreement` lies between 0 and 1 and is None before the first label.
        """
        with self._lock:
            scores = list(self._scores.values())
            return {
                "size": self.size,
                "done": self._done,
                "labelled": len(scores),
                "passed": sum(bool(a) for a in self._answers) - len(scores),
                "answers": {who: len(history) for who, history in self._history.items() if history},
                "disputed": len(self._disputed),
                "agreement": float(np.mean(scores)) if scores else None,
            }

    def labels(self) -> tuple[np.ndarray, np.ndarray]:
        """The settled labels `[N, ...]`, and which of them there are, `[N]`; zeros where nobody gave one."""
        spec = self.spec.action
        with self._lock:
            known = np.zeros(self.size, bool)
            labels = np.zeros((self.size, *spec.shape), spec.dtype)
            for index in self._scores:
                said = [a.action for a in self._answers[index].values() if a.action is not None]
                labels[index], known[index] = self._majority(said), True
            return labels, known

    def settle(self) -> tuple[np.ndarray, np.ndarray]:
        """Close the batch and give its `labels`, so that no answer comes between. Raises `ValueError` where there is none."""
        with self._lock:
            if not self._scores:
                raise ValueError(
                    "there is no label in this round yet, so there is nothing to learn from: answer at least one"
                )
            self._closed = True
            return self.labels()


def answer_by(
    function: Callable[[Any], Any], queue: LabelQueue, who: str = "script", at_most: int | None = None
) -> int:
    """A scripted labeller: answers what waits for it with `function` of one observation, None to pass. Returns how many it answered."""
    count = 0
    while at_most is None or count < at_most:
        index = queue.next(who)
        if index is None:
            break
        action = function(one_of(queue.observations, index))
        if action is None:
            queue.skip(index, who)
        else:
            queue.label(index, np.asarray(action).tolist(), who)
        count += 1
    return count


def one_of(observations: PyTree[np.ndarray], index: int) -> Any:
    """One observation of a tree of N."""
    if isinstance(observations, dict):
        return {name: one_of(part, index) for name, part in observations.items()}
    return np.asarray(observations[index])
