"""What the tests of imitation share: datasets, demonstrations, and training in one program."""

from functools import partial

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp

from rewardtogo.core import Algorithm, Environment, EnvSpec, Transition, env_spec, from_space
from rewardtogo.data import Dataset


def steps(observation, action, spec: EnvSpec, length: int = 10, extras=None) -> Dataset:
    """A dataset of episodes of `length` steps in which one observation leads to the next."""
    size = len(jax.tree.leaves(action)[0])
    end = jnp.arange(size) % length == length - 1
    following = jax.tree.map(lambda x: jnp.roll(x, -1, 0), observation)
    t = Transition(observation, action, jnp.zeros(size), jnp.zeros(size, bool), end | (jnp.arange(size) == size - 1),
                   following, extras or {})  # fmt: skip
    return Dataset.of(t, spec)


@partial(jax.jit, static_argnames="iterations")
def _fit(algorithm: Algorithm, key, iterations: int):
    state, keys = algorithm.init(key), jax.random.split(key, iterations)
    return jax.lax.scan(lambda s, k: algorithm.step(s, k), state, keys)


def run(algorithm: Algorithm, key, iterations: int):
    """State and metrics by iteration, all in one program."""
    fit = partial(_fit, iterations=iterations)
    fit = fit if key.ndim == 0 else jax.vmap(fit, in_axes=(None, 0))
    state, (metrics, _) = fit(algorithm.with_horizon(iterations), key)
    return state, metrics


def spec_of(observation: spaces.Space, action: spaces.Space) -> EnvSpec:
    return EnvSpec(from_space(observation), from_space(action))


def flights(env: Environment, count: int, key) -> Dataset:
    """Episodes of one step in which the expert of `env` acts."""

    @jax.jit
    def fly(key):
        reset_key, act_key = jax.random.split(key)
        _, observation = env.reset(reset_key)
        return observation, env.expert(observation, act_key)

    observation, action = jax.vmap(fly)(jax.random.split(key, count))
    return steps(observation, action, env_spec(env), length=1)
