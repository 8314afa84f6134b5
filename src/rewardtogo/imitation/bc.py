"""BC: behavioural cloning, the expert's actions learnt as in supervised learning (chapter 2; Pomerleau 1989).

Minimises over batches of an expert's data, with c_H the weight of an entropy bonus,

    nll   -mean log pi(a* | o) - c_H mean H(pi(. | o))         cross-entropy for choices, Gaussian likelihood for boxes
    mse    mean ((a* - mu(o)) / h)^2,    h half the box        boxes only; equal to nll where the spread is fixed

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
from jaxtyping import Array, Float, Int

from ..core import (
    Action,
    Batch,
    EnvSpec,
    Learner,
    Number,
    PRNGKey,
    Transition,
    number,
    part,
    require_action,
    setting,
)
from ..data.noise import EXPERT
from ..nn import ACTION_KINDS, MLP, Network, RunningNorm, as_network
from ..nn.actor import ActorNetwork, StochasticPolicy
from ..nn.heads import half_width
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

    - `agreement`: how many entries of the likeliest action are the expert's, from 0 to 1; 0 in boxes.
    - `square`: squared distance of the likeliest action in units of half the box, mean over entries; 0 for choices.
    """

    log_prob: Float[Array, "*N"]
    entropy: Float[Array, "*N"]
    agreement: Float[Array, "*N"]
    square: Float[Array, "*N"]


class BC(Learner):
    """Behavioural cloning. Any action space but dictionaries; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64), "recipe of the policy's network", converter=as_network)
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
        return ACTION_KINDS

    def init(self, spec: EnvSpec, key: PRNGKey) -> BCState:
        require_action("BC", spec, self.action_kinds)
        if self.loss == "mse" and spec.action.kind != "box":
            raise ValueError(f"a squared error needs actions that are boxes, and these are {spec.action.kind}: use nll")
        network = ActorNetwork.of(self.network, spec, key)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        zero = jnp.zeros((), jnp.int32)
        return BCState(network, self.at(zero)._optimiser().init(network), norm, zero)

    def policy(self, state: BCState, explore: bool) -> StochasticPolicy:
        return StochasticPolicy(state.network, state.norm, explore and self.loss == "nll")

    def update(self, state: BCState, batch: Batch, key: PRNGKey) -> tuple[BCState, dict[str, Array], tuple[()]]:
        del key
        t = batch.transitions
        norm = None if state.norm is None else state.norm.update(t.observation)
        now = self.at(state.updates)

        def loss(network: ActorNetwork) -> tuple[Array, Fit]:
            fit = explain(network, norm, t)
            by_step = fit.square if self.loss == "mse" else -fit.log_prob - now.entropy_cost * fit.entropy
            by_sample = by_step if by_step.ndim == 1 else by_step.mean(0)
            return (batch.weights * by_sample).mean(), fit

        (value, fit), gradient = jax.value_and_grad(loss, has_aux=True)(state.network)
        network, optimiser = now._optimiser().step(state.network, gradient, state.optimiser)
        decay = now.learning_rate * now.weight_decay
        network = now._with_floor(jax.tree.map(lambda new, old: new - decay * old, network, state.network))
        metrics = {"bc_loss": value, "entropy": fit.entropy.mean(), "grad_norm": global_norm(gradient)}
        if network.head.spec.kind == "box":
            metrics["mse"] = fit.square.mean()
        else:
            metrics["accuracy"] = fit.agreement.mean()
        return BCState(network, optimiser, norm, state.updates + 1), metrics, ()

    def _with_floor(self, network: ActorNetwork) -> ActorNetwork:
        if network.head.spec.kind != "box":
            return network
        floor = jnp.log(self.min_std * half_width(network.head.spec))
        return eqx.tree_at(lambda n: n.head.log_std, network, jnp.maximum(network.head.log_std, floor))

    def _optimiser(self) -> Optimiser:
        return Optimiser(self.learning_rate, self.max_grad_norm)


def explain(network: ActorNetwork, norm: RunningNorm | None, t: Transition) -> Fit:
    """How well a policy explains an expert's transitions `[N]`, or with a memory sequences `[T, N]`."""
    action = t.extras.get(EXPERT, t.action)
    standard = (lambda x: x) if norm is None else norm
    compare = lambda d, a: _compare(d, a, half_width(network.head.spec))  # noqa: E731
    if not network.recurrent:
        one = lambda o, a: compare(network(network.init(), standard(o))[1], a)  # noqa: E731
        return jax.vmap(one)(t.observation, action)

    def sequence(t: Transition, action: Action) -> Fit:
        first = jax.tree.map(lambda x: x[0], t.extras["carry"])
        return jax.vmap(compare)(network.along(first, jax.vmap(standard)(t.observation), t.done), action)

    return jax.vmap(sequence, in_axes=1, out_axes=1)(t, action)


def _compare(distribution: Distribution, action: Action, unit: np.ndarray) -> Fit:
    likeliest = distribution.mode()
    if jnp.issubdtype(likeliest.dtype, jnp.integer):
        agreement, square = (likeliest == action).astype(jnp.float32).mean(), jnp.zeros(())
    else:
        agreement, square = jnp.zeros(()), jnp.square((likeliest - action) / unit).mean()
    return Fit(distribution.log_prob(action), distribution.entropy(), agreement, square)
