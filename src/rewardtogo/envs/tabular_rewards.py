"""Rewards that can be swapped: the hook through which a learned reward takes the place of the hand-made one.

An engineered reward r(s, a) is whatever the environment gives; a learned one is a module with parameters, evaluated on
(o_t, a_t, o_{t+1}). Because it is a pytree, a new reward is a new argument of the same compiled program.
`RewardFunction` puts one in an environment's place.

Source: notes, sections 1.1 and 12.
"""

from abc import abstractmethod

import equinox as eqx
from jaxtyping import Array, Float, Int

from ..core import Action, Observation


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
