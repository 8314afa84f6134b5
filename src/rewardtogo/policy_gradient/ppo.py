"""PPO: proximal policy optimisation (chapter 7; Schulman et al. 2017), clipped or with a penalty on the KL divergence.

Maximises, over a few epochs on the same rollout of the policy pi_old,

    E[min(rho A, clip(rho, 1 - eps, 1 + eps) A)] + c_H E[H(pi)] - c_V E[1/2 (V - y)^2],      rho = pi(a|s) / pi_old(a|s),

or with E[rho A] - lambda E[KL(pi_old || pi)] for its first term (7.2.3). There lambda is doubled and halved to keep the divergence within a
factor of 1.5 of eps (`adaptive_kl`), or is the multiplier of dual gradient descent (`dual_kl`, with the projection of erratum E7.7),

    lambda <- max(0, lambda + alpha (KL - eps)),

the KL estimated by the mean of rho - 1 - log rho, which is never negative. A is from GAE (item 4.33) and y = A + V. `terminated` ends
a return, `truncated` bootstraps from `next_observation` (erratum E1.5).

Deviations from the paper, as is now usual: advantages are normalised in each minibatch, gradients are clipped by their global norm,
actor and critic are two networks with orthogonal initialisation (Andrychowicz et al. 2021), Adam's epsilon is 1e-5. The remainder
of a rollout that does not divide into minibatches is left out, a different one each epoch.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ..core import (
    EnvSpec,
    Learner,
    Number,
    PRNGKey,
    Rollout,
    number,
    part,
    require_action,
    setting,
)
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
    require_fresh,
)
from ..ops.advantages import normalise
from ..ops.metrics import explained_variance
from ..ops.shuffle import permutations
from .fit import Samples, minibatch_size, samples_of


class PPOState(eqx.Module):
    """Networks, optimiser, what observations look like, the weight of the KL penalty, and the number of updates done."""

    network: ActorCritic
    optimiser: optax.OptState
    norm: RunningNorm | None
    multiplier: Float[Array, ""]
    updates: Int[Array, ""]


class PPO(Learner):
    """Proximal policy optimisation. Any action space but dictionaries; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64), "recipe of the actor's and of the critic's network", converter=as_network)
    learning_rate: Number = number(3e-4, "Adam's step size", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    gae_lambda: Number = number(
        0.95, "weight of long returns in GAE: 0 is the TD error, 1 is Monte Carlo", at_least=0, at_most=1
    )
    objective: Literal["clip", "adaptive_kl", "dual_kl"] = setting(
        "clip", "what keeps the policy near the old one", choices=("clip", "adaptive_kl", "dual_kl")
    )
    target_kl: Number = number(0.01, "eps: KL divergence that a penalty aims at", above=0)
    multiplier: Number = number(1.0, "lambda: the penalty's weight in the beginning", at_least=0)
    dual_rate: Number = number(0.5, "alpha eps: step of dual gradient descent, for a divergence of twice eps", above=0)
    clip: Number = number(0.2, "eps: how far the ratio may move before its gradient is cut", above=0)
    entropy_cost: Number = number(0.0, "c_H: weight of the entropy bonus", at_least=0)
    value_cost: Number = number(0.5, "c_V: weight of the value loss", at_least=0)
    max_grad_norm: Number = number(0.5, "gradients are scaled down to this global norm", above=0)
    epochs: int = setting(4, "passes over each rollout", at_least=1)
    minibatches: int = setting(4, "gradient steps a pass; with a memory each takes whole sequences", at_least=1)
    bptt: int = setting(
        32, "steps that gradients flow back through a memory: rollouts are cut into such pieces", at_least=1
    )
    normalise_advantages: bool = setting(True, "mean 0, sd 1 in each minibatch")
    log_std: Number = number(0.0, "log standard deviation that a Gaussian policy begins with, in units of half the box")
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    def init(self, spec: EnvSpec, key: PRNGKey) -> PPOState:
        require_action("PPO", spec, self.action_kinds)
        network = ActorCritic.of(self.network, spec, key, log_std=self.at(0).log_std)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        multiplier = jnp.asarray(self.at(0).multiplier, jnp.float32)
        return PPOState(network, self._optimiser().init(network), norm, multiplier, jnp.zeros((), jnp.int32))

    def policy(self, state: PPOState, explore: bool) -> ActorCriticPolicy:
        return ActorCriticPolicy(state.network, state.norm, explore, state.updates)

    def update(self, state: PPOState, batch: Rollout, key: PRNGKey) -> tuple[PPOState, dict[str, Array], tuple[()]]:
        require_fresh(batch.transitions, state.updates, "PPO")
        now = self.at(state.updates)
        samples = samples_of(
            state.network, state.norm, batch, now.gamma, now.gae_lambda, normalised=False, bptt=self.bptt
        )
        size = len(samples.log_prob)
        per_minibatch = minibatch_size(size, self.minibatches, state.network.recurrent)

        def minibatch(
            loop: tuple[ActorCritic, optax.OptState], rows: Int[Array, "M"]
        ) -> tuple[tuple[ActorCritic, optax.OptState], dict[str, Array]]:
            network, optimiser = loop
            chosen = samples if self.minibatches == 1 else jax.tree.map(lambda x: x[rows], samples)
            gradient, metrics = jax.grad(now._loss, has_aux=True)(network, chosen, state.multiplier)
            return now._optimiser().step(network, gradient, optimiser), metrics | {"grad_norm": global_norm(gradient)}

        used = self.minibatches * per_minibatch
        # One minibatch is the whole rollout, in whatever order: nothing is shuffled.
        whole = jnp.broadcast_to(jnp.arange(size), (self.epochs, size))
        shuffled = whole if self.minibatches == 1 else permutations(key, self.epochs, size)[:, :used]
        loop = (state.network, state.optimiser)
        (network, optimiser), metrics = jax.lax.scan(minibatch, loop, shuffled.reshape(-1, per_minibatch))
        # Statistics change after the update, so that the ratio starts at exactly 1.
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        metrics = jax.tree.map(jnp.mean, metrics) | {
            "explained_variance": explained_variance(samples.value, samples.target)
        }
        multiplier = state.multiplier
        if self.objective != "clip":
            kl = now._loss(network, samples, multiplier)[1]["approx_kl"]
            multiplier = now._next_multiplier(multiplier, kl)
            metrics |= {"kl": kl, "multiplier": multiplier}
        return PPOState(network, optimiser, norm, multiplier, state.updates + 1), metrics, ()

    def _next_multiplier(self, multiplier: Float[Array, ""], kl: Float[Array, ""]) -> Float[Array, ""]:
        """Lambda for the next rollout, from the divergence that this one's led to."""
        if self.objective == "dual_kl":
            return jnp.maximum(0.0, multiplier + self.dual_rate * (kl / self.target_kl - 1.0))
        factor = jnp.where(kl > 1.5 * self.target_kl, 2.0, jnp.where(kl < self.target_kl / 1.5, 0.5, 1.0))
        return jnp.clip(multiplier * factor, 1e-6, 1e6)

    def _loss(self, network: ActorCritic, s: Samples, multiplier: Float[Array, ""]) -> tuple[Array, dict[str, Array]]:
        log_prob, entropy, value = jax.vmap(lambda *step: network.evaluate(*step))(
            s.carry, s.observation, s.action, s.done
        )
        advantage = normalise(s.advantage) if self.normalise_advantages else s.advantage
        log_ratio = log_prob - s.log_prob
        ratio = jnp.exp(log_ratio)
        kl = (ratio - 1.0 - log_ratio).mean()
        if self.objective == "clip":
            clipped = jnp.clip(ratio, 1.0 - self.clip, 1.0 + self.clip)
            policy_loss = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
        else:
            policy_loss = -(ratio * advantage).mean() + multiplier * kl
        value_loss = 0.5 * ((value - s.target) ** 2).mean()
        entropy = entropy.mean()
        loss = policy_loss + self.value_cost * value_loss - self.entropy_cost * entropy
        return loss, {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "entropy": entropy,
            "approx_kl": kl,
            "clip_fraction": (jnp.abs(ratio - 1.0) > self.clip).mean(),
        }

    def _optimiser(self) -> Optimiser:
        return Optimiser(self.learning_rate, self.max_grad_norm, eps=1e-5)
