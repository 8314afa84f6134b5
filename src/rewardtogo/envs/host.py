"""The far side of the door to Gymnasium: one meaning of automatic reset and of failure for every vector environment.

NumPy only: JAX inside a callback can deadlock (jax-ml/jax #24255), and callbacks may run on any thread.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import gymnasium.vector as vector
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from ..core import MASK
from .envpool import EnvPool
from .translate import Parts, Translation

TICKETS = 2**30
"""Tickets count up to here and begin again; they travel as int32."""


class EnvironmentFailure(RuntimeError):
    """An environment raised an exception or gave something unusable: one sentence says which one, what, and when."""


def seeds_of(words: np.ndarray) -> list[int]:
    """A seed for each key's data `[B, words]`, mixed into 31 bits: what every environment takes."""
    return [int(np.random.SeedSequence(row.tolist()).generate_state(1)[0] >> 1) for row in words]


class Host:
    """A vector environment of Gymnasium, its present ticket, and its failure, if it had one. Compared by identity.

    - `mask`: the number of discrete actions, where `info` says which of them are allowed; otherwise 0.
    - `extras`: names of numbers in `info` that are handed on.
    - `time_limit`: steps after which an episode is cut, where that is known.
    """

    def __init__(
        self,
        name: str,
        envs: vector.VectorEnv,
        mask: int = 0,
        extras: tuple[str, ...] = (),
        time_limit: int | None = None,
    ) -> None:
        self.name, self.envs, self.mask, self.extras, self.time_limit = name, envs, mask, extras, time_limit
        self.size = envs.num_envs
        self.same_step = envs.metadata["autoreset_mode"] == vector.AutoresetMode.SAME_STEP
        # Gymnasium prints a worker's traceback once for each copy; what it raises afterwards says the same.
        self.quiet = isinstance(envs.unwrapped, vector.AsyncVectorEnv)
        self.action = Translation(envs.single_action_space)
        self.observation = Translation(envs.single_observation_space)
        self.steps = 0
        self.ticket = 0
        self.error: EnvironmentFailure | None = None

    def reset(self, words: Any) -> tuple[np.ndarray, Any]:
        """Seed and start all episodes. An earlier failure is forgotten."""
        self.error, self.steps = None, 0
        seeds = seeds_of(np.asarray(words))
        observation = self._guard("reset", lambda: self._reset(seeds))
        self.ticket = (self.ticket + 1) % TICKETS
        return np.asarray(self.ticket, np.int32), observation

    def step(self, words: Any) -> tuple:
        """One vector step: observation, reward, terminated, truncated, final observation, extras.

        `words` are the ticket and the actions in one array, since each argument of a callback costs a copy of 0.03 ms.
        """
        if self.error is not None:
            raise self.error
        result = self._guard("step", lambda: self._step(np.asarray(words)))
        self.steps += 1
        self.ticket = (self.ticket + 1) % TICKETS
        return result

    def _guard(self, when: str, call: Callable[[], Any]) -> Any:
        level = gymnasium.logger.min_level
        if self.quiet:
            gymnasium.logger.min_level = gymnasium.logger.ERROR + 1
        try:
            return call()
        except EnvironmentFailure as failure:
            self.error = failure
            raise
        except Exception as cause:
            self.error = self._failure(f"raised {type(cause).__name__}", when, f": {cause}")
            raise self.error from cause
        finally:
            gymnasium.logger.min_level = level

    def _failure(self, what: str, when: str, more: str = "") -> EnvironmentFailure:
        return EnvironmentFailure(f"the environment {self.name} {what} in {when} after {self.steps} vector steps{more}")

    def _reset(self, seeds: list[int]) -> Any:
        # A vector environment that is not made of single ones takes one seed (`gymnasium.vector.VectorEnv.reset`).
        single = isinstance(self.envs.unwrapped, (vector.SyncVectorEnv, vector.AsyncVectorEnv, EnvPool))
        batch, info = self.envs.reset(seed=seeds if single else seeds[0])  # type: ignore[arg-type]
        return self._outcome(self._observe(batch, info, np.ones(self.size, bool), "reset"))

    def _step(self, words: np.ndarray) -> tuple:
        if words[0] != self.ticket:
            raise self._failure(
                "was asked to go on from a state that is not its present one",
                "step",
                ": its state lives outside the compiled program and can be neither restored nor rewound, so "
                "reset it first, and give each program an environment of its own",
            )
        batch, reward, terminated, truncated, info = self.envs.step(
            self.action.outward(self.action.unpacked(words[1:], self.size))
        )
        terminated, truncated = np.asarray(terminated, bool), np.asarray(truncated, bool)
        finite = np.isfinite(reward)
        if not finite.all():
            at = int(np.argmin(finite))
            raise self._failure(f"gave the reward {np.asarray(reward)[at]} (copy {at})", "step")
        end = self._already_reset if self.same_step else self._then_reset
        observation, final, extras = end(batch, info, terminated | truncated)
        reward = np.asarray(reward, np.float32)
        return self._outcome(observation), reward, terminated, truncated, self._outcome(final), extras

    def _then_reset(self, batch: Any, info: dict, done: np.ndarray) -> tuple[Parts, Parts, Parts]:
        """Where ended episodes wait for a reset, or would get it in the next step: it happens now, for them alone."""
        final, extras = self._observe(batch, info, ~done, "step"), self._extras(info)
        if not done.any():
            return final, final, extras
        # Copied, since a vector environment may write the reset into the same buffer.
        final = {name: array.copy() for name, array in final.items()}
        batch, info = self.envs.reset(options={"reset_mask": done.copy()})
        fresh = self._observe(batch, info, done, "reset")
        observation = {name: array.copy() for name, array in final.items()}
        for name, array in observation.items():
            array[done] = fresh[name][done]
        return observation, final, extras

    def _already_reset(self, batch: Any, info: dict, done: np.ndarray) -> tuple[Parts, Parts, Parts]:
        """Where the next episode has begun in the same step and `info` holds how the last one ended."""
        observation, extras = self._observe(batch, info, np.ones(self.size, bool), "step"), self._extras(info)
        if not done.any():
            return observation, observation, extras
        space, last, rows = self.envs.single_observation_space, info.get("final_info", {}), np.flatnonzero(done)
        if "final_obs" not in info:
            raise self._failure("ended an episode without final_obs in info", "step")
        ends = info["final_obs"]
        if isinstance(ends, np.ndarray) and ends.dtype == object:  # one element for each environment that ended
            items = [ends[row] for row in rows]
            ends = concatenate(space, items, create_empty_array(space, len(rows)))  # type: ignore[arg-type]
            ended = self.observation.inward(ends, (len(rows),))
        else:
            ended = {name: array[rows] for name, array in self.observation.inward(ends, (self.size,)).items()}
        self._check(ended, "step")
        if self.mask:
            ended = self._with_mask(ended, self._mask(last, np.zeros_like(done), "step")[rows])
        final = {name: array.copy() for name, array in observation.items()}
        for name, array in final.items():
            array[rows] = ended[name]
        extras = {name: np.where(done, value, extras[name]) for name, value in self._extras(last).items()}
        return observation, final, extras

    def _observe(self, batch: Any, info: dict, masked: np.ndarray, when: str) -> Parts:
        """Checked and translated; the rows `masked` must have an action mask, if there are masks at all."""
        parts = self.observation.inward(batch, (self.size,))
        self._check(parts, when)
        return self._with_mask(parts, self._mask(info, masked, when)) if self.mask else parts

    def _check(self, parts: Parts, when: str) -> None:
        name = self.observation.not_finite(parts)
        if name is not None:
            raise self._failure(
                f"gave an observation{f' part {name!r}' if name else ''} with NaN or infinity in it", when
            )

    def _mask(self, info: dict, needed: np.ndarray, when: str) -> np.ndarray:
        """Allowed actions `[B, n]`; an ended episode needs none, and without a mask everything is allowed there."""
        mask = np.ones((self.size, self.mask), np.int8)
        given = np.asarray(info.get(f"_{MASK}", np.full(self.size, MASK in info)))
        for row in np.flatnonzero(given):
            mask[row] = info[MASK][row]
        wrong = needed & ~(given & mask.any(1))
        if wrong.any():
            raise self._failure(f"gave no action mask that allows an action (copy {int(np.argmax(wrong))})", when)
        return mask

    def _with_mask(self, parts: Parts, mask: np.ndarray) -> Parts:
        return {**(parts if self.observation.nested else {"observation": parts[""]}), MASK: mask}

    def _outcome(self, parts: Parts) -> Any:
        return parts if self.mask or self.observation.nested else parts[""]

    def _extras(self, info: dict) -> Parts:
        """The declared numbers of `info`, 0 where one is missing."""
        columns = {}
        for name in self.extras:
            value = np.asarray(info.get(name, np.zeros(self.size)), np.float32)
            columns[name] = np.where(info.get(f"_{name}", np.ones(self.size, bool)), value, np.float32(0.0))
        return columns
