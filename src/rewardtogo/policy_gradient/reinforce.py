"""REINFORCE: the Monte-Carlo policy gradient (chapter 3, Algorithm 2; Williams 1992), with reward-to-go and a baseline.

One step up the gradient estimate from each rollout,

    g = mean_t grad log pi(a_t|s_t) (G_t - b_t),      G_t = sum_{t' >= t} gamma^(t'-t) r_t'      (discount option 1, item 4.18),

with b the learned value V(s_t), the mean of the batch, or 0. V is fitted to G by regression.

Deviations from the notes: the sum over samples is a mean (decision D2). A return that is cut, by a time limit or by the end of the
rollout, goes on with V of the observation after it (erratum E1.5); inside an episode that ends there is no bootstrapping at all.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ..core import EnvSpec, Learner, Number, PRNGKey, Rollout, number, part, require_action, setting
from ..nn import ACTION_KINDS, MLP, ActorCritic, ActorCriticPolicy, Adam, Network, RunningNorm, as_network, global_norm
from ..ops.advantages import gae, normalise
from ..ops.metrics import explained_variance


class REINFORCEState(eqx.Module):
    """Networks, their two optimisers, what observations look like, and the number of updates done."""

    network: ActorCritic
    policy_optimiser: optax.OptState
    value_optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class REINFORCE(Learner):
    """Monte-Carlo policy gradient. Any action space but dictionaries; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64), "recipe of the actor's and of the critic's network", converter=as_network)
    learning_rate: Number = number(3e-3, "Adam's step size for the policy", above=0)
    value_learning_rate: Number = number(3e-3, "Adam's step size for the value function", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    entropy_cost: Number = number(0.0, "weight of an entropy bonus", at_least=0)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)
    value_updates: int = setting(20, "gradient steps of the value regression on each rollout", at_least=1)
    baseline: Literal["value", "mean", "none"] = setting(
        "value", "what is subtracted from returns", choices=("value", "mean", "none")
    )
    normalise_advantages: bool = setting(True, "mean 0, sd 1 over the rollout")
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    def init(self, spec: EnvSpec, key: PRNGKey) -> REINFORCEState:
        require_action("REINFORCE", spec, self.action_kinds)
        network = ActorCritic.of(self.network, spec, key)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        optimiser = self._optimiser(self.learning_rate).init(network)
        return REINFORCEState(network, optimiser, optimiser, norm, jnp.zeros((), jnp.int32))

    def policy(self, state: REINFORCEState, explore: bool) -> ActorCriticPolicy:
        return ActorCriticPolicy(state.network, state.norm, explore)

    def update(
        self, state: REINFORCEState, batch: Rollout, key: PRNGKey
    ) -> tuple[REINFORCEState, dict[str, Array], tuple[()]]:
        del key
        now, t = self.at(state.updates), batch.transitions
        norm = (lambda x: x) if state.norm is None else state.norm
        value, next_value = state.network.values(batch, norm)
        discount = now.gamma * (1.0 - t.terminated)
        # GAE at lambda = 1 is the Monte-Carlo return less V, continued by V where the return is cut.
        monte_carlo = jax.vmap(gae, in_axes=(1, 1, 1, 1, None, 1), out_axes=1)
        returns = monte_carlo(t.reward, discount, value, next_value, 1.0, t.done) + value
        advantage = returns - {"value": value, "mean": returns.mean(), "none": 0.0}[self.baseline]
        advantage = normalise(advantage) if self.normalise_advantages else advantage
        rollout = eqx.tree_at(lambda r: r.transitions.observation, batch, jax.vmap(jax.vmap(norm))(t.observation))

        def policy_loss(network: ActorCritic) -> tuple[Array, Array]:
            log_prob, entropy, _ = _evaluate(network, rollout)
            return -(log_prob * advantage).mean() - now.entropy_cost * entropy.mean(), entropy.mean()

        def value_loss(network: ActorCritic) -> Float[Array, ""]:
            return 0.5 * ((_evaluate(network, rollout)[2] - returns) ** 2).mean()

        def fit(
            loop: tuple[ActorCritic, optax.OptState], _: None
        ) -> tuple[tuple[ActorCritic, optax.OptState], Float[Array, ""]]:
            network, optimiser = loop
            loss, gradient = jax.value_and_grad(value_loss)(network)
            return now._optimiser(now.value_learning_rate).step(network, gradient, optimiser), loss

        (loss, entropy), gradient = jax.value_and_grad(policy_loss, has_aux=True)(state.network)
        network, policy_state = now._optimiser(now.learning_rate).step(state.network, gradient, state.policy_optimiser)
        loop = (network, state.value_optimiser)
        (network, value_state), value_losses = jax.lax.scan(fit, loop, None, self.value_updates)
        norm = None if state.norm is None else state.norm.update(t.observation)
        metrics = {
            "policy_loss": loss,
            "entropy": entropy,
            "value_loss": value_losses[0],
            "grad_norm": global_norm(gradient),
            "explained_variance": explained_variance(value, returns),
        }
        return REINFORCEState(network, policy_state, value_state, norm, state.updates + 1), metrics, ()

    def _optimiser(self, rate: Number) -> Adam:
        return Adam(rate, self.max_grad_norm)


def _evaluate(network: ActorCritic, rollout: Rollout) -> tuple[Array, Array, Array]:
    """Log pi(a|s), entropy and value of every step, `[T, B]`; observations are standardised already."""
    t = rollout.transitions
    if network.recurrent:
        whole = jax.vmap(lambda c, o, a, d: network.evaluate(c, o, a, d), in_axes=(0, 1, 1, 1), out_axes=1)
        return whole(rollout.carry, t.observation, t.action, t.done)
    return jax.vmap(jax.vmap(lambda o, a, d: network.evaluate(network.init(), o, a, d)))(
        t.observation, t.action, t.done
    )
