"""Wrappers that change the reward: scaled, normalised, or given by a function, hand-engineered or learned (notes, 1.1).

Each keeps what the innermost environment paid in `extras["raw_reward"]`.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import gymnasium.spaces as spaces
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Key

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep, VectorEnv

RAW_REWARD = "raw_reward"
"""The name in `Timestep.extras` of the reward before any wrapper."""


class ScaleReward(Environment):
    """`scale` times the reward."""

    env: Environment
    scale: float | Float[Array, ""]

    def __check_init__(self) -> None:
        if not isinstance(self.scale, Tracer) and not np.isfinite(self.scale):
            raise ValueError(f"ScaleReward.scale must be a finite number, not {self.scale}")

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        return self.env.reset(key)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        state, timestep = self.env.step(state, action, key)
        return state, _paid(timestep, timestep.reward * self.scale)


class PlainFunction(eqx.Module):
    """A function as a module without parameters: a static part of the compiled program."""

    function: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, observation: Observation, action: Action, next_observation: Observation) -> Array:
        return self.function(observation, action, next_observation)


def _as_module(function: Any) -> Any:
    if not callable(function):
        raise ValueError(
            f"RewardFunction needs a function of observation, action and next observation, not {function!r}"
        )
    return function if isinstance(function, eqx.Module) else PlainFunction(function)


class RewardFunctionState(eqx.Module):
    """The environment's state, and the observation that the next action is chosen from."""

    inner: State
    observation: Observation


class RewardFunction(Environment):
    """The reward is `function(observation, action, next_observation)`, whatever the environment pays.

    - `function`: a plain one (static), or a module such as a learned reward, whose parameters stay traced. It sees what
      the wrapped environment shows; at the end of an episode `next_observation` is the final one.
    """

    env: Environment
    function: Callable[..., Any] = eqx.field(converter=_as_module)

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        inner, observation = self.env.reset(key)
        return RewardFunctionState(inner, observation), observation

    def step(self, state: RewardFunctionState, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        inner, timestep = self.env.step(state.inner, action, key)
        reward = jnp.asarray(self.function(state.observation, action, timestep.final_observation))
        if reward.shape:
            raise ValueError(f"a reward function must return a single number, and this one gave shape {reward.shape}")
        reward = reward.astype(timestep.reward.dtype)
        return RewardFunctionState(inner, timestep.final_observation), _paid(timestep, reward)


class NormalizeRewardState(eqx.Module):
    """The environments' state, each episode's discounted sum of rewards so far, and statistics of all such sums."""

    inner: State
    discounted: Float[Array, "B"]
    mean: Float[Array, ""]
    variance: Float[Array, ""]
    count: Float[Array, ""]


class NormalizeReward(VectorEnv):
    """Rewards divided by the running standard deviation of G_t = γ G_{t-1} + r_t, then clipped to ±`clip`.

    No mean is taken off, which would change what is optimal. G starts at 0 with every episode. Deviation from the usual
    implementation, whose first variance, 1, has the weight of 1e-4 samples: it has the weight of one, without which the
    first rewards are divided by nearly nothing.

    - `gamma`: discount, in [0, 1].
    - `clip`: greatest size of a normalised reward, above 0.
    """

    env: VectorEnv
    gamma: float | Float[Array, ""] = 0.99
    clip: float | Float[Array, ""] = 10.0

    def __check_init__(self) -> None:
        if not isinstance(self.gamma, Tracer) and not 0 <= self.gamma <= 1:
            raise ValueError(f"NormalizeReward.gamma must be in [0, 1], not {self.gamma}")
        if not isinstance(self.clip, Tracer) and not self.clip > 0:
            raise ValueError(f"NormalizeReward.clip must be above 0, not {self.clip}")

    @property
    def num_envs(self) -> int:
        return self.env.num_envs

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, keys: Key[Array, "B"]) -> tuple[State, Observation]:
        inner, observation = self.env.reset(keys)
        return NormalizeRewardState(
            inner, jnp.zeros(self.num_envs), jnp.zeros(()), jnp.ones(()), jnp.ones(())
        ), observation

    def step(self, state: NormalizeRewardState, action: Action, keys: Key[Array, "B"]) -> tuple[State, Timestep]:
        inner, timestep = self.env.step(state.inner, action, keys)
        discounted = self.gamma * state.discounted + timestep.reward
        mean, variance, count = merge(state.mean, state.variance, state.count, discounted)
        reward = jnp.clip(timestep.reward / jnp.sqrt(variance + 1e-8), -self.clip, self.clip)
        kept = jnp.where(timestep.done, 0.0, discounted)
        return NormalizeRewardState(inner, kept, mean, variance, count), _paid(timestep, reward)


def merge(
    mean: Float[Array, ""], variance: Float[Array, ""], count: Float[Array, ""], samples: Float[Array, "B"]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Mean, variance and count of two sets of samples together (Chan, Golub and LeVeque 1983)."""
    size, shift = samples.shape[0], samples.mean() - mean
    total = count + size
    share = size / total
    spread = (1 - share) * variance + share * samples.var() + shift**2 * share * (1 - share)
    return mean + share * shift, spread, total


def _paid(timestep: Timestep, reward: Float[Array, "..."]) -> Timestep:
    """`timestep` with another reward; the one before any wrapper goes to the extras."""
    extras = {RAW_REWARD: timestep.reward, **timestep.extras}
    return Timestep(
        timestep.observation, reward, timestep.terminated, timestep.truncated, timestep.final_observation, extras
    )
