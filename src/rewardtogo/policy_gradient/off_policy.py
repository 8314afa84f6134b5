"""Off-policy policy gradients by importance sampling (notes 3.8 and 3.9; Degris et al. 2012).

From sequences that older policies mu played, with rho_t = pi(a_t|s_t) / mu(a_t|s_t),

    g = mean_t w_t grad log pi(a_t|s_t) (R_t - V(s_t)),

| `weighting` | w_t | R_t | |
|---|---|---|---|
| `trajectory` | product of all rho of the trajectory | sum_{t' >= t} gamma^(t'-t) r_t' | 3.30 |
| `per_decision` | prod_{k <= t} rho_k | sum_{t'} gamma^(t'-t) r_t' prod_{t < k <= t'} rho_k | 3.33, erratum E3.8 |
| the same, `future_ratio` off | prod_{k <= t} rho_k | sum_{t'} gamma^(t'-t) r_t' | biased: 3.34, erratum E3.9 |
| `first_order` | rho_t | sum_{t'} gamma^(t'-t) r_t' | the ratio of the states dropped: 3.36, erratum E3.10 |

Weights are cut at `truncation`, which bounds their variance (it grows like (1 + chi^2)^T, item 3.32) and biases them, and may be divided by
their mean (`self_normalised`). The effective sample size is reported. V is fitted to V-trace targets.

Deviations from the notes: a trajectory is the part of an episode that lies in the sequence, so products begin where the sequence does.
A return goes on with V where the sequence ends or a time limit cuts it.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from ..core import Batch, EnvSpec, Learner, Number, PRNGKey, Rollout, number, part, require_action, setting
from ..nn import (
    ACTION_KINDS,
    MLP,
    ActorCritic,
    ActorCriticPolicy,
    Network,
    Optimiser,
    RunningNorm,
    as_network,
    global_norm,
)
from ..ops.importance import effective_sample_size
from ..ops.returns import backward
from ..ops.vtrace import vtrace
from .vanilla import evaluate, regress

Weighting = Literal["trajectory", "per_decision", "first_order"]


class OffPolicyPGState(eqx.Module):
    """Networks, their two optimisers, what observations look like, and the number of updates done."""

    network: ActorCritic
    policy_optimiser: optax.OptState
    value_optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class OffPolicyPG(Learner):
    """Importance-weighted policy gradient. Any action space but dictionaries; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64), "recipe of the actor's and of the critic's network", converter=as_network)
    weighting: Weighting = setting(
        "first_order", "which ratios correct a step", choices=("trajectory", "per_decision", "first_order")
    )
    future_ratio: bool = setting(True, "correct later rewards too, in `per_decision`")
    truncation: Number = number(10.0, "weights are cut here", above=0)
    self_normalised: bool = setting(False, "divide the weights by their mean")
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    learning_rate: Number = number(1e-3, "Adam's step size for the policy", above=0)
    value_learning_rate: Number = number(3e-3, "Adam's step size for the value function", above=0)
    value_updates: int = setting(5, "gradient steps of the value regression on each batch", at_least=1)
    entropy_cost: Number = number(0.0, "weight of an entropy bonus", at_least=0)
    max_grad_norm: Number = number(1.0, "gradients are scaled down to this global norm", above=0)
    log_std: Number = number(0.0, "log standard deviation that a Gaussian policy begins with, in units of half the box")
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    @property
    def batch(self) -> Literal["sequences"]:
        return "sequences"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    def init(self, spec: EnvSpec, key: PRNGKey) -> OffPolicyPGState:
        require_action("OffPolicyPG", spec, self.action_kinds)
        network = ActorCritic.of(self.network, spec, key, log_std=self.at(0).log_std)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        optimiser = self._optimiser(self.learning_rate).init(network)
        return OffPolicyPGState(network, optimiser, optimiser, norm, jnp.zeros((), jnp.int32))

    def policy(self, state: OffPolicyPGState, explore: bool) -> ActorCriticPolicy:
        return ActorCriticPolicy(state.network, state.norm, explore, state.updates)

    def update(
        self, state: OffPolicyPGState, batch: Batch, key: PRNGKey
    ) -> tuple[OffPolicyPGState, dict[str, Array], Float[Array, "N"]]:
        del key
        now, t = self.at(state.updates), batch.transitions
        if "log_prob" not in t.extras:
            raise ValueError(
                "importance weights need the probability with which each action was chosen, and this data does not say it: "
                "use data of this library's own policies, kept in a replay"
            )
        norm = (lambda x: x) if state.norm is None else state.norm
        rollout = Rollout(t, jax.tree.map(lambda x: x[0], t.extras["carry"]))
        value, next_value = state.network.values(rollout, norm)
        standard = eqx.tree_at(lambda r: r.transitions.observation, rollout, jax.vmap(jax.vmap(norm))(t.observation))
        log_ratio = evaluate(state.network, standard)[0] - t.extras["log_prob"]
        ratio, discount = jnp.exp(log_ratio), now.gamma * (1.0 - t.terminated)
        target, _ = jax.vmap(vtrace, (1, 1, 1, 1, 1, None, 1), 1)(
            t.reward, discount, value, next_value, ratio, 1.0, t.done
        )
        future = self.weighting == "per_decision" and self.future_ratio
        returns = jax.vmap(corrected_returns, 1, 1)(
            t.reward, discount, next_value, ratio if future else jnp.ones_like(ratio), t.done
        )
        log_weight = jax.vmap(lambda x, c: log_weights(x, c, self.weighting), 1, 1)(log_ratio, t.done)
        weight = jnp.minimum(jnp.exp(log_weight), now.truncation)
        weight = weight / weight.mean() if self.self_normalised else weight
        scale = batch.weights[None] * weight * (returns - value)

        def loss(network: ActorCritic) -> tuple[Array, Array]:
            log_prob, entropy, _ = evaluate(network, standard)
            return -(log_prob * scale).mean() - now.entropy_cost * entropy.mean(), entropy.mean()

        (value_of_loss, entropy), gradient = jax.value_and_grad(loss, has_aux=True)(state.network)
        network, policy_state = now._optimiser(now.learning_rate).step(state.network, gradient, state.policy_optimiser)
        rule = now._optimiser(now.value_learning_rate)
        network, value_state, value_loss = regress(
            network, state.value_optimiser, rule, standard, target, self.value_updates
        )
        statistics = None if state.norm is None else state.norm.update(t.observation)
        metrics = {
            "policy_loss": value_of_loss,
            "value_loss": value_loss,
            "entropy": entropy,
            "grad_norm": global_norm(gradient),
            "effective_sample_size": effective_sample_size(log_weight.reshape(-1)) / log_weight.size,
            "behaviour_kl": -log_ratio.mean(),
        }
        state = OffPolicyPGState(network, policy_state, value_state, statistics, state.updates + 1)
        return state, metrics, jnp.abs(target - value).mean(0)

    def _optimiser(self, rate: Number) -> Optimiser:
        return Optimiser(rate, self.max_grad_norm)


def corrected_returns(
    r_t: Float[Array, "T"],
    discount_t: Float[Array, "T"],
    v_t: Float[Array, "T"],
    ratio_t: Float[Array, "T"],
    cut_t: Bool[Array, "T"],
) -> Float[Array, "T"]:
    """R_t = r_t + discount_t rho_{t+1} R_{t+1}: rewards to go, each weighted by the ratios of the actions between (item 3.33)."""
    ends = cut_t.at[-1].set(True)
    following = jnp.where(ends, 0.0, jnp.roll(ratio_t, -1))
    return backward(r_t + discount_t * jnp.where(ends, v_t, 0.0), discount_t * following)


def log_weights(log_ratio_t: Float[Array, "T"], cut_t: Bool[Array, "T"], weighting: Weighting) -> Float[Array, "T"]:
    """Logarithm of w_t of one sequence, which may hold several trajectories."""
    if weighting == "first_order":
        return log_ratio_t
    rows = jnp.arange(len(log_ratio_t))
    begins = jnp.concatenate([jnp.ones_like(cut_t[:1]), cut_t[:-1]])
    start = jax.lax.cummax(jnp.where(begins, rows, 0))
    total = jnp.cumsum(log_ratio_t)
    past = total - (total - log_ratio_t)[start]
    if weighting == "per_decision":
        return past
    end = jax.lax.cummin(jnp.where(cut_t.at[-1].set(True), rows, len(rows)), reverse=True)
    return past[end]
