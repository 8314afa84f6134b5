"""An environment as the model of itself: what planners look ahead with where the dynamics are known (notes, section 8)."""

from typing import cast

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core import Action, Environment, Model, Observation, Observed, PRNGKey, State


class Simulation(eqx.Module):
    """A moment of a simulation: the environment's state, the reward that led to it, and whether the episode is over."""

    state: State
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]


class KnownModel(Model):
    """`env`, simulated. A simulation is a value: keeping one is saving the simulator, going on from it is rolling it back (item 8.19).

    `encode` needs an environment whose observation tells its state (`Observed`); `at` starts from any state of any environment. A time
    limit is no property of the dynamics and ends no simulation.
    """

    env: Environment

    def at(self, state: State) -> Simulation:
        """The simulation that goes on from a state of the environment's."""
        return Simulation(state, jnp.zeros(()), jnp.zeros((), bool))

    def encode(self, observation: Observation) -> Simulation:
        if not isinstance(self.env, Observed):
            raise ValueError(
                f"an observation of {type(self.env).__name__} does not tell its state: plan from the state itself, with KnownModel.at"
            )
        return self.at(cast(Observed, self.env).state_of(observation))

    def transition(self, state: Simulation, action: Action, key: PRNGKey) -> Simulation:
        after, timestep = self.env.step(state.state, action, key)
        return Simulation(after, timestep.reward, timestep.terminated)

    def reward(self, state: Simulation, action: Action, next_state: Simulation) -> Float[Array, ""]:
        del state, action
        return next_state.reward

    def terminal(self, state: Simulation) -> Bool[Array, ""]:
        return state.terminated
