"""What a person looks at: an observation as a picture, and as numbers with their names."""

import dataclasses
import math
import threading
from collections import OrderedDict
from typing import Any

import numpy as np

from ..core import MASK, EnvSpec
from ..envs.drawing import is_picture, observed, picture_of
from ..runner.episode import compiled_env
from .film import png
from .queue import one_of
from .run import LabelledRun, Round

KEPT = 512
"""Pictures that are kept once drawn."""
MOST_NUMBERS = 64

_POLE = ("position", "velocity", "angle", "angular velocity")
_PENDULUM = ("cosine", "sine", "angular velocity")
_JOINTS = ("cosine 1", "sine 1", "cosine 2", "sine 2", "velocity 1", "velocity 2")
NUMBERS: dict[str, tuple[str, ...]] = {
    "CartPole-v1": _POLE,
    "CartPoleNoVel-v1": ("position", "angle"),
    "MountainCar-v0": ("position", "velocity"),
    "MountainCarContinuous-v0": ("position", "velocity"),
    "Pendulum-v1": _PENDULUM,
    "PendulumNoVel-v1": ("cosine", "sine"),
    "Acrobot-v1": _JOINTS,
    "BrakeLight": ("sensor", "light", "obstacle"),
    "Lane": ("offset", "heading", "curvature"),
    "Drone": ("tree",),
    "LastTwo": ("bit",),
    "CartPoleSwingUp": ("position", "velocity", "cosine", "sine", "angular velocity"),
    "Obstacles": ("right", "up", "goal right", "goal up"),
}
"""What the numbers of an observation are called."""


class Pictures:
    """The pictures of a run's observations: filmed while acting, or drawn as `rtg play` draws what is compiled; else none."""

    def __init__(self, run: LabelledRun):
        self._env = compiled_env(run.plan.config["env"], run.plan.env)
        self._space = run.algorithm.spec.observation.to_space()
        self._kept: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._lock = threading.Lock()

    def close(self) -> None:
        """Let go of what was drawn."""
        with self._lock:
            self._kept.clear()

    def png(self, batch: Round, index: int) -> bytes | None:
        """The picture of an observation as a PNG file; None where there is none."""
        place = (batch.number, batch.queue.index(index))
        with self._lock:
            if place in self._kept:
                self._kept.move_to_end(place)
                return self._kept[place]
            found = self._draw(batch, index)
            if found is not None:
                self._kept[place] = found
                while len(self._kept) > KEPT:
                    self._kept.popitem(last=False)
            return found

    def _draw(self, batch: Round, index: int) -> bytes | None:
        filmed = batch.folder / "frames" / f"{index:06d}.png"
        if filmed.exists():
            return filmed.read_bytes()
        seen = one_of(batch.queue.observations, index)
        drawn = observed(self._space, seen) if self._env is None else picture_of(self._env, seen)
        return None if drawn is None else png(drawn)


@dataclasses.dataclass
class _Column:
    """One number of an observation: what it is called, where it stands, and the ends between which it is drawn."""

    title: str
    part: str | None
    index: int
    low: float
    high: float
    grows: bool
    """Whether the space has no ends for it, so that what was seen gives them."""
    whole: bool
    """Whether it is a whole number."""


class Numbers:
    """Shows observations in numbers: for each its name, its value and the range in which it is drawn.

    The range is that of the space; where that has no bounds, of what was seen (`see`). Boards, which
    are seen as pictures, and parts of more than `MOST_NUMBERS` are left out.
    """

    def __init__(self, spec: EnvSpec, name: str):
        self.columns: list[_Column] = []
        whole = spec.observation
        for part, place in [(whole, None)] if whole.kind != "dict" else [(p, n) for n, p in whole.parts if n != MASK]:
            if part.size > MOST_NUMBERS or is_picture(part):
                continue
            low, high = (b.ravel().astype(np.float64) for b in part.bounds()) if part.kind == "box" else (
                np.zeros(part.size),
                np.asarray(part.counts or (2,) * part.size, np.float64) - 1,
            )  # fmt: skip
            known = NUMBERS.get(name, ()) if place is None else ()
            for i in range(part.size):
                title = known[i] if i < len(known) else f"{place or 'value'}{f' {i}' if part.size > 1 else ''}"
                # Some spaces say 1e38 where they mean that there is no end.
                grows = bool(max(abs(low[i]), abs(high[i])) >= 1e6)
                ends = (math.inf, -math.inf) if grows else (float(low[i]), float(high[i]))
                self.columns.append(_Column(title, place, i, *ends, grows, np.dtype(part.dtype).kind != "f"))

    def see(self, observations: Any) -> None:
        """Take N observations, a tree of `[N, ...]`, into the ranges."""
        for column in self.columns:
            if column.grows:
                values = np.asarray(observations if column.part is None else observations[column.part])
                values = values.reshape(len(values), -1)[:, column.index]
                column.low, column.high = min(column.low, float(values.min())), max(column.high, float(values.max()))

    def of(self, observation: Any) -> list[dict[str, Any]]:
        """One observation in numbers."""
        return [
            {
                "name": c.title,
                "value": float(np.ravel(observation if c.part is None else observation[c.part])[c.index]),
                "low": c.low,
                "high": max(c.high, c.low + 1e-9),
                "whole": c.whole,
            }
            for c in self.columns
        ]
