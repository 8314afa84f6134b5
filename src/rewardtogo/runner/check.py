"""`rtg check-env`: an environment by name, whatever kind of name it is, to `envs.check`."""

import inspect
from typing import Any

import gymnasium

from ..catalogue import ENVIRONMENTS, nearest
from ..core import Environment, VectorEnv
from ..envs.check import Problem, check_env
from ..envs.registry import COMPILED
from .config import resolve


def check_by_name(name: str) -> list[Problem]:
    """Everything found wrong with an environment, errors first.

    `name` is one of ours, a Gymnasium id (`module:Id` included), or `module:Class` of a `gymnasium.Env` or of an `Environment`
    (a function that makes one will do). Raises `ValueError` where there is no such thing.
    """
    if name in COMPILED:
        return check_env(COMPILED[name]())
    if ":" not in name:
        if name not in gymnasium.registry:
            raise ValueError(
                f"there is no environment {name!r}: {nearest(name, [*gymnasium.registry, *ENVIRONMENTS], 'rtg list --envs')}"
            )
        return check_env(name)
    try:
        found = resolve(name)
    except ValueError:
        # Not in the module, so perhaps an id that the module registers when it is imported.
        if name.partition(":")[2] in gymnasium.registry:
            return check_env(name)
        raise
    return check_env(_environment(name, found))


def _environment(name: str, found: Any) -> Any:
    """What a name in a module stands for: an environment, or what makes one of Gymnasium's."""
    if inspect.isclass(found) and not issubclass(found, (gymnasium.Env, Environment)):
        raise ValueError(f"{name} is neither a gymnasium.Env nor a rewardtogo.Environment")
    if inspect.isclass(found) and issubclass(found, gymnasium.Env):
        return found
    if callable(found):
        try:
            made = found()
        except TypeError as error:
            raise ValueError(
                f"{name} cannot be made without arguments ({error}): name a function that makes it"
            ) from error
        return (lambda: made) if isinstance(made, gymnasium.Env) else _single(name, made)
    return _single(name, found)


def _single(name: str, found: Any) -> Any:
    if isinstance(found, VectorEnv) or not isinstance(found, (Environment, gymnasium.Env)):
        raise ValueError(f"{name} is a {type(found).__name__}: name a gymnasium.Env or a rewardtogo.Environment")
    return found
