"""What is wrong with an environment, and the mend: `rtg check-env` before an hour of training that could not have
worked.

`check_env` takes random actions in an environment of Gymnasium or a compiled one and reports what it saw, one sentence
a problem. An *error* will stop training or spoil what is learned; a *warning* makes it harder, slower or not
repeatable.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import gymnasium.spaces as spaces
import numpy as np
from gymnasium.envs.registration import EnvSpec

from ..core import MASK, Environment, from_space
from .check_compiled import check_compiled
from .findings import Problem as Problem
from .findings import Report, Stop, Watch, check_spaces
from .translate import Parts, Translation


class _Gymnasium:
    """The walk through an environment of Gymnasium."""

    def __init__(self, report: Report, env: gymnasium.Env) -> None:
        self.report, self.env = report, env
        self.translation = Translation(env.observation_space)
        self.watch = Watch(self.translation)
        self.discrete = env.action_space if isinstance(env.action_space, spaces.Discrete) else None
        self.masked = False

    def check(self, steps: int) -> None:
        """Walk, then compare walks that should be the same."""
        try:
            self._walk(steps)
            self._repeat()
        except Stop:
            pass
        limited = self.env.spec is not None and self.env.spec.max_episode_steps is not None
        self.watch.report(self.report, limited, len(self.watch.rewards))

    def _walk(self, steps: int) -> None:
        self.env.action_space.seed(0)
        info, over, corners = self._reset(0)[1], False, self._corners()
        self.masked = MASK in info and self.discrete is not None
        for step in range(steps):
            if over:
                info = self._reset(None)[1]
            mask = self._mask(info, over=False)
            action = corners.pop() if corners and mask is None else self._sample(mask)
            _, reward, over, info = self._step(action, step)
            self.watch.rewards.append(reward)
            self.watch.ended += over
            self._mask(info, over)

    def _corners(self) -> list[Any]:
        """Actions at both ends of the space, which random ones do not meet."""
        space = self.env.action_space
        if self.discrete is not None:
            return [np.int64(self.discrete.start), np.int64(self.discrete.start + self.discrete.n - 1)]
        if isinstance(space, spaces.Box) and from_space(space).is_bounded:
            return [space.low.copy(), space.high.copy()]
        return []

    def _sample(self, mask: np.ndarray | None) -> Any:
        return self.env.action_space.sample() if mask is None else self.env.action_space.sample(mask=mask)

    def _mask(self, info: dict, over: bool) -> np.ndarray | None:
        if not self.masked or self.discrete is None or (over and MASK not in info):
            return None
        shape = np.shape(info.get(MASK, ()))
        if MASK not in info or shape != (self.discrete.n,):
            what = f"has shape {shape}" if MASK in info else "was missing after a step"
            self.report.error(
                "mask",
                f"info['{MASK}'] {what}: give one entry for each of the {self.discrete.n} actions, in the info "
                "of reset and of every step",
            )
            raise Stop
        mask = np.asarray(info[MASK]).astype(np.int8)
        if not over and not mask.any():
            self.report.error(
                "mask", f"info['{MASK}'] forbade every action: end the episode there, or allow one that does nothing"
            )
            raise Stop
        return mask

    def _call(self, what: str, call: Callable[[], Any], count: int, order: str) -> Any:
        try:
            result = call()
        except Exception as cause:
            self.report.error(what, f"{what} raised {type(cause).__name__}: {cause}")
            raise Stop from cause
        if not isinstance(result, tuple) or len(result) != count:
            given = f"{len(result)} values" if isinstance(result, tuple) else f"a {type(result).__name__}"
            self.report.error(what, f"{what} gave {given}: return the {count} of Gymnasium, {order}")
            raise Stop
        if not isinstance(result[-1], dict):
            self.report.error(
                what, f"{what} gave an info of type {type(result[-1]).__name__}: return a dictionary, {{}} if empty"
            )
            raise Stop
        return result

    def _reset(self, seed: int | None) -> tuple[Parts, dict]:
        observation, info = self._call("reset(seed=...)", lambda: self.env.reset(seed=seed), 2, "observation, info")
        return self._look(observation), info

    def _step(self, action: Any, number: int) -> tuple[Parts, float, bool, dict]:
        before = action.copy() if isinstance(action, np.ndarray) else action
        order = "observation, reward, terminated, truncated, info"
        name = f"step (number {number + 1}, action {before!r})"
        observation, reward, terminated, truncated, info = self._call(name, lambda: self.env.step(action), 5, order)
        if isinstance(action, np.ndarray) and not np.array_equal(before, action):
            self.report.error(
                "writes",
                "step writes into the action it is given, so that what is stored for learning changes too: "
                "begin with action = np.array(action)",
            )
        for flag, name in ((terminated, "terminated"), (truncated, "truncated")):
            if not isinstance(flag, (bool, np.bool_)):
                self.report.error("flags", f"step gave {name} as {type(flag).__name__} {flag!r}: return bool({name})")
        if np.ndim(reward) != 0 or not isinstance(reward, (int, float, np.number, np.bool_, np.ndarray)):
            self.report.error(
                "reward type", f"step gave the reward {reward!r} of type {type(reward).__name__}: return float(reward)"
            )
            raise Stop
        return self._look(observation), float(reward), bool(terminated) or bool(truncated), info

    def _look(self, observation: Any) -> Parts:
        try:
            parts = self.translation.inward(observation)
        except (ValueError, TypeError, KeyError, IndexError) as cause:
            self.report.error(
                "observation",
                f"what is observed does not fit {self.env.observation_space}, {type(cause).__name__}: {cause}: "
                "change the one or the other",
            )
            raise Stop from cause
        self.watch.observe(parts)
        space = self.env.observation_space
        if isinstance(space, spaces.Box) and isinstance(observation, np.ndarray) and observation.dtype != space.dtype:
            self.report.warning(
                "dtype",
                f"the observation is {observation.dtype} and its space says {space.dtype}: return "
                f"observation.astype(np.{space.dtype})",
            )
        elif isinstance(space, spaces.Box) and not isinstance(observation, np.ndarray):
            self.report.warning(
                "dtype", f"the observation is a {type(observation).__name__}: return a NumPy array of {space.dtype}"
            )
        return parts

    def _play(self, native: bool) -> tuple[list[Parts], list[float]]:
        """Up to 20 steps from the same seed with the same actions, as NumPy's or as Python's numbers."""
        self.env.action_space.seed(1)
        first, info = self._reset(7)
        seen, rewards = [first], []
        for number in range(20):
            action = self._sample(self._mask(info, over=False))
            observation, reward, over, info = self._step(int(action) if native else action, number)
            seen.append(observation)
            rewards.append(reward)
            if over:
                break
        return seen, rewards

    def _repeat(self) -> None:
        one, two = self._play(native=False), self._play(native=False)
        if not _same(one[0][:1], two[0][:1]):
            self.report.error(
                "seed",
                "reset(seed=7) gave two different observations: begin it with super().reset(seed=seed) and draw "
                "all randomness from self.np_random",
            )
        elif not _same(one[0], two[0]) or one[1] != two[1]:
            self.report.warning(
                "seed",
                "the same seed and actions led to different observations or rewards, so that runs cannot be "
                "repeated: draw all randomness from self.np_random",
            )
        elif self.discrete is not None:
            three = self._play(native=True)
            if not _same(one[0], three[0]) or one[1] != three[1]:
                self.report.error(
                    "action type",
                    "step takes the action np.int64(1) for another than 1: begin with action = int(action)",
                )


def _same(one: list[Parts], two: list[Parts]) -> bool:
    return len(one) == len(two) and all(
        np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f")
        for a, b in zip(one, two, strict=True)
        for name in a
    )


def check_env(env: Any, *, steps: int = 1000, kwargs: dict[str, Any] | None = None) -> list[Problem]:
    """Everything found wrong with an environment in `steps` random steps, errors first.

    `env` is a Gymnasium id (`module:Id` included), a function that makes one, one that exists, or a compiled
    `Environment`; `kwargs` go to what makes it. Raises `ValueError` where `env` is none of these.
    """
    if steps < 1:
        raise ValueError(f"an environment is checked by taking at least 1 step, not {steps}")
    report = Report()
    if isinstance(env, Environment):
        check_compiled(report, env, steps)
        return report.problems()
    if not isinstance(env, (str, EnvSpec, gymnasium.Env)) and not callable(env):
        raise ValueError(
            f"{env!r} is no environment: give a Gymnasium id, a function that makes a gymnasium.Env, one that exists, "
            "or a compiled Environment"
        )
    made = _make(report, env, kwargs or {})
    if made is not None:
        try:
            if check_spaces(report, made.observation_space, made.action_space):
                _Gymnasium(report, made).check(steps)
        except AttributeError as cause:
            if report.found or "_space" not in str(cause):
                raise
            report.error(
                "space", f"a space is missing, {cause}: set observation_space and action_space in its __init__"
            )
        finally:
            if made is not env:
                made.close()
    return report.problems()


def _make(report: Report, env: Any, kwargs: dict[str, Any]) -> gymnasium.Env | None:
    try:
        if isinstance(env, gymnasium.Env):
            return env
        made = (
            gymnasium.make(env, disable_env_checker=True, **kwargs)
            if isinstance(env, (str, EnvSpec))
            else env(**kwargs)
        )
    except Exception as cause:
        report.error("make", f"it cannot be made, {type(cause).__name__}: {cause}")
        return None
    if isinstance(made, gymnasium.Env):
        return made
    report.error("make", f"what makes it gave a {type(made).__name__}: give a gymnasium.Env (wrap older environments)")
    return None
