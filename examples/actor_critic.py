"""A learner of your own in one file: an advantage actor-critic with one gradient step a rollout.

rtg train actor_critic:A2C CartPole-v1 --num-envs 16 --loop.unroll 16      (from the folder of this file)
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

import rewardtogo as rtg
from rewardtogo.nn import ACTION_KINDS, ActorCritic, ActorCriticPolicy, Optimiser, as_network
from rewardtogo.ops import gae, normalise


class A2CState(eqx.Module):
    network: ActorCritic
    optimiser: optax.OptState
    updates: Array


class A2C(rtg.Learner):
    """Any actions, any observations, networks without a memory."""

    network: object = rtg.part(rtg.MLP(64, 64), "recipe of both networks", converter=as_network)
    learning_rate: float = rtg.number(2e-3, "Adam's step size", above=0)
    gamma: float = rtg.number(0.99, "discount", at_least=0, at_most=1)
    gae_lambda: float = rtg.number(0.95, "weight of long returns", at_least=0, at_most=1)
    entropy_cost: float = rtg.number(0.01, "weight of the entropy bonus", at_least=0)

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    def init(self, spec, key):
        network = ActorCritic.of(self.network, spec, key)
        return A2CState(network, Optimiser(0.0, 0.5).init(network), jnp.zeros((), jnp.int32))

    def policy(self, state, explore):
        return ActorCriticPolicy(state.network, None, explore)

    def update(self, state, batch, key):
        now, t = self.at(state.updates), batch.transitions  # `at` turns schedules into numbers
        value, next_value = state.network.values(batch, lambda observation: observation)
        discount = now.gamma * (1.0 - t.terminated)  # a truncated step still bootstraps, from next_observation
        over_envs = jax.vmap(gae, in_axes=(1, 1, 1, 1, None, 1), out_axes=1)  # [T, B]: `ops` has no batch axis
        advantage = over_envs(t.reward, discount, value, next_value, now.gae_lambda, t.done)

        def loss(network):
            evaluate = jax.vmap(jax.vmap(lambda o, a, d: network.evaluate((), o, a, d)))
            log_prob, entropy, v = evaluate(t.observation, t.action, t.done)
            policy_loss = -(log_prob * normalise(advantage)).mean() - now.entropy_cost * entropy.mean()
            value_loss = 0.5 * ((v - (advantage + value)) ** 2).mean()
            return policy_loss + 0.5 * value_loss, {"policy_loss": policy_loss, "value_loss": value_loss}

        gradient, metrics = jax.grad(loss, has_aux=True)(state.network)
        network, optimiser = Optimiser(now.learning_rate, 0.5).step(state.network, gradient, state.optimiser)
        return A2CState(network, optimiser, state.updates + 1), metrics, ()
