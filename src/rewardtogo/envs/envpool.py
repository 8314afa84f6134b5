"""EnvPool's environments, stepped by threads of C++ (Weng et al. 2022), as a vector environment that the door takes.

EnvPool differs from `gymnasium.vector` in four ways, and all four end here:

- Seeds are given when a pool is made, so a reset with seeds makes a new pool.
- A copy whose episode has ended begins the next one in the following step. Here every reset is asked for (`reset_mask`,
  `AutoresetMode.DISABLED`), so the step's own observation is the last of its episode. A copy that ended by itself is
  asked through a step of its own, whose action EnvPool ignores, rather than by force: with `episodic_life`, an Atari
  game then goes on with its next life.
- An episode that ends in the step that reaches the time limit counts as truncated, whatever ended it. Where the limit is
  nothing but a count of steps (`COUNTED`), the count is therefore kept here, EnvPool's own limit lies one step further,
  and a pole that falls in the last step has both fallen and been truncated (erratum E1.5).
- Pictures have their channels first; here they have them last, as everywhere in the library.

NumPy only, like everything behind the door.
"""

import importlib
import importlib.metadata
import warnings
from typing import Any

import gymnasium.spaces as spaces
import gymnasium.vector as vector
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector.utils import batch_space

from ..catalogue import nearest

COUNTED = ("envpool.classic_control", "envpool.toy_text", "envpool.box2d", "envpool.mujoco.gym")
"""Families in which the time limit does nothing but end the episode. In others it may be a part of the task."""
OURS = ("task_id", "env_type", "num_envs", "batch_size", "max_num_players", "seed", "env_seed", "gym_reset_return_info")
"""Arguments of `envpool.make` that are given here."""
UNLIMITED = 2**31 - 1
"""What `max_episode_steps` is where there is no time limit."""


def _package() -> Any:
    try:
        return importlib.import_module("envpool")
    except ImportError as error:
        raise ValueError(
            f"the backend envpool needs the package envpool, which cannot be imported here ({_line(error)}): "
            "pip install 'rewardtogo[envpool]', or use --backend gymnasium"
        ) from error


def _line(error: Exception) -> str:
    """What an exception says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _channels_first(space: spaces.Space) -> bool:
    return (
        isinstance(space, spaces.Box)
        and space.dtype == np.uint8
        and len(space.shape) == 3
        and space.shape[0] < min(space.shape[1:])
    )


def _turned_space(space: spaces.Space) -> spaces.Space:
    """The space with its pictures' channels last, and without bounds that are none."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({name: _turned_space(part) for name, part in space.spaces.items()})
    if isinstance(space, spaces.Box) and _channels_first(space):
        return spaces.Box(np.moveaxis(space.low, 0, -1), np.moveaxis(space.high, 0, -1), dtype=np.uint8)
    if isinstance(space, spaces.Box) and isinstance(space.dtype, np.dtype) and space.dtype.kind == "f":
        # C++'s numeric_limits::min() is the smallest positive number; some environments give it for a missing bound.
        limits = np.finfo(space.dtype)
        low = np.where(space.low == limits.tiny, -np.inf, space.low)
        return spaces.Box(low, np.where(space.high == limits.max, np.inf, space.high), dtype=space.dtype.type)
    return space


def _turned(space: spaces.Space, value: Any) -> Any:
    """A batch of `space`, EnvPool's own, with its pictures' channels last."""
    if isinstance(space, spaces.Dict):
        return {name: _turned(part, value[name]) for name, part in space.spaces.items()}
    return np.moveaxis(value, 1, -1) if _channels_first(space) else value


def _replaced(whole: Any, rows: np.ndarray, some: Any) -> Any:
    """A copy of a nested batch in which `rows` are those of the smaller batch `some`."""
    if isinstance(whole, dict):
        return {name: _replaced(part, rows, some[name]) for name, part in whole.items()}
    whole = whole.copy()
    whole[rows] = some
    return whole


class EnvPool(vector.VectorEnv):
    """B copies of one of EnvPool's environments, in synchronous mode, ended ones waiting for their reset.

    - `name`: one of `envpool.list_all_envs()`.
    - `num_envs`: B.
    - `kwargs`: passed on to `envpool.make`: options of the environment, `max_episode_steps`, `num_threads`.

    `step` and `reset` hand on the numbers of EnvPool's `info`, among them `elapsed_step`.

    Raises `ValueError` where EnvPool is not installed, does not have the environment, or cannot make it so.
    """

    metadata = {"autoreset_mode": vector.AutoresetMode.DISABLED}

    def __init__(self, name: str, num_envs: int = 1, kwargs: dict[str, Any] | None = None) -> None:
        package, kwargs = _package(), dict(kwargs or {})
        if num_envs < 1:
            raise ValueError(f"there must be at least one environment, not {num_envs}")
        ids = package.list_all_envs()
        if name not in ids:
            near = nearest(name, ids)
            # `rtg list` does not have EnvPool's names.
            near = near if near.startswith("did you") else "envpool.list_all_envs() gives the names it has"
            raise ValueError(f"EnvPool {importlib.metadata.version('envpool')} has no environment {name!r}: {near}")
        if taken := [argument for argument in OURS if argument in kwargs]:
            raise ValueError(
                f"{taken[0]} of {name} is not for you to give to EnvPool: the number of copies is num_envs, and their "
                "seeds come from the keys"
            )
        config, self._observed, acted = _specified(package, name, kwargs)
        if config["max_num_players"] != 1:
            raise ValueError(
                f"EnvPool's {name} is for several players at once, and algorithms here play for one: choose another"
            )
        limit = config["max_episode_steps"]
        counted = package.registration.registry.specs[name][0] in COUNTED and limit < UNLIMITED - 1
        self._limit = limit if counted else None
        self._made = {"task_id": name, **kwargs, **({"max_episode_steps": limit + 1} if counted else {})}
        self._make, self._pool = package.make, None
        self.spec = EnvSpec(
            name,
            reward_threshold=config.get("reward_threshold"),
            max_episode_steps=None if limit >= UNLIMITED else limit,
            kwargs=kwargs,
        )
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _turned_space(self._observed), acted
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(acted, num_envs)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """All copies, with a seed each if there are any; or the copies of `options["reset_mask"]` alone."""
        if self.closed:
            raise RuntimeError("it is closed")
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            return self._reset_some(np.asarray(mask, bool))
        if seed is not None or self._pool is None:
            self._pool = None  # its threads end before others begin
            first = 0 if seed is None else seed
            seeds = [(first + i) % 2**31 for i in range(self.num_envs)] if isinstance(first, int) else list(first)
            self._pool = self._make(env_type="gymnasium", num_envs=self.num_envs, seed=seeds, **self._made)
            _spaces_of(self._pool)
        observation, info = self._pool.reset()
        self._ended = np.zeros(self.num_envs, bool)
        self._last = _turned(self._observed, observation), info
        return self._last

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of all copies, none of which may have ended without having been reset."""
        if self._pool is None:
            raise RuntimeError("it is closed" if self.closed else "it has not been reset")
        observation, reward, terminated, truncated, info = self._pool.step(actions)
        self._ended, self._actions = terminated | truncated, actions
        if self._limit is not None:
            truncated = truncated | (info["elapsed_step"] >= self._limit)
        self._last = _turned(self._observed, observation), info
        return self._last[0], reward, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """End the pool's threads."""
        self._pool = None

    def _reset_some(self, mask: np.ndarray) -> tuple[Any, dict[str, Any]]:
        """The rows of `mask` begin new episodes; the others are as they were."""
        if self._pool is None:
            raise RuntimeError("it has not been reset")
        for rows, by_itself in ((mask & self._ended, True), (mask & ~self._ended, False)):
            if not rows.any():
                continue
            ids = np.flatnonzero(rows).astype(np.int32)
            result = self._pool.step(self._actions[ids], ids) if by_itself else self._pool.reset(ids)
            fresh = _turned(self._observed, result[0]), result[-1]
            self._last = _replaced(self._last[0], ids, fresh[0]), _replaced(self._last[1], ids, fresh[1])
        self._ended = self._ended & ~mask
        return self._last


def _spaces_of(made: Any) -> tuple[spaces.Space, spaces.Space]:
    """Of observations and actions, which EnvPool makes when they are first needed, with warnings of float64 bounds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return made.observation_space, made.action_space


def _specified(package: Any, name: str, kwargs: dict[str, Any]) -> tuple[dict[str, Any], spaces.Space, spaces.Space]:
    """Configuration, observation and action space, without making an environment."""
    try:
        spec = package.make_spec(name, **kwargs)
        return spec.config._asdict(), *_spaces_of(spec)
    except Exception as cause:  # EnvPool raises whatever a wrong argument leads to
        raise ValueError(f"the environment {name} cannot be made by EnvPool: {_line(cause)}") from cause
