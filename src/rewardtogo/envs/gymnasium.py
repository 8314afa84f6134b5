"""Any Gymnasium environment as a `VectorEnv`: one door, through which every algorithm of the library reaches it.

A compiled program calls back to the host with an *ordered* callback, so that loops, learners and the runner need no
second code path. What follows from it holds for every environment behind this door:

- Its state lives on the host. What a program carries is a ticket, the number of calls so far, and one that is not the
  latest is refused: the environment can be neither rewound nor restored from a checkpoint, only reset.
- Seeds of a run go one after another: `jax.vmap` over an ordered callback is an error.
- Randomness is the environment's own, seeded at `reset` from the keys; the keys of `step` are not used.
- Automatic reset has one meaning (`core.Timestep`), whatever Gymnasium's mode. Environments made here use
  `AutoresetMode.DISABLED`: the step's own observation is the final one, then the ended episodes alone are reset.
- What goes wrong inside (an exception, NaN, a wrong shape) is kept as an `EnvironmentFailure`, one sentence, for
  whoever ran the program and caught what JAX raised: `failure_of(algorithm)`.
"""

import logging
from collections.abc import Callable
from typing import Any

import equinox as eqx
import gymnasium
import gymnasium.spaces as spaces
import gymnasium.vector as vector
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.envs.registration import EnvSpec
from jax.experimental import io_callback
from jaxtyping import Array, Int, Key, PyTree

from ..core import MASK, Action, Observation, State, Timestep, VectorEnv, from_space
from .envpool import EnvPool
from .host import TICKETS, Host
from .host import EnvironmentFailure as EnvironmentFailure
from .single import single, title
from .translate import Translation

Maker = Callable[..., gymnasium.Env]
Source = str | EnvSpec | gymnasium.Env | Maker | vector.VectorEnv


class _OursAreReported(logging.Filter):
    """Drops JAX's log entry, with its long traceback, for a failure that the door keeps and its caller reports."""

    def filter(self, record: logging.LogRecord) -> bool:
        return not (record.exc_info and isinstance(record.exc_info[1], EnvironmentFailure))


logging.getLogger("jax._src.callback").addFilter(_OursAreReported())


def _own(
    env: Source, num_envs: int, kwargs: dict[str, Any], asynchronous: bool, keep: tuple[str, ...]
) -> vector.SyncVectorEnv | vector.AsyncVectorEnv:
    """`num_envs` copies, whose ended episodes wait for a reset."""
    if num_envs < 1:
        raise ValueError(f"there must be at least one environment, not {num_envs}")
    if isinstance(env, gymnasium.Env) and (num_envs > 1 or asynchronous or kwargs):
        raise ValueError(
            f"one environment that exists already ({title(env)}) cannot be copied, sent to a process or given "
            "arguments: give its id or a function that makes one"
        )
    if not isinstance(env, (str, EnvSpec, gymnasium.Env)) and not callable(env):
        raise ValueError(
            f"{env!r} is no environment: give an id, a function that makes a gymnasium.Env, or a gymnasium.Env"
        )
    makers = [single(env, kwargs, keep)] * num_envs
    disabled = vector.AutoresetMode.DISABLED
    try:
        if asynchronous:
            return vector.AsyncVectorEnv(makers, context="spawn", autoreset_mode=disabled, copy=False)
        return vector.SyncVectorEnv(makers, autoreset_mode=disabled, copy=False)
    except Exception as cause:
        given = env if isinstance(env, str) else env.id if isinstance(env, EnvSpec) else repr(env)
        raise ValueError(f"the environment {given} cannot be made: {cause}") from cause


def _foreign(env: vector.VectorEnv, num_envs: int | None, kwargs: dict[str, Any]) -> vector.VectorEnv:
    """A vector environment made elsewhere, if it can tell exactly where episodes end."""
    name = type(env.unwrapped).__name__
    if kwargs or num_envs not in (None, env.num_envs):
        raise ValueError(
            f"the vector environment {name} exists already, with {env.num_envs} copies: its number and arguments "
            "cannot be changed here"
        )
    mode = env.metadata.get("autoreset_mode")
    if mode not in list(vector.AutoresetMode):
        raise ValueError(
            f'the vector environment {name} does not say how it resets itself: set metadata["autoreset_mode"] to one '
            "of gymnasium.vector.AutoresetMode"
        )
    if mode == vector.AutoresetMode.NEXT_STEP and not _resets_some(env):
        raise ValueError(
            f"the vector environment {name} resets ended episodes one step late and cannot reset them alone "
            '(options={"reset_mask": ...}), so that one step in each episode would be a false one: give the id of the '
            "single environment, or a vector environment with AutoresetMode.DISABLED or SAME_STEP"
        )
    return env


def _resets_some(env: vector.VectorEnv) -> bool:
    """Whether `reset_mask` resets the environments of the mask and leaves the others where they are."""
    inner = env.unwrapped
    if isinstance(inner, vector.SyncVectorEnv):
        return True
    if isinstance(inner, vector.AsyncVectorEnv):
        return inner.shared_memory  # without it, Gymnasium's workers reset once more in the next step
    if env.num_envs == 1:
        return True
    # Of unknown make: walk on until the copies have left where they began, reset the first one, and see that the others
    # stay.
    look = Translation(env.single_observation_space)
    lead, first = (env.num_envs,), np.arange(env.num_envs) == 0
    try:
        began = look.inward(env.reset(seed=0)[0], lead)
        began = {name: array.copy() for name, array in began.items()}
        env.action_space.seed(0)
        for _ in range(2):
            env.step(env.action_space.sample())
        before = look.inward(env.step(env.action_space.sample())[0], lead)
        before = {name: array.copy() for name, array in before.items()}
        after = look.inward(env.reset(options={"reset_mask": first})[0], lead)
    except Exception:
        return False
    stayed = all(np.array_equal(before[name][1:], after[name][1:]) for name in before)
    return stayed and any(not np.array_equal(before[name][1:], began[name][1:]) for name in before)


def _mask_size(name: str, envs: vector.VectorEnv, wanted: bool | None) -> int:
    """The number of actions, where `info` has a mask for them; otherwise 0."""
    space = envs.single_action_space
    there = any(part == MASK for part, _ in from_space(envs.single_observation_space).parts)
    if wanted is False or (wanted is None and (there or not isinstance(space, spaces.Discrete))):
        return 0
    if there or not isinstance(space, spaces.Discrete):
        raise ValueError(
            f"a mask from info is for discrete actions and an observation without a part {MASK!r}, and {name} has the "
            f"actions {space} and the observation {envs.single_observation_space}: leave mask_from_info out"
        )
    try:
        _, info = envs.reset(seed=0)
    except Exception as cause:
        raise ValueError(f"the environment {name} raised {type(cause).__name__} in its first reset: {cause}") from cause
    if MASK not in info:
        if wanted:
            raise ValueError(
                f"the environment {name} has no {MASK!r} in the info of its reset: leave mask_from_info out"
            )
        return 0
    shape = np.shape(info[MASK][0])
    if shape != (space.n,):
        raise ValueError(
            f"the action mask of {name} has shape {shape}, and there are {space.n} actions: it must have one entry each"
        )
    return int(space.n)


class GymnasiumEnv(VectorEnv):
    """B copies of a Gymnasium environment.

    - `env`: an id (`module:Id` included), a function that makes one, one that exists (then B is 1), or a vector
      environment.
    - `num_envs`: B; a vector environment knows its own.
    - `kwargs`: passed on to whatever makes the environment.
    - `asynchronous`: each copy in a process of its own, which pays where a step takes milliseconds. Processes are
      spawned, so a script that does this needs `if __name__ == "__main__":`.
    - `mask_from_info`: whether `info["action_mask"]` becomes the observation's part `action_mask`; `None` looks at the
      first `reset`. An observation that is no dictionary becomes its part `observation`.
    - `extras`: numbers in `info` that `Timestep.extras` has, 0 where one is missing.

    Raises `ValueError` where the environment cannot be made, a space cannot be used, or a vector environment resets
    itself in a way that loses where an episode ended.
    """

    host: Host = eqx.field(static=True)

    def __init__(
        self,
        env: Source,
        num_envs: int | None = None,
        *,
        kwargs: dict[str, Any] | None = None,
        asynchronous: bool = False,
        mask_from_info: bool | None = None,
        extras: tuple[str, ...] = (),
    ) -> None:
        kwargs = kwargs or {}
        if isinstance(env, vector.VectorEnv):
            envs = _foreign(env, num_envs, kwargs)
            name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
            limit = None if env.spec is None else env.spec.max_episode_steps
        else:
            envs = own = _own(env, 1 if num_envs is None else num_envs, kwargs, asynchronous, (MASK, *extras))
            name, limit = own.call("title")[0], own.call("time_limit")[0]
        for space in (envs.single_observation_space, envs.single_action_space):
            from_space(space)
        mask = _mask_size(name, envs, mask_from_info)
        self.host = Host(name, envs, mask, tuple(extras), limit)

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.host.name

    @property
    def num_envs(self) -> int:
        return self.host.size

    @property
    def backend(self) -> str:
        """Whose environments these are: `"envpool"` for EnvPool's, `"gymnasium"` for all others."""
        return "envpool" if isinstance(self.host.envs.unwrapped, EnvPool) else "gymnasium"

    @property
    def time_limit(self) -> int | None:
        """Steps after which an episode is cut, where the environment's registration says so."""
        return self.host.time_limit

    @property
    def observation_space(self) -> spaces.Space:
        space = self.host.envs.single_observation_space
        if not self.host.mask:
            return space
        mask = spaces.MultiBinary(self.host.mask)
        if isinstance(space, spaces.Dict):
            return spaces.Dict({**space.spaces, MASK: mask})
        if isinstance(space, spaces.Tuple):
            return spaces.Dict({**{str(i): part for i, part in enumerate(space.spaces)}, MASK: mask})
        return spaces.Dict({"observation": space, MASK: mask})

    @property
    def action_space(self) -> spaces.Space:
        return self.host.envs.single_action_space

    def reset(self, keys: Key[Array, "B"]) -> tuple[State, Observation]:
        shapes = (jax.ShapeDtypeStruct((), jnp.int32), self._observation_shapes())
        return io_callback(self.host.reset, shapes, jax.random.key_data(keys), ordered=True)

    def step(self, state: Int[Array, ""], action: Action, keys: Key[Array, "B"]) -> tuple[State, Timestep]:
        del keys
        observation = self._observation_shapes()
        real, flag = (jax.ShapeDtypeStruct((self.num_envs,), dtype) for dtype in (jnp.float32, jnp.bool_))
        shapes = (observation, real, flag, flag, observation, dict.fromkeys(self.host.extras, real))
        values = io_callback(self.host.step, shapes, self._packed(state, action), ordered=True)
        return (state + 1) % TICKETS, Timestep(*values)

    def _packed(self, ticket: Int[Array, ""], action: Action) -> Int[Array, "words"]:
        """The ticket and all actions as 32-bit words: see `Host.step`."""
        words = [ticket[None]]
        for leaf in self.host.action.leaves:
            array = jnp.asarray(action[leaf.name] if self.host.action.nested else action, leaf.spec.dtype).reshape(-1)
            is_float = leaf.inner_dtype.kind == "f"
            words.append(jax.lax.bitcast_convert_type(array, jnp.int32) if is_float else array.astype(jnp.int32))
        return jnp.concatenate(words)

    def _observation_shapes(self) -> PyTree[jax.ShapeDtypeStruct]:
        spec = from_space(self.observation_space)
        parts = {name: jax.ShapeDtypeStruct((self.num_envs, *part.shape), part.dtype) for name, part in spec.parts}
        return parts if parts else jax.ShapeDtypeStruct((self.num_envs, *spec.shape), spec.dtype)

    def failure(self) -> EnvironmentFailure | None:
        """What went wrong in the environment since its last reset, if anything did."""
        return self.host.error

    def close(self) -> None:
        """End the environments and their processes."""
        self.host.envs.close()


def hosted(tree: PyTree) -> list[GymnasiumEnv]:
    """Every `GymnasiumEnv` in an algorithm, a loop or a wrapper: they cannot be mapped over seeds, and want closing."""
    nodes = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, GymnasiumEnv))
    return [node for node in nodes if isinstance(node, GymnasiumEnv)]


def failure_of(tree: PyTree) -> EnvironmentFailure | None:
    """The failure of an environment in `tree`, after a program that uses it has raised an exception."""
    return next((failure for env in hosted(tree) if (failure := env.failure()) is not None), None)
