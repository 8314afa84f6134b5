"""What a person looks at: an observation as a picture, and as numbers with their names."""

import dataclasses
import math
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
    "BrakeLight": ("sensor", "light", "obstacle"),
    "Lane": ("offset", "heading", "curvature"),
    "Drone": ("tree",),
    "LastTwo": ("bit",),
    "CartPoleSwingUp": ("position", "velocity", "cosine", "sine", "angular velocity"),
    "Obstacles": ("right", "up", "goal right", "goal up"),
}
"""What the numbers of an observation are called."""
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


class Painter:
    """Draws observations: as Gymnasium's original does where the environment is a twin, or the observation itself where it is a board.

    - `described`: the environment as `config.json` has it; `spec`: of its observations.
    """

    def __init__(self, described: dict[str, Any], spec: Spec):
        self.name, self._spec = described["id"], spec
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

    def png(self, observation: Any) -> bytes | None:
        """An observation as a PNG file; None where it has no picture."""
        if self._original is not None:
            env: Any = self._original.unwrapped
            if self.name in _STATES:
                env.state = _STATES[self.name](np.asarray(observation, np.float64))
            else:
                env.s, env.lastaction = int(_parts(self._spec, observation)[0][1]), None
            return png(np.asarray(self._original.render(), np.uint8))
        boards = [(s, v) for s, v in _parts(self._spec, observation) if _is_board(s)]
        if boards and self.name.startswith("ConnectFour"):  # whose lowest row is the first
            return _board(boards[0][0], boards[0][1][:, ::-1])
        return _board(*boards[0]) if boards else None


class Pictures:
    """The pictures of a run's observations, by number: filmed while acting, or painted; the last ones are kept."""

    def __init__(self, run: LabelledRun):
        self._painter = Painter(run.plan.config["env"], run.algorithm.spec.observation)
        self._kept: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._lock = threading.Lock()

    def close(self) -> None:
        """Let go of what draws."""
        self._painter.close()

    def png(self, batch: Round, index: int) -> bytes | None:
        """The picture of an observation as a PNG file; None where there is none."""
        place = (batch.number, batch.queue.index(index))
        with self._lock:
            if place in self._kept:
                self._kept.move_to_end(place)
                return self._kept[place]
            filmed = batch.folder / "frames" / f"{index:06d}.png"
            observation = one_of(batch.queue.observations, index)
            found = filmed.read_bytes() if filmed.exists() else self._painter.png(observation)
            if found is not None:
                self._kept[place] = found
                while len(self._kept) > KEPT:
                    self._kept.popitem(last=False)
            return found


def _parts(spec: Spec, value: Any) -> list[tuple[Spec, np.ndarray]]:
    if spec.kind != "dict":
        return [(spec, np.asarray(value))]
    return [(part, np.asarray(value[name])) for name, part in spec.parts if name != MASK]


def _is_board(spec: Spec) -> bool:
    return spec.kind == "box" and len(spec.shape) in (2, 3) and min(spec.shape[:2]) > 1


def _board(spec: Spec, value: np.ndarray) -> bytes:
    """A matrix, or a stack of them, as a picture.

    Two are the stones of two players, three channels are colours, and of others the last one is the latest.
    """
    if value.ndim == 3 and 2 in (value.shape[0], value.shape[2]):
        return _stones(value if value.shape[0] == 2 else np.moveaxis(value, 2, 0))
    low, high = spec.bounds()
    low, high = (low, high) if spec.is_bounded else (np.minimum(value.min(), 0), np.maximum(value.max(), 1))
    grey = (255 * (value - low.astype(np.float64)) / np.maximum(high - low.astype(np.float64), 1e-9)).astype(np.uint8)
    if grey.ndim == 3 and grey.shape[2] == 3:
        picture = grey
    else:
        picture = np.repeat((grey[..., -1] if grey.ndim == 3 else grey)[..., None], 3, -1)
    scale = max(1, SMALLEST // picture.shape[1])
    return png(np.ascontiguousarray(picture.repeat(scale, 0).repeat(scale, 1)))


def _stones(planes: np.ndarray) -> bytes:
    """A board from above: `planes` `[2, rows, columns]`, where the own stones lie (blue) and where the other's (red)."""
    scale = max(9, SMALLEST // planes.shape[2])
    across = (np.arange(scale) - (scale - 1) / 2) / (scale / 2)
    disc = np.tile(across[:, None] ** 2 + across**2 < 0.64, planes.shape[1:])
    picture = np.full((*disc.shape, 3), 238, np.uint8)
    picture[::scale] = picture[:, ::scale] = picture[-1] = picture[:, -1] = 160
    for plane, colour in zip(planes, ((11, 98, 196), (214, 69, 48)), strict=True):
        picture[disc & (plane > 0).repeat(scale, 0).repeat(scale, 1)] = colour
    return png(picture)


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
            if part.size > MOST_NUMBERS or _is_board(part):
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
