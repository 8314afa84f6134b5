"""What a labeller looks at: an observation as a picture, as numbers with their names, and what the actions are called."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from ..core import MASK, EnvSpec, Spec
from ..envs.toy_text import TABULAR
from ..runner.play import drawable
from .film import png
from .queue import one_of
from .run import LabelledRun, Round

KEPT = 512
"""Pictures that are kept once drawn."""
SMALLEST = 320
"""Points that a picture is wide at least: small ones are enlarged."""
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

_STATES: dict[str, Callable[[np.ndarray], Any]] = {
    "CartPole-v1": lambda o: o,
    "CartPoleNoVel-v1": lambda o: np.array([o[0], 0.0, o[1], 0.0]),
    "MountainCar-v0": lambda o: o,
    "MountainCarContinuous-v0": lambda o: o,
    "Pendulum-v1": lambda o: np.array([np.arctan2(o[1], o[0]), o[2]]),
    "PendulumNoVel-v1": lambda o: np.array([np.arctan2(o[1], o[0]), 0.0]),
    "Acrobot-v1": lambda o: np.array([np.arctan2(o[1], o[0]), np.arctan2(o[3], o[2]), o[4], o[5]]),
}
"""The state in which Gymnasium's original draws what was observed in its twin, velocities that do not show aside."""


class Pictures:
    """The pictures of a run's observations: drawn by the original, filmed while acting, or the observation itself; else none."""

    def __init__(self, run: LabelledRun):
        described = run.plan.config["env"]
        self.name, self._spec = described["id"], run.algorithm.spec.observation
        self._kept: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._lock = threading.Lock()
        self._original = self._drawn_by(described) if described["backend"] == "jax" and described["by_name"] else None

    def _drawn_by(self, described: dict[str, Any]) -> gymnasium.Env | None:
        if self.name not in _STATES and self.name not in TABULAR:
            return None
        # The masked environments are drawn whole, so the original is asked for by its own name.
        name = self.name.replace("NoVel", "")
        try:
            env = drawable({**described, "id": name})
            env.reset(seed=0)
            env.render()
        except Exception:  # without pygame, say: then numbers have to do
            return None
        return env

    def close(self) -> None:
        """Let go of what draws."""
        if self._original is not None:
            self._original.close()

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
        observation = one_of(batch.queue.observations, index)
        if self._original is not None:
            env: Any = self._original.unwrapped
            if self.name in _STATES:
                env.state = _STATES[self.name](np.asarray(observation, np.float64))
            else:
                env.s, env.lastaction = int(observation), None
            return png(np.asarray(self._original.render(), np.uint8))
        boards = [(s, v) for s, v in _parts(self._spec, observation) if _is_board(s)]
        return _board(*boards[0]) if boards else None


def _parts(spec: Spec, value: Any) -> list[tuple[Spec, np.ndarray]]:
    if spec.kind != "dict":
        return [(spec, np.asarray(value))]
    return [(part, np.asarray(value[name])) for name, part in spec.parts if name != MASK]


def _is_board(spec: Spec) -> bool:
    return spec.kind == "box" and len(spec.shape) in (2, 3) and min(spec.shape[:2]) > 1


def _board(spec: Spec, value: np.ndarray) -> bytes:
    """A matrix, or a stack of them, as a picture: three channels are colours, others a stack whose last one is the latest."""
    low, high = spec.bounds()
    low, high = (low, high) if spec.is_bounded else (np.minimum(value.min(), 0), np.maximum(value.max(), 1))
    grey = (255 * (value - low.astype(np.float64)) / np.maximum(high - low.astype(np.float64), 1e-9)).astype(np.uint8)
    if grey.ndim == 3 and grey.shape[2] == 2:  # the stones of one player and of the other
        picture = np.stack([grey[..., 0], grey[..., 1] // 2, grey[..., 1]], -1)
    elif grey.ndim == 3 and grey.shape[2] == 3:
        picture = grey
    else:
        picture = np.repeat((grey[..., -1] if grey.ndim == 3 else grey)[..., None], 3, -1)
    return png(np.ascontiguousarray(picture), max(1, SMALLEST // picture.shape[1]))


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
