"""What the natural gradient methods share beside the step: samples of a rollout, the surrogate, and the fit of the value function.

    surrogate(theta') = E[pi'(a|s) / pi(a|s) A(s, a)] + c_H E[H(pi')],        value loss = E[1/2 (V - y)^2],

with A from GAE (item 4.33) and y = A + V. The surrogate's gradient at theta is the policy gradient (item 7.21). `terminated` ends a
return, `truncated` bootstraps from `next_observation` (erratum E1.5).
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..core import Action, Carry, Number, Observation, PRNGKey, Rollout
from ..nn import ActorCritic, Optimiser, RunningNorm, Torso, action_mask, piece_length, pieces, unroll
from ..nn.network import Linear
from ..ops.advantages import gae, normalise
from ..ops.distributions import Distribution
from ..ops.shuffle import permutations

Tree = TypeVar("Tree")
Critic = tuple[Torso | None, Linear]
"""The parameters that the value function depends on: the torso, and the head that reads it."""


class Samples(eqx.Module):
    """A rollout as it is learned from: single steps `[N]`, in the order of time, or with a memory sequences `[N, L]`.

    - `observation`: standardised, where that is wanted.
    - `value`: what the critic said when the rollout came in.
    - `carry`: both memories before the first step of each sequence, `[N]`; `()` without a memory.
    """

    observation: Observation
    action: Action
    log_prob: Float[Array, "..."]
    advantage: Float[Array, "..."]
    value: Float[Array, "..."]
    target: Float[Array, "..."]
    done: Bool[Array, "..."]
    carry: Carry


def samples_of(
    network: ActorCritic,
    norm: RunningNorm | None,
    rollout: Rollout,
    gamma: Number,
    gae_lambda: Number,
    normalised: bool,
    bptt: int,
) -> Samples:
    """Advantages (`normalised`: mean 0, sd 1) and targets of a rollout, arranged for the network.

    With a memory the rollout is cut into sequences of at most `bptt` steps.
    """
    t = rollout.transitions
    standardise = (lambda x: x) if norm is None else norm
    value, next_value = network.values(rollout, standardise)
    advantage = jax.vmap(gae, in_axes=(1, 1, 1, 1, None, 1), out_axes=1)(
        t.reward, gamma * (1.0 - t.terminated), value, next_value, gae_lambda, t.done
    )
    target = advantage + value
    advantage = normalise(advantage) if normalised else advantage
    observation = jax.vmap(jax.vmap(standardise))(t.observation)
    steps = Samples(observation, t.action, t.extras["log_prob"], advantage, value, target, t.done, ())
    if not network.recurrent:
        return _merge(steps)
    length = piece_length(len(t.reward), bptt)
    carry = jax.tree.map(lambda x: pieces(x, length)[:, 0], network.carries(rollout, standardise))
    return eqx.tree_at(lambda s: s.carry, jax.tree.map(lambda x: pieces(x, length), steps), carry)


def thin(samples: Samples, num_envs: int, every: int) -> Samples:
    """Every so-manieth time step of all environments; with a memory every so-manieth sequence."""
    if samples.done.ndim == 2 or every == 1:
        return jax.tree.map(lambda x: x[::every], samples)
    return _merge(jax.tree.map(lambda x: x.reshape(-1, num_envs, *x.shape[1:])[::every], samples))


def actor_parameters(network: ActorCritic) -> tuple[Float[Array, "P"], Callable[[Float[Array, "P"]], ActorCritic]]:
    """The parameters that the policy depends on as one vector, and how to put such a vector into the network."""
    parts = lambda n: (n.actor, n.head)  # noqa: E731
    flat, unravel = ravel_pytree(parts(network))
    return flat, lambda vector: eqx.tree_at(parts, network, unravel(vector))


def action_laws(network: ActorCritic, samples: Samples) -> Distribution:
    """The distribution of every step's action, with one leading axis over all steps, memory or none."""
    if samples.done.ndim == 1:
        act = lambda o: network.act(network.init()[0], o)[1]  # noqa: E731
        return jax.vmap(act)(samples.observation)

    def sequence(carry: Carry, observation: Observation, done: Bool[Array, "T"]) -> Distribution:
        _, features = unroll(network.actor, carry, observation, done)
        return jax.vmap(lambda x, mask: network.head(x, mask))(features, action_mask(observation))

    return _merge(jax.vmap(sequence)(samples.carry[0], samples.observation, samples.done))


def surrogate(laws: Distribution, samples: Samples, entropy_cost: ScalarLike) -> Float[Array, ""]:
    """E[rho A] + c_H E[H] of the policy whose distributions at the samples are `laws`."""
    steps = (samples.action, samples.log_prob, samples.advantage)
    action, old, advantage = steps if samples.done.ndim == 1 else _merge(steps)
    log_prob = jax.vmap(lambda law, a: law.log_prob(a))(laws, action)
    return (jnp.exp(log_prob - old) * advantage).mean() + entropy_cost * mean_entropy(laws)


def mean_entropy(laws: Distribution) -> Float[Array, ""]:
    """Entropy averaged over N distributions."""
    return jax.vmap(lambda law: law.entropy())(laws).mean()


def critic(network: ActorCritic) -> Critic:
    """Torso and head of the value function, the same as of the network's."""
    return network.critic, network.value_head


def fit_values(
    network: ActorCritic,
    optimiser: optax.OptState,
    adam: Optimiser,
    samples: Samples,
    key: PRNGKey,
    epochs: int,
    minibatches: int,
) -> tuple[ActorCritic, optax.OptState, Float[Array, ""]]:
    """Regress V on the targets, a few epochs in minibatches: network, optimiser (of `critic`), mean loss.

    The remainder that does not divide into minibatches is left out, a different one each epoch.
    """
    size = len(samples.target)
    each = minibatch_size(size, minibatches, network.recurrent)

    def loss(parameters: Critic, s: Samples) -> Float[Array, ""]:
        whole = eqx.tree_at(critic, network, parameters)
        value = jax.vmap(lambda *step: whole.evaluate(*step)[2])(s.carry, s.observation, s.action, s.done)
        return 0.5 * ((value - s.target) ** 2).mean()

    def minibatch(
        loop: tuple[Critic, optax.OptState], rows: Int[Array, "M"]
    ) -> tuple[tuple[Critic, optax.OptState], Float[Array, ""]]:
        parameters, optimiser = loop
        error, gradient = jax.value_and_grad(loss)(parameters, jax.tree.map(lambda x: x[rows], samples))
        return adam.step(parameters, gradient, optimiser), error

    shuffled = permutations(key, epochs, size)[:, : minibatches * each].reshape(-1, each)
    (parameters, optimiser), losses = jax.lax.scan(minibatch, (critic(network), optimiser), shuffled)
    return eqx.tree_at(critic, network, parameters), optimiser, losses.mean()


def minibatch_size(size: int, minibatches: int, recurrent: bool) -> int:
    """Steps (with a memory: sequences) in each minibatch. Raises `ValueError` where there are too few of them."""
    if size < minibatches:
        what = "sequences (a memory needs whole ones)" if recurrent else "steps"
        raise ValueError(
            f"a rollout of {size} {what} cannot make {minibatches} minibatches: "
            f"ask for at most {size} with minibatches={size}, or for more {what.split()[0]}"
        )
    return size // minibatches


def _merge(tree: Tree) -> Tree:
    """The first two axes as one."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tree)
