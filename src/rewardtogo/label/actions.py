"""What a person does: the names of actions, and whether what came from a page is an action at all."""

from typing import Any

import gymnasium
import numpy as np

from ..core import MASK, Spec
from ..envs.atari import PREFIX

_CELLS = tuple(f"{row} {column}" for row in ("top", "mid", "low") for column in ("left", "centre", "right"))
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
    "Steering": ("left", "straight", "right"),
    "Lane": ("steering",),
    "BrakeLight": ("drive", "brake"),
    "LastTwo": ("0", "1"),
    "Drone": ("heading",),
    "Tightrope": ("step", "climb"),
    "PixelPendulum": ("torque",),
    "PixelPendulumOneFrame": ("torque",),
    "CartPoleSwingUp": ("force",),
    "Reacher": ("torque 1", "torque 2"),
    "TicTacToe": _CELLS,
    "TicTacToePerfect": _CELLS,
    "ConnectFour": tuple(f"column {i}" for i in range(1, 8)),
    "ConnectFour5x5": tuple(f"column {i}" for i in range(1, 6)),
    "LunarLander-v3": ("none", "left engine", "main engine", "right engine"),
}
"""What the choices of an action are called, or in a box its entries."""
_WORDS = ("up", "down", "left", "right", "fire")


def allowed(spec: Spec, observation: Any) -> np.ndarray | None:
    """Which actions of this space are allowed at one observation, where that says so."""
    masked = isinstance(observation, dict) and MASK in observation and spec.kind == "discrete"
    return np.asarray(observation[MASK]) > 0 if masked else None


def element(spec: Spec, value: Any, allowed: np.ndarray | None = None, where: str = "here") -> np.ndarray:
    """What a page, or anybody, gives as an action, as an array of the action space.

    Raises `ValueError` where it is not in the space, or forbidden.
    """
    try:
        given = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"an action here is {_wanted(spec)}, not {value!r}") from None
    if given.shape != spec.shape or not np.all(np.isfinite(given)):
        raise ValueError(f"an action here is {_wanted(spec)}, not {value!r}")
    if spec.kind == "box":
        low, high = spec.bounds()
        # A slider's last step may lie a rounding error beyond the end.
        slack = 1e-6 * np.maximum(1.0, np.abs(given))
        inside = bool(np.all((given >= low - slack) & (given <= high + slack)))
        found = np.clip(given.astype(spec.dtype), low, high)
    else:
        counts = np.asarray(spec.counts or (2,)).reshape(spec.shape if spec.counts else ())
        inside = bool(np.all((given == np.round(given)) & (given >= 0) & (given < counts)))
        found = given.astype(spec.dtype) if inside else given
    if not inside:
        raise ValueError(f"an action here is {_wanted(spec)}, not {value!r}")
    if allowed is not None and not allowed[int(found)]:
        raise ValueError(f"action {int(found)} is forbidden {where}: allowed are {np.flatnonzero(allowed).tolist()}")
    return found


def _wanted(spec: Spec) -> str:
    if spec.kind == "discrete":
        return f"a whole number from 0 to {spec.counts[0] - 1}"
    where = " within the bounds of its box" if spec.kind == "box" else ", each a choice that there is"
    return f"{spec.size} numbers of shape {spec.shape}{where}"


def names_of(described: dict[str, Any], spec: Spec, given: tuple[str, ...] = ()) -> tuple[str, ...]:
    """What the actions are called: as is given, or as is known; empty where nobody knows.

    - `described`: the environment as `config.json` has it; `spec`: of its actions.

    Raises `ValueError` where there are more or fewer names than actions, or entries of an action.
    """
    names = given or ACTIONS.get(described["id"], ()) or _of_a_game(described)
    wanted = spec.counts[0] if spec.kind == "discrete" else spec.size
    if given and len(given) != wanted:
        raise ValueError(
            f"there are {wanted} {'actions' if spec.kind == 'discrete' else 'entries of an action'} here, and "
            f"{len(given)} names were given: {', '.join(given)}"
        )
    return names if len(names) == wanted else ()


def _of_a_game(described: dict[str, Any]) -> tuple[str, ...]:
    """What an Atari game calls its actions: `none`, `up`, `up right`, `up right fire` ..."""
    if not described["id"].startswith(PREFIX) or not described["by_name"]:
        return ()
    full = bool(described["kwargs"].get("full_action_space", False))
    try:
        game: Any = gymnasium.make(described["id"], full_action_space=full)
        meanings = game.unwrapped.get_action_meanings()
        game.close()
    except Exception:  # names are a help and no more
        return ()
    return tuple(" ".join(w for w in _WORDS if w.upper() in meaning) or "none" for meaning in meanings)


def described(spec: Spec, names: tuple[str, ...]) -> dict[str, Any]:
    """The space of actions as the pages get it: kind, shape, counts, bounds (None where there is none), names."""
    low, high = spec.bounds() if spec.kind == "box" else (np.zeros(spec.shape), np.zeros(spec.shape))
    number = lambda x: float(x) if np.isfinite(x) else None  # noqa: E731
    return {
        "kind": spec.kind,
        "shape": list(spec.shape),
        "counts": list(spec.counts or (2,) * spec.size),
        "low": [number(x) for x in np.ravel(low)],
        "high": [number(x) for x in np.ravel(high)],
        "names": list(names),
    }
