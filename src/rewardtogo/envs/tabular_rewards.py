"""Rewards that can be swapped: the hook through which a learned reward takes the place of the hand-made one.

An engineered reward r(s, a) is whatever the environment gives; a learned one is a module with parameters, evaluated on
(o_t, a_t, o_{t+1}). Because it is a pytree, a new reward is a new argument of the same compiled program.

Source: notes, sections 1.1 and 12.
"""

from abc import abstractmethod

import equinox as eqx
import gymnasium.spaces as spaces
from jaxtyping import Array, Float, Int, PyTree

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep


class Reward(eqx.Module):
    """A reward as a function of one step. Its parameters are its leaves."""

    @abstractmethod
    def __call__(self, observation: Observation, action: Action, next_observation: Observation) -> Float[Array, ""]:
        """r(o_t, a_t, o_{t+1}), the last before any reset."""


class TableReward(Reward):
    """r(s, a) from a table, for discrete observations and actions."""

    table: Float[Array, "S A"]

    def __call__(
        self, observation: Int[Array, ""], action: Int[Array, ""], next_observation: Int[Array, ""]
    ) -> Float[Array, ""]:
        del next_observation
        return self.table[observation, action]


class RewardedState(eqx.Module):
    """State of the environment underneath, and what it last showed."""

    env_state: PyTree[Array]
    observation: PyTree[Array]


class WithReward(Environment):
    """`env` with its reward replaced by `reward`; all else stays bit for bit as it was (item 1.10)."""

    env: Environment
    reward: Reward

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state, observation = self.env.reset(key)
        return RewardedState(state, observation), observation

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        env_state, timestep = self.env.step(state.env_state, action, key)
        reward = self.reward(state.observation, action, timestep.final_observation)
        timestep = eqx.tree_at(lambda step: step.reward, timestep, reward)
        return RewardedState(env_state, timestep.observation), timestep
