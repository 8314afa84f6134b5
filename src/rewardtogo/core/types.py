"""The data that moves between environments, loops and learners.

Axis letters, project-wide: `T` time, `B` parallel environments or batch, `N` samples, `A` actions, `O` observation, `S` states,
`H` planning horizon, `E` ensemble members. The same class is used with and without leading axes: `Timestep` of one environment
and of `B`. Time counts from 0; a trajectory of T actions has T + 1 observations (erratum E1.1), the last of which is
`next_observation[T - 1]`.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

PRNGKey = Key[Array, ""]
Observation = PyTree[Array]
Action = PyTree[Array]
Carry = PyTree[Array]
State = Any
"""Anything whose leaves are arrays."""


class Timestep(eqx.Module):
    """What one step of an environment gives.

    - `observation`: where the next action is chosen from; after an automatic reset, the first one of the new episode.
    - `reward`: of the action just taken.
    - `terminated`: the episode ended in a terminal state, whose value is 0.
    - `truncated`: the episode was cut (a time limit), so that the value of `final_observation` still counts (erratum E1.5).
    - `final_observation`: where the action led, before any reset. Equal to `observation` inside an episode.
    - `extras`: declared by the environment, with fixed names, such as `is_success` or `raw_reward`.
    """

    observation: Observation
    reward: Float[Array, "..."]
    terminated: Bool[Array, "..."]
    truncated: Bool[Array, "..."]
    final_observation: Observation
    extras: dict[str, Array]

    @property
    def done(self) -> Bool[Array, "..."]:
        """Whether the episode is over, either way."""
        return self.terminated | self.truncated

    @property
    def score(self) -> Float[Array, "..."]:
        """What counts for an episode's return: the reward before any wrapper scaled or replaced it (`extras["raw_reward"]`)."""
        return self.extras.get("raw_reward", self.reward)


class Transition(eqx.Module):
    """One step as a learner sees it: `(s, a, r, s')`, the two ends apart, and what the policy said while acting.

    - `next_observation`: before any reset.
    - `extras`: what the policy returned with the action (`log_prob` for those that sample one), and nothing else.
    """

    observation: Observation
    action: Action
    reward: Float[Array, "..."]
    terminated: Bool[Array, "..."]
    truncated: Bool[Array, "..."]
    next_observation: Observation
    extras: dict[str, PyTree[Array]]

    @property
    def done(self) -> Bool[Array, "..."]:
        """Whether the episode is over, either way."""
        return self.terminated | self.truncated


class Rollout(eqx.Module):
    """Consecutive steps of B environments: `transitions` `[T, B]`, and the policy's `carry` `[B]` before the first of them."""

    transitions: Transition
    carry: Carry


class Batch(eqx.Module):
    """What a replay or a dataset hands out: `transitions` `[N]` or `[T, N]`, where they lie in it, and the weight of each."""

    transitions: Transition
    indices: Int[Array, "N"]
    weights: Float[Array, "N"]


class Episodes(eqx.Module):
    """Finished episodes as sums, never means: no NaN where there were none, and they add over chunks, seeds and devices."""

    return_sum: Float[Array, "..."]
    length_sum: Float[Array, "..."]
    count: Float[Array, "..."]

    @staticmethod
    def none() -> "Episodes":
        """No episode at all."""
        return Episodes(*(jnp.zeros(()) for _ in range(3)))

    def __add__(self, other: "Episodes") -> "Episodes":
        return jax.tree.map(jnp.add, self, other)


class EpisodeStats(eqx.Module):
    """Return and length so far of the episode that each environment is in."""

    return_so_far: Float[Array, "..."]
    length_so_far: Float[Array, "..."]


class Actor(eqx.Module):
    """Where B environments stand between two calls of `collect`."""

    env_state: State
    observation: Observation
    carry: Carry
    stats: EpisodeStats
