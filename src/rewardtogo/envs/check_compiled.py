"""What is wrong with a compiled environment: forms first, without running it, then a walk of random steps."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..core import MASK, Environment, Timestep, from_space
from .findings import Report, Stop, Watch, check_spaces
from .translate import Translation
from .vectorize import vectorize


def _signature(tree: Any) -> dict[str, tuple[tuple[int, ...], str]]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): (jnp.shape(leaf), str(leaf.dtype)) for path, leaf in leaves}


def _form(leaf: tuple[tuple[int, ...], str] | None) -> str:
    return "missing" if leaf is None else f"{leaf[1]}{list(leaf[0])}"


def _difference(one: Any, two: Any) -> str | None:
    """The first leaf in which two trees of arrays are not of the same shape and type, in words."""
    left, right = _signature(one), _signature(two)
    for path in [*left, *right]:
        if left.get(path) != right.get(path):
            return f"{path or 'it'} is {_form(left.get(path))} and then {_form(right.get(path))}"
    return None


def _compiled(report: Report, what: str, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except Exception as cause:
        first = str(cause).strip().split("\n")[0]
        report.error(
            what,
            f"{what} cannot be compiled, {type(cause).__name__}: {first}: use jax.numpy, and jnp.where instead of if",
        )
        raise Stop from cause


def _check_types(report: Report, env: Environment) -> None:
    """Shapes and types of `reset` and `step`, without running a step."""
    key, action = jax.random.key(0), from_space(env.action_space).zeros()
    eager = _compiled(report, "reset", lambda: (env.reset(key), env.reset(key)))
    for path, leaf in jax.tree_util.tree_leaves_with_path(eager[0][0]):
        if not isinstance(leaf, (jax.Array, np.ndarray)):
            report.error(
                "state",
                f"the state's leaf {jax.tree_util.keystr(path)} is a {type(leaf).__name__}: make it an array "
                "(jnp.asarray), or a static field if it never changes",
            )
    if not all(map(_equal, jax.tree.leaves(eager[0]), jax.tree.leaves(eager[1]))):
        report.error(
            "pure", "reset gave two different results for the same key: draw all randomness from it with jax.random"
        )
    state, observation = _compiled(report, "reset", lambda: jax.eval_shape(lambda k: env.reset(k), key))
    after, timestep = _compiled(
        report, "step", lambda: jax.eval_shape(lambda s, a, k: env.step(s, a, k), state, action, key)
    )
    if not isinstance(timestep, Timestep):
        report.error("timestep", f"step gave a {type(timestep).__name__} as its second value: return a Timestep")
        raise Stop
    for name, flag in (("terminated", timestep.terminated), ("truncated", timestep.truncated)):
        if _signature(flag) != {"": ((), "bool")}:
            report.error(
                "flags", f"{name} is {_say(flag)}, not bool[]: compare instead of counting, or give jnp.zeros((), bool)"
            )
    if _signature(timestep.reward) != {"": ((), "float32")}:
        report.error(
            "reward type",
            f"the reward is {_say(timestep.reward)}, not float32[]: give jnp.asarray(reward, jnp.float32)",
        )
    expected = from_space(env.observation_space).zeros()
    for name, value in (
        ("reset's observation", observation),
        ("step's observation", timestep.observation),
        ("step's final_observation", timestep.final_observation),
    ):
        difference = _difference(expected, value)
        if difference is not None:
            report.error(
                "observation",
                f"{name} is not what its space says, {difference}: return what observation_space promises",
            )
    difference = _difference(state, after)
    if difference is not None:
        report.error(
            "state", f"the state changes its form between reset and step, {difference}: keep shapes and types the same"
        )
    if report.found.keys() & {"state", "timestep", "flags", "reward type", "observation"}:
        raise Stop


def _say(tree: Any) -> str:
    return ", ".join(map(_form, _signature(tree).values())) or "missing"


def _equal(one: Any, two: Any) -> bool:
    is_key = isinstance(one, jax.Array) and jnp.issubdtype(one.dtype, jax.dtypes.prng_key)
    one, two = (np.asarray(jax.random.key_data(x) if is_key else x) for x in (one, two))
    return np.array_equal(one, two, equal_nan=one.dtype.kind == "f")


def _walk_compiled(report: Report, env: Environment, steps: int) -> None:
    copies = 4
    action_spec, vectorized = from_space(env.action_space), vectorize(env, copies)

    def one(state: Any, key: jax.Array) -> tuple[Any, Timestep]:
        act_key, step_key = jax.random.split(key)
        action = jax.vmap(action_spec.sample)(jax.random.split(act_key, copies))
        return vectorized.step(state, action, jax.random.split(step_key, copies))

    def walk(key: jax.Array) -> Timestep:
        reset_key, walk_key = jax.random.split(key)
        state, _ = vectorized.reset(jax.random.split(reset_key, copies))
        return jax.lax.scan(one, state, jax.random.split(walk_key, steps))[1]

    seen = _compiled(report, "step", lambda: jax.block_until_ready(jax.jit(walk)(jax.random.key(0))))
    translation = Translation(env.observation_space)
    watch = Watch(translation)
    for observation in jax.tree.map(np.asarray, (seen.observation, seen.final_observation)):
        watch.observe(observation if translation.nested else {"": observation})
    watch.rewards, watch.ended = np.asarray(seen.reward).ravel().tolist(), int(np.asarray(seen.done).sum())
    watch.report(report, limited=False, steps=steps)
    if translation.nested and MASK in seen.observation and not np.asarray(seen.observation[MASK]).any(-1).all():
        report.error(
            "mask", f"the observation's part '{MASK}' forbade every action: end the episode there, or allow one"
        )


def check_compiled(report: Report, env: Environment, steps: int) -> None:
    """Put into `report` what is wrong with `env`."""
    if not check_spaces(report, env.observation_space, env.action_space):
        return
    try:
        _check_types(report, env)
        _walk_compiled(report, env, steps)
    except Stop:
        pass
