"""Sampled episodes and the sample mean of their returns: what every estimator of the notes starts from.

    Ĵ = (1/N) Σ_i Σ_t γ^t r_{i,t},   s.e.(Ĵ) = sqrt(Var[return] / N)

It needs samples of p_0 and P only, never their values: in erratum E1.3's words, p(s_0) need not be known.

Source: notes, section 1.1.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core import Environment, Policy, PRNGKey, env_spec
from .trajectories import Trajectories


class Estimate(eqx.Module):
    """A sample mean and its standard error."""

    mean: Float[Array, ""]
    standard_error: Float[Array, ""]


@eqx.filter_jit
def simulate(env: Environment, policy: Policy, key: PRNGKey, num_episodes: int, horizon: int) -> Trajectories:
    """Episodes of a compiled environment, each cut (`truncated`) after `horizon` actions if it has not ended."""
    return jax.vmap(lambda k: _episode(env, policy, k, horizon))(jax.random.split(key, num_episodes))


@eqx.filter_jit
def monte_carlo_return(
    env: Environment,
    policy: Policy,
    key: PRNGKey,
    num_episodes: int,
    horizon: int,
    discount: float | Array | np.ndarray = 1.0,
) -> Estimate:
    """The mean return of `num_episodes` sampled episodes and its standard error (item 1.16)."""
    returns = simulate(env, policy, key, num_episodes, horizon).returns(discount)
    return Estimate(returns.mean(), returns.std(ddof=1) / jnp.sqrt(float(num_episodes)))


def _episode(env: Environment, policy: Policy, key: PRNGKey, horizon: int) -> Trajectories:
    reset_key, carry_key, steps_key = jax.random.split(key, 3)
    action_spec = env_spec(env).action
    state, observation = env.reset(reset_key)
    start = (state, observation, policy.init(carry_key), jnp.zeros((), bool))

    def step(now: tuple, keys: Array) -> tuple[tuple, tuple]:
        state, observation, carry, done = now
        carry, action, extras = policy(carry, observation, keys[0])
        following, timestep = env.step(state, action_spec.clip(action), keys[1])
        held = lambda old, new: jax.tree.map(lambda x, y: jnp.where(done, x, y), old, new)  # noqa: E731
        state, seen = held((state, observation), (following, timestep.final_observation))
        nothing = jax.tree.map(jnp.zeros_like, (timestep.reward, timestep.terminated, timestep.truncated, extras))
        given = held(nothing, (timestep.reward, timestep.terminated, timestep.truncated, extras))
        return (state, seen, carry, done | timestep.done), (seen, action, ~done, *given)

    (*_, done), (seen, actions, taken, rewards, terminated, truncated, extras) = jax.lax.scan(
        step, start, jax.random.split(steps_key, (horizon, 2))
    )
    observations = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), observation, seen)
    return Trajectories(observations, actions, rewards, taken.sum(), terminated.any(), truncated.any() | ~done, extras)
