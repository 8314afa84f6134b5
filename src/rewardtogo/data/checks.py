"""Whether recorded steps can be what they claim: whole episodes of finite numbers in the spaces of an environment."""

from typing import Any

import jax
import numpy as np

from ..core import MASK, EnvSpec, Spec, Transition
from .trajectories import episode_bounds


def checked(transitions: Transition, spec: EnvSpec) -> dict[str, Any]:
    """The fields of a row of transitions `[N]` as NumPy arrays of the types of `spec`.

    Raises `ValueError`, naming the step and its episode, for: no steps, arrays of another shape or type than the
    spaces, NaN, a last episode without an end, actions outside their space or forbidden by a mask, steps that do not
    follow each other.
    """
    size = len(transitions.reward)
    if size == 0:
        raise ValueError("the dataset has no episodes: record at least one whole episode")
    fields = {
        "observation": _columns(spec.observation, transitions.observation, size, "the observation"),
        "action": _columns(spec.action, transitions.action, size, "the action"),
        "reward": _column(Spec("box"), transitions.reward, size, "the reward"),
        "terminated": _flags(transitions.terminated, size, "terminated"),
        "truncated": _flags(transitions.truncated, size, "truncated"),
        "next_observation": _columns(spec.observation, transitions.next_observation, size, "the next observation"),
        "extras": {name: np.asarray(value) for name, value in transitions.extras.items()},
    }
    done = fields["terminated"] | fields["truncated"]
    where = lambda wrong: _where(wrong, done)  # noqa: E731
    for name in ("observation", "action", "reward", "next_observation", "extras"):
        _finite(fields[name], name.replace("_", " "), where)
    if not done[-1]:
        raise ValueError(
            "the last episode has no end (its last step is neither terminated nor truncated): "
            "record whole episodes, and mark where one was cut as truncated"
        )
    _within(spec.action, fields["action"], where)
    _allowed(fields["observation"], fields["action"], where)
    _consecutive(fields["observation"], fields["next_observation"], done, where)
    return fields


def require_spec(have: EnvSpec, wanted: EnvSpec, owner: str = "the dataset") -> None:
    """Raise `ValueError` unless data (or a policy) of the spaces `have` fits an environment of the spaces `wanted`.

    Bounds of observations do not matter: versions of one environment state them differently.
    """
    for what, mine, theirs in (
        ("observation", have.observation, wanted.observation),
        ("action", have.action, wanted.action),
    ):
        if _shape(mine) != _shape(theirs) or (what == "action" and (mine.low, mine.high) != (theirs.low, theirs.high)):
            raise ValueError(
                f"{owner}'s {what} space is {mine.to_space()} and the environment's is {theirs.to_space()}: "
                "it is of another environment"
            )


def _shape(spec: Spec) -> tuple:
    return (spec.kind, spec.shape, spec.dtype, spec.counts, tuple((name, _shape(part)) for name, part in spec.parts))


def _columns(spec: Spec, value: Any, size: int, what: str) -> Any:
    if spec.kind != "dict":
        return _column(spec, value, size, what)
    names = [name for name, _ in spec.parts]
    if not isinstance(value, dict) or sorted(value) != names:
        raise ValueError(f"{what} must have the parts {', '.join(names)}: the data is of another environment")
    return {name: _column(part, value[name], size, f"{what}'s part {name!r}") for name, part in spec.parts}


def _column(spec: Spec, value: Any, size: int, what: str) -> np.ndarray:
    array = np.asarray(value)
    if array.shape != (size, *spec.shape):
        raise ValueError(
            f"{what} has shape {array.shape} for {size} steps, and the space wants {(size, *spec.shape)}: "
            "the data is of another environment, or a step is missing"
        )
    if array.dtype.kind not in ("biuf" if np.dtype(spec.dtype).kind == "f" else "biu"):
        raise ValueError(
            f"{what} has the type {array.dtype}, and the space wants {spec.dtype}: it is of another environment"
        )
    return np.ascontiguousarray(array, spec.dtype)


def _flags(value: Any, size: int, what: str) -> np.ndarray:
    array = np.asarray(value)
    if array.shape != (size,) or array.dtype != bool:
        raise ValueError(f"{what} must be one truth value a step, {size} in all, not {array.dtype}{list(array.shape)}")
    return array


def _where(wrong: np.ndarray, done: np.ndarray) -> str:
    step = int(np.argmax(wrong))
    bounds = episode_bounds(done)
    episode = int(np.searchsorted(bounds, step, side="right")) - 1
    return f"step {step - int(bounds[episode])} of episode {episode}"


def _finite(tree: Any, what: str, where: Any) -> None:
    for leaf in jax.tree.leaves(tree):
        if leaf.dtype.kind == "f":
            wrong = ~np.isfinite(leaf).all(axis=tuple(range(1, leaf.ndim)))
            if wrong.any():
                raise ValueError(f"the {what} of {where(wrong)} is NaN or infinite: leave that episode out")


def _within(spec: Spec, action: np.ndarray, where: Any) -> None:
    if spec.kind == "box":
        low, high = spec.bounds()
    elif spec.kind in ("discrete", "multi_discrete"):
        low, high = np.zeros(spec.shape, int), np.asarray(spec.counts).reshape(spec.shape) - 1
    elif spec.kind == "multi_binary":
        low, high = np.zeros(spec.shape, int), np.ones(spec.shape, int)
    else:
        raise ValueError(
            "actions that are dictionaries cannot be recorded: use an environment with a plain action space"
        )
    wrong = ((action < low) | (action > high)).any(axis=tuple(range(1, action.ndim)))
    if wrong.any():
        raise ValueError(
            f"the action of {where(wrong)} is {action[np.argmax(wrong)]}, which is outside the action space "
            f"{spec.to_space()}: discrete actions count from 0, and others are recorded as the environment got them"
        )


def _allowed(observation: Any, action: np.ndarray, where: Any) -> None:
    if isinstance(observation, dict) and MASK in observation:
        wrong = observation[MASK][np.arange(len(action)), action] == 0
        if wrong.any():
            raise ValueError(
                f"the action of {where(wrong)} is {action[np.argmax(wrong)]}, which its {MASK} forbids: "
                "leave that episode out"
            )


def _consecutive(observation: Any, following: Any, done: np.ndarray, where: Any) -> None:
    for now, after in zip(jax.tree.leaves(observation), jax.tree.leaves(following), strict=True):
        wrong = np.append((now[1:] != after[:-1]).any(axis=tuple(range(1, now.ndim))) & ~done[:-1], False)
        if wrong.any():
            raise ValueError(
                f"the next observation of {where(wrong)} is not the observation of the step after it: "
                "steps must be stored in order, and the last observation of an episode before any reset"
            )
