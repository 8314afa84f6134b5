r"""What Q-learners with continuous actions share: batches made ready, the regression of critics, targets that follow, greedy acting.

    critics   phi <- phi - alpha grad of mean_j sum_e (Q_e(s_j, a_j) - y_j)^2 / 2                    (Algorithm 14, step 5)
    actor     theta <- theta + beta mean_j (dmu/dtheta)^T dQ/da at a = mu(s_j)                        (step 6, erratum E6.6)
    targets   phi' <- (1 - tau) phi' + tau phi, after each update                                     (step 7)

tau is `target_rate`, the part of the way that a target goes, as in `dqn`; the notes' tau is the part that is *kept* (erratum E6.1).

Source: notes 6.3.3; Lillicrap et al. 2016; Fujimoto et al. 2018.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ..core import Action, Batch, Carry, EnvSpec, Number, Observation, Policy, PRNGKey, Spec, Transition
from ..data.n_step import DISCOUNT, n_step_windows
from ..nn import Network, Optimiser, RunningNorm, global_norm
from ..ops.axes import over
from .critics import Actor, Critics, from_units, least, to_units
from .noise import NoisyMemory


def require_short(network: Network, n_step: int) -> None:
    """Raise `ValueError` where a network with a memory is to learn from targets of several steps."""
    if network.has_memory and n_step > 1:
        raise ValueError(
            f"n_step={n_step} takes steps out of their sequence, which a network with a memory needs whole: use n_step=1"
        )


class Memories(eqx.Module):
    """What an actor and its critics remember of an episode."""

    actor: Carry
    critics: Carry


class Sample(eqx.Module):
    """A batch made ready: observations standardised, several steps joined to one, actions in units; and the memories `[N]` before."""

    t: Transition
    units: Float[Array, "..."]
    discount: Float[Array, "*N"]
    weights: Float[Array, "N"]
    memory: Memories

    @staticmethod
    def of(batch: Batch, spec: Spec, norm: RunningNorm | None, gamma: Number, n_step: int) -> "Sample":
        """`batch` as a learner needs it."""
        t, memory = batch.transitions, Memories((), ())
        if norm is not None:
            standard = over(t.reward.ndim, norm)
            both = standard(t.observation), standard(t.next_observation)
            t = eqx.tree_at(lambda t: (t.observation, t.next_observation), t, both)
        if "carry" in t.extras:
            # Of sequences: what whoever acted remembered before the first step. Several steps joined to one need no memory.
            carry = t.extras["carry"]
            carry = carry.policy if isinstance(carry, NoisyMemory) else carry
            memory = jax.tree.map(lambda x: x[0], carry)
            t = dataclasses.replace(t, extras={k: x for k, x in t.extras.items() if k != "carry"})
        if n_step > 1:
            t = n_step_windows(t, n_step, gamma)
        discount = t.extras.get(DISCOUNT, gamma * (1.0 - t.terminated))
        return Sample(t, to_units(spec, t.action), discount, batch.weights, memory)

    @property
    def axes(self) -> int:
        """Leading axes: 1 of transitions, 2 of sequences."""
        return self.t.reward.ndim

    def by_sample(self, x: Float[Array, "*N"]) -> Float[Array, "N"]:
        """The mean over time where there is any."""
        return x if x.ndim == 1 else x.mean(0)


class Fit(eqx.Module):
    """Critics after a step of their regression, the optimiser's state, what to report, and the errors before it by sample."""

    critics: Critics
    optimiser: optax.OptState
    metrics: dict[str, Array]
    errors: Float[Array, "N"]


def fit_critics(
    critics: Critics, optimiser: optax.OptState, rule: Optimiser, sample: Sample, y: Float[Array, "*N"]
) -> Fit:
    """One step down the squared errors of all critics against the same targets."""

    def loss(critics: Critics) -> tuple[Array, Array]:
        q = critics(critics.see_along(sample.memory.critics, sample.t)[0], sample.units)
        squares = jax.vmap(sample.by_sample)(0.5 * jnp.square(q - y[None]))
        return (sample.weights[None] * squares).mean(1).sum(), q

    (value, q), gradient = jax.value_and_grad(loss, has_aux=True)(critics)
    errors = jnp.abs(q - y[None]).mean(0)
    critics, optimiser = rule.step(critics, gradient, optimiser)
    metrics = {
        "q_loss": value / critics.number,
        "q_mean": q.mean(),
        "td_error": errors.mean(),
        "grad_norm": global_norm(gradient),
    }
    return Fit(critics, optimiser, metrics, sample.by_sample(errors))


def deterministic(outputs: Float[Array, "..."], axes: int) -> Float[Array, "..."]:
    """Actions in units of the box from the one output of an actor, behind `axes` leading axes."""
    return jnp.tanh(outputs[(slice(None),) * axes + (0,)])


def improve_actor(
    actor: Actor, critics: Critics, optimiser: optax.OptState, rule: Optimiser, sample: Sample
) -> tuple[Actor, optax.OptState, Float[Array, ""]]:
    """One step up the mean of Q_1(s, mu(s)): the actor, the optimiser's state, and minus that mean before the step.

    The derivative of Q is taken at the actor's own actions, not at those of the batch (erratum E6.6).
    """
    judge = critics.first()
    seen, _ = judge.see_along(jax.tree.map(lambda x: x[:, :1], sample.memory.critics), sample.t)

    def loss(actor: Actor) -> Array:
        outputs, _ = actor.along(sample.memory.actor, sample.t)
        return -judge(seen, deterministic(outputs, sample.axes)).mean()

    value, gradient = jax.value_and_grad(loss)(actor)
    actor, optimiser = rule.step(actor, gradient, optimiser)
    return actor, optimiser, value


class DeterministicState(eqx.Module):
    """Actor and critics, the targets that follow them, two optimisers, what observations look like, and the number of updates done."""

    actor: Actor
    critics: Critics
    target_actor: Actor
    target_critics: Critics
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]
    spec: Spec = eqx.field(static=True)

    @staticmethod
    def of(network: Network, number: int, normalise: bool, spec: EnvSpec, key: PRNGKey) -> "DeterministicState":
        """Fresh networks, `number` critics among them; targets are equal to them."""
        actor_key, critic_key = jax.random.split(key)
        actor, critics = Actor.of(network, spec, actor_key), Critics.of(network, spec, critic_key, number)
        rule = Optimiser(0.0, 1.0)
        norm = RunningNorm.of(spec.observation) if normalise else None
        return DeterministicState(
            actor,
            critics,
            actor,
            critics,
            rule.init(actor),
            rule.init(critics),
            norm,
            jnp.zeros((), jnp.int32),
            spec.action,
        )


class GreedyActor(Policy):
    """tanh of the actor's one output, in units of the box; knows what the critics think of it."""

    actor: Actor
    critics: Critics
    norm: RunningNorm | None
    spec: Spec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return Memories(self.actor.init(), self.critics.init())

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        del key
        observation = observation if self.norm is None else self.norm(observation)
        memory, output = self.actor(carry.actor, observation)
        carry = Memories(memory, self.critics.remember(carry.critics, observation))
        return carry, from_units(self.spec, deterministic(output, 0)), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        observation = observation if self.norm is None else self.norm(observation)
        units = deterministic(self.actor(carry.actor, observation)[1], 0)
        value = least(self.critics(self.critics.see(carry.critics, observation), units))
        return {"value": value, "mean": from_units(self.spec, units)}
