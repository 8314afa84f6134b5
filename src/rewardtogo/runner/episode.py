"""One episode of a compiled environment, step by step on the host, so that its states can be drawn."""

from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from ..core import Carry, Environment, Observation, Policy, PRNGKey, Spec, State, Timestep, VectorEnv, env_spec
from ..envs.drawing import picture
from ..envs.registry import COMPILED
from ..envs.reward_wrappers import NormalizeReward
from ..envs.vectorize import Vectorized
from .evaluate import MAX_STEPS


def compiled_env(described: dict[str, Any], env: Any = None) -> Environment | None:
    """The compiled environment that an episode is played in: of `env` where it is given, else of the description; None: Gymnasium's."""
    if env is None:
        compiled = described["by_name"] and described["backend"] == "jax" and described["id"] in COMPILED
        return COMPILED[described["id"]](**described["kwargs"]) if compiled else None
    if isinstance(env, NormalizeReward):
        return compiled_env(described, env.env)
    if isinstance(env, Environment):
        return env
    if isinstance(env, Vectorized):
        return env.env
    if callable(env) and not isinstance(env, (gymnasium.Env, VectorEnv)):
        try:
            made = env(**described["kwargs"])
        except Exception:  # what it wants is `render_mode`, say: then it is Gymnasium's, and is made where it is drawn
            return None
        if isinstance(made, gymnasium.Env):
            made.close()
        return compiled_env(described, made) if isinstance(made, (Environment, VectorEnv)) else None
    return None


def played(
    env: Environment, policy: Policy, key: PRNGKey, name: str, draws: bool = False
) -> tuple[list[State], list[Any], float]:
    """One episode of a compiled environment: its states, the first and the last included, what was seen of them, and the return.

    With `draws` raises `ValueError` before the first step where there is no picture of the environment.
    """
    spec = env_spec(env).action
    reset_key, carry_key, loop_key = jax.random.split(key, 3)
    state, observation = jax.jit(lambda k: env.reset(k))(reset_key)
    states, observations, total = [_on_host(state)], [_on_host(observation)], 0.0
    if draws:
        drawn(env, name, states, observations, 0)
    carry = policy.init(carry_key)
    for step in range(MAX_STEPS):
        now = jax.random.fold_in(loop_key, step)
        carry, state, timestep = _one_step(env, policy, spec, carry, state, observation, now)
        observation = timestep.observation
        states.append(_on_host(state))
        observations.append(_on_host(observation))
        total += float(timestep.score)
        if timestep.done:
            return states, observations, total
    raise endless(name)


@partial(jax.jit, static_argnames=("spec",))
def _one_step(
    env: Environment, policy: Policy, spec: Spec, carry: Carry, state: State, observation: Observation, key: PRNGKey
) -> tuple[Carry, State, Timestep]:
    act_key, step_key = jax.random.split(key)
    carry, action, _ = policy(carry, observation, act_key)
    state, timestep = env.step(state, spec.clip(action), step_key)
    return carry, state, timestep


def _on_host(tree: Any) -> Any:
    keeps = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return jax.tree.map(lambda x: x if keeps(x) else np.asarray(x), tree)


def drawn(
    env: Environment, name: str, states: list[State], observations: list[Any], step: int
) -> UInt8[np.ndarray, "H W 3"]:
    """The picture of a moment of an episode. Raises `ValueError` where there is none."""
    found = picture(env, states[step], observations[step], states[:step])
    if found is None:
        raise ValueError(
            f"{name} has no picture: an environment that inherits `rtg.Drawn` and has a method render(state, earlier) that gives "
            "uint8[height, width, 3] can be shown"
        )
    return found


def endless(name: str) -> ValueError:
    """What is said of an episode that was given up."""
    return ValueError(f"the episode of {name} did not end within {MAX_STEPS} steps: give it a time limit")
