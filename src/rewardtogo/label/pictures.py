"""What a labeller looks at: an observation as a picture, as numbers with their names, and what the actions are called."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np

from ..core import MASK, EnvSpec
from ..envs.drawing import observed, picture_of
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
}
"""What the numbers of an observation are called."""
ACTIONS: dict[str, tuple[str, ...]] = {
    "CartPole-v1": ("left", "right"),
    "CartPoleNoVel-v1": ("left", "right"),
    "MountainCar-v0": ("left", "none", "right"),
    "MountainCarContinuous-v0": ("force",),
    "Pendulum-v1": ("torque",),
    "PendulumNoVel-v1": ("torque",),
    "Acrobot-v1": ("negative torque", "none", "positive torque"),
    "Catch": ("left", "stay", "right"),
    "FrozenLake-v1": ("left", "down", "right", "up"),
    "FrozenLake8x8-v1": ("left", "down", "right", "up"),
    "CliffWalking-v1": ("up", "right", "down", "left"),
    "Taxi-v4": ("down", "up", "right", "left", "pick up", "drop off"),
    "LunarLander-v3": ("none", "left engine", "main engine", "right engine"),
}
"""What the choices of an action are called, or in a box its entries."""


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


def numbers(spec: EnvSpec, name: str, observations: Any) -> Callable[[int], list[dict[str, Any]]]:
    """What shows an observation in numbers: for each its name, value and the range in which it is drawn.

    The range is that of the space; where that has no bounds, that of the batch.
    """
    columns: list[tuple[str, np.ndarray, float, float]] = []
    whole = spec.observation
    for part, place in [(whole, None)] if whole.kind != "dict" else [(p, n) for n, p in whole.parts if n != MASK]:
        values = np.asarray(observations if place is None else observations[place])
        flat = values.reshape(len(values), -1).astype(np.float64)
        if flat.shape[1] > MOST_NUMBERS:
            continue
        low, high = (b.ravel().astype(np.float64) for b in part.bounds()) if part.kind == "box" else (
            np.zeros(flat.shape[1]),
            np.asarray(part.counts or (2,) * flat.shape[1], np.float64) - 1,
        )  # fmt: skip
        known = NUMBERS.get(name, ()) if place is None else ()
        for i in range(flat.shape[1]):
            title = known[i] if i < len(known) else f"{place or 'value'}{f' {i}' if flat.shape[1] > 1 else ''}"
            # Some spaces say 1e38 where they mean that there is no end.
            ends = [low[i], high[i]] if max(abs(low[i]), abs(high[i])) < 1e6 else [flat[:, i].min(), flat[:, i].max()]
            columns.append((title, flat[:, i], float(ends[0]), float(max(ends[1], ends[0] + 1e-9))))

    def of(index: int) -> list[dict[str, Any]]:
        return [{"name": t, "value": float(v[index]), "low": low, "high": high} for t, v, low, high in columns]

    return of
