"""BC: behavioural cloning, the expert's actions learnt as in supervised learning (chapter 2; Pomerleau 1989).

Minimises over batches of an expert's data, with c_H the weight of an entropy bonus,

    nll   -mean log pi(a* | o) - c_H mean H(pi(. | o))         cross-entropy for choices, Gaussian likelihood for boxes
    mse    mean ((a* - mu(o)) / h)^2,    h half the box        boxes only; equal to nll where the spread is fixed

where pi is what the head makes of the network's features: the usual law of the space, or one with several peaks (`nn/heads.py`;
of a head with a hidden variable, log pi is replaced by its lower bound),

and acts by sampling from pi (`mse`: by mu) to explore, otherwise by its mode. Where noise was put on a demonstrator's
actions, a* is what it chose, not what was done (`extras["expert_action"]`). A network with a memory learns from windows
of consecutive steps, its memory reset at the end of each episode inside.

Data without noise has no greatest likelihood: the standard deviation goes to 0 and the density to infinity. It is kept
at `min_std` times h or above. Weight decay is decoupled (AdamW, Loshchilov and Hutter 2019).
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Key

from ..core import (
    Action,
    Batch,
    EnvSpec,
    Learner,
    Number,
    Observation,
    PRNGKey,
    Schedule,
    Transition,
    number,
    part,
    require_action,
    setting,
)
from ..data.noise import EXPERT
from ..nn import MLP, Network, RunningNorm, action_mask, as_network
from ..nn.actor import ActorNetwork, StochasticPolicy
from ..nn.heads import ActionHead, HeadRecipe, Standard, half_width
from ..nn.optimise import Optimiser, global_norm
from ..ops.distributions import Distribution


class BCState(eqx.Module):
    """Network, optimiser, what observations look like, and the number of updates done."""

    network: ActorNetwork
    optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class Fit(eqx.Module):
    """How well the policy explains an expert's actions, by sample: `[N]`, or `[T, N]` in sequences.

    - `loss`: what the head minimises, -log pi or a bound above it.
    - `entropy`: of the policy; where it has no closed form, -log pi of one sample.
    - `agreement`: how many entries of the likeliest action are the expert's, from 0 to 1; 0 in boxes.
    - `square`: squared distance of the likeliest action in units of half the box, mean over entries; 0 for choices.
    """

    loss: Float[Array, "*N"]
    entropy: Float[Array, "*N"]
    agreement: Float[Array, "*N"]
    square: Float[Array, "*N"]


class BC(Learner):
    """Behavioural cloning. Any action space but dictionaries; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64), "recipe of the policy's network", converter=as_network)
    head: HeadRecipe = part(Standard(), "law of the action: standard, mixture, autoregressive or latent")
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    entropy_cost: Number = number(0.0, "c_H: weight of the entropy bonus, for nll", at_least=0)
    weight_decay: Number = number(0.0, "AdamW's pull of every parameter towards 0", at_least=0)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)
    min_std: Number = number(0.01, "least standard deviation of a Gaussian, in units of half the box", above=0)
    loss: str = setting("nll", "likelihood (nll), or squared error of the mean (mse, boxes)", choices=("nll", "mse"))
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    @property
    def batch(self) -> Literal["transitions", "sequences"]:
        return "sequences" if self.network.has_memory else "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return self.head.action_kinds

    def init(self, spec: EnvSpec, key: PRNGKey) -> BCState:
        require_action("BC", spec, self.action_kinds)
        if self.loss == "mse" and spec.action.kind != "box":
            raise ValueError(f"a squared error needs actions that are boxes, and these are {spec.action.kind}: use nll")
        if self.loss == "mse" and not isinstance(self.head, Standard):
            raise ValueError("a squared error is that of one mean, which this head does not have: use nll")
        if not isinstance(self.head, Standard) and self._has_bonus():
            raise ValueError(
                "an entropy bonus needs a law whose entropy is known: use the head standard, or entropy_cost 0"
            )
        network = ActorNetwork.of(self.network, spec, key, self.head)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        zero = jnp.zeros((), jnp.int32)
        return BCState(network, self.at(zero)._optimiser().init(network), norm, zero)

    def policy(self, state: BCState, explore: bool) -> StochasticPolicy:
        return StochasticPolicy(state.network, state.norm, explore and self.loss == "nll")

    def update(self, state: BCState, batch: Batch, key: PRNGKey) -> tuple[BCState, dict[str, Array], tuple[()]]:
        t = batch.transitions
        norm = None if state.norm is None else state.norm.update(t.observation)
        now = self.at(state.updates)

        def loss(network: ActorNetwork) -> tuple[Array, Fit]:
            fit = explain(network, norm, t, key)
            by_step = fit.square if self.loss == "mse" else fit.loss - now.entropy_cost * fit.entropy
            by_sample = by_step if by_step.ndim == 1 else by_step.mean(0)
            return (batch.weights * by_sample).mean(), fit

        (value, fit), gradient = jax.value_and_grad(loss, has_aux=True)(state.network)
        network, optimiser = now._optimiser().step(state.network, gradient, state.optimiser)
        decay = now.learning_rate * now.weight_decay
        network = jax.tree.map(lambda new, old: new - decay * old, network, state.network)
        network = eqx.tree_at(lambda n: n.head, network, network.head.with_least_std(self.min_std))
        metrics = {"bc_loss": value, "entropy": fit.entropy.mean(), "grad_norm": global_norm(gradient)}
        if network.head.spec.kind == "box":
            metrics["mse"] = fit.square.mean()
        else:
            metrics["accuracy"] = fit.agreement.mean()
        return BCState(network, optimiser, norm, state.updates + 1), metrics, ()

    def _has_bonus(self) -> bool:
        """Whether there is an entropy bonus, as far as can be known while tracing."""
        cost = self.entropy_cost
        return isinstance(cost, Schedule) or (not isinstance(cost, Tracer) and bool(np.any(np.asarray(cost) != 0.0)))

    def _optimiser(self) -> Optimiser:
        return Optimiser(self.learning_rate, self.max_grad_norm)


def explain(network: ActorNetwork, norm: RunningNorm | None, t: Transition, key: PRNGKey) -> Fit:
    """How well a policy explains an expert's transitions `[N]`, or with a memory sequences `[T, N]`.

    `key` is for heads whose loss is itself a sample.
    """
    action = t.extras.get(EXPERT, t.action)
    standard = (lambda x: x) if norm is None else norm
    keys = jax.random.split(key, t.reward.shape)

    def compare(features: Array, observation: Observation, action: Action, key: PRNGKey) -> Fit:
        mask = action_mask(observation)
        loss_key, sample_key = jax.random.split(key)
        loss = network.head.loss(features, action, loss_key, mask)
        law = network.head(features, mask)
        known = isinstance(network.head, ActionHead)
        entropy = law.entropy() if known else -jax.lax.stop_gradient(law.sample_and_log_prob(sample_key)[1])
        return Fit(loss, entropy, *_distance(law, action, half_width(network.head.spec)))

    if not network.recurrent:
        features = lambda o: network.torso(network.init(), standard(o))[1]  # noqa: E731
        return jax.vmap(lambda o, a, k: compare(features(o), o, a, k))(t.observation, action, keys)

    def sequence(t: Transition, action: Action, keys: Key[Array, "T"]) -> Fit:
        first = jax.tree.map(lambda x: x[0], t.extras["carry"])
        features = network.features_along(first, jax.vmap(standard)(t.observation), t.done)
        return jax.vmap(compare)(features, t.observation, action, keys)

    return jax.vmap(sequence, in_axes=1, out_axes=1)(t, action, keys)


def _distance(law: Distribution, action: Action, unit: np.ndarray) -> tuple[Array, Array]:
    """Agreement and squared distance of the likeliest action and the expert's."""
    likeliest = law.mode()
    if jnp.issubdtype(likeliest.dtype, jnp.integer):
        return (likeliest == action).astype(jnp.float32).mean(), jnp.zeros(())
    return jnp.zeros(()), jnp.square((likeliest - action) / unit).mean()
