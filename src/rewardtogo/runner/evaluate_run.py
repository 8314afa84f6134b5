"""Evaluating a finished run: its policy from the folder, whole episodes in its own environment or in another one."""

from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp

from ..core import EnvSpec, Learner, Policy, Spec, VectorEnv, env_spec
from ..data.files import Damaged
from ..envs.gymnasium import GymnasiumEnv, hosted
from ..envs.registry import BACKENDS, COMPILED, make
from ..envs.vectorize import Vectorized, vectorize
from ..value.overestimation import check_values
from .config import as_builtin
from .engine import Program
from .evaluate import Evaluator, lanes_for, summary
from .folder import RunFolder
from .plan import Plan, check_budget, from_config
from .policy import load
from .train import RunState

VALUE_STEPS = 20_000
"""Steps played to compare values with returns."""


def evaluate_run(
    run: str | Path,
    episodes: int = 100,
    env: Any = None,
    backend: str | None = None,
    checkpoint: str | int = "last",
    stochastic: bool = False,
    seed: int = 0,
    learner: Learner | None = None,
    values: bool = False,
) -> dict[str, Any]:
    """Play exactly `episodes` whole episodes with a run's policy; what `rtg eval --json` prints.

    - `env`, `backend`: by default those of the run. Another environment must have the same spaces.
    - `checkpoint`: `"last"`, `"best"`, or the number of an iteration of which `checkpoints/` has the whole state.
    - `stochastic`: sample actions as in training.
    - `learner`: needed for a run of a learner that is not part of the library.
    - `values`: compare what the policy thinks that states are worth with what it then earns, discounted as in training
      (`value.overestimation`): `value_estimated`, `value_true`, and how many states were compared, `value_states`.

    Raises `ValueError`, one sentence, where the run, the checkpoint or the environment cannot be used.
    """
    if isinstance(episodes, bool) or episodes < 1:
        raise ValueError(f"an evaluation needs at least one episode, not {episodes}")
    check_budget(None, seed)
    folder = RunFolder(run)
    policy, spec = policy_of(folder, checkpoint, stochastic, learner)
    vector_env = environment_of(folder, env, backend, episodes)
    try:
        require_same_spaces(spec, vector_env)
        returns, lengths = Evaluator(vector_env, episodes)(policy, jax.random.key(seed))
        thoughts = _values(folder, policy, vector_env, seed) if values else {}
    finally:
        if env is None or isinstance(env, str):
            for host in hosted(vector_env):
                host.close()
    # Where the environments do not divide the episodes, the last round is too long; dropping by place favours no length.
    return summary(returns[:episodes], lengths[:episodes]) | thoughts


def _values(folder: RunFolder, policy: Policy, env: VectorEnv, seed: int) -> dict[str, Any]:
    """Mean estimated and true values of the states of `VALUE_STEPS` steps; None where no state's value became known."""
    gamma = folder.config()["learner"].get("gamma")
    if not isinstance(gamma, (int, float)):
        raise ValueError(
            f"{folder.path} was trained without one fixed discount, so its values have no meaning to check: leave --values out"
        )
    steps = -(-VALUE_STEPS // env.num_envs)
    check = jax.jit(lambda policy, key: check_values(env, policy, key, gamma=gamma, steps=steps))
    found = jax.device_get(check(policy, jax.random.key(seed)))
    means = {"value_estimated": found.estimated, "value_true": found.true}
    return as_builtin(means) | {"value_states": int(found.states)}


def policy_of(
    folder: RunFolder, checkpoint: str | int, stochastic: bool, learner: Learner | None
) -> tuple[Policy, EnvSpec]:
    """The policy of a run as loops take it, and the spaces it acts in."""
    if checkpoint in ("best", "last"):
        loaded = load(folder.path, learner, str(checkpoint))
        return loaded.policy(stochastic), loaded.spec
    if not str(checkpoint).isdigit():
        have = ", ".join(map(str, folder.iterations())) or "none"
        raise ValueError(
            f"there is no checkpoint {checkpoint!r}: choose best, last, or the number of an iteration ({folder.path} has {have})"
        )
    plan, state = restore(folder, int(checkpoint), learner)
    for host in hosted(plan.algorithm):
        host.close()
    return plan.algorithm.policy(state, stochastic), plan.algorithm.spec


def restore(folder: RunFolder, iteration: int, learner: Learner | None = None) -> tuple[Plan, Any]:
    """A run's plan and the whole state of its algorithm after `iteration` iterations."""
    config = folder.config()
    if iteration not in folder.iterations():
        have = ", ".join(map(str, folder.iterations())) or "none"
        raise Damaged(f"{folder.path} has no checkpoint {iteration}: it has {have}, and the policies best and last")
    plan = from_config(config, steps=None, learner=learner)
    program = Program(plan.algorithm, jax.random.key(config["seed"]), config["row_every"])
    shapes = program.shapes()
    like = RunState(shapes, jax.eval_shape(program.fresh_sums, shapes), jax.ShapeDtypeStruct((), jnp.float32))
    state, _ = folder.load_checkpoint(iteration, like)
    return plan, state.algorithm


def environment_of(folder: RunFolder, env: Any, backend: str | None, episodes: int) -> VectorEnv:
    """The environments to evaluate in: as many as divide `episodes`, so that each plays the same number."""
    described = folder.config()["env"]
    name, kwargs = (described["id"], described["kwargs"]) if env is None else (env, {})
    if env is None and not described["by_name"]:
        raise ValueError(
            f"the run was made with an environment object ({name}), which a file cannot hold: name one with --env, "
            "or give it from Python with evaluate_run(run, env=...)"
        )
    if env is None and name == "none":
        raise ValueError("the run learnt from a dataset without an environment: name one with --env")
    if backend is None:
        backend = described["backend"] if name == described["id"] else "auto"
    if backend not in BACKENDS:
        raise ValueError(f"there is no backend {backend!r}: choose one of {', '.join(BACKENDS)}")
    if isinstance(name, Vectorized):
        return vectorize(name.env, lanes_for(episodes, compiled=True))
    if isinstance(name, VectorEnv):
        return name
    if isinstance(name, (gymnasium.Env, gymnasium.vector.VectorEnv)):
        return GymnasiumEnv(name)
    compiled = (
        name in COMPILED and backend not in ("gymnasium", "envpool") and not kwargs if isinstance(name, str) else True
    )
    lanes = lanes_for(episodes, compiled)
    return make(name, lanes, backend=backend, **kwargs)  # type: ignore[arg-type]


def require_same_spaces(spec: EnvSpec, env: VectorEnv) -> None:
    """Raise `ValueError`, saying what differs, unless a policy trained in the spaces of `spec` can act in `env`.

    The bounds of what is observed may differ, since no network looks at them; those of actions may not.
    """
    given = env_spec(env)
    pairs = (
        ("observes", _words(spec.observation, False), _words(given.observation, False)),
        ("acts with", _words(spec.action, True), _words(given.action, True)),
    )
    for verb, mine, other in pairs:
        if mine != other:
            raise ValueError(
                f"the policy asks for another environment: it {verb} {mine}, and this environment has {other}"
            )


def _words(spec: Spec, bounds: bool) -> str:
    """A space in words, without the bounds if they do not matter."""
    if spec.kind == "dict":
        return "the parts " + ", ".join(f"{name} ({_words(part, bounds)})" for name, part in spec.parts)
    if spec.kind == "discrete":
        return f"one of {spec.counts[0]} choices"
    if spec.kind == "multi_discrete":
        return f"choices among {list(spec.counts)} of shape {list(spec.shape)}"
    if spec.kind == "multi_binary":
        return f"yes or no of shape {list(spec.shape)}"
    limits = [" and ".join(f"{v:g}" for v in dict.fromkeys(b)) for b in (spec.low, spec.high)]
    return f"a {spec.dtype} box of shape {list(spec.shape)}" + (f" from {limits[0]} to {limits[1]}" if bounds else "")
