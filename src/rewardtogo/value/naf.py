r"""NAF: normalised advantage functions (notes 6.3.3, option 2; Gu et al. 2016): a Q that is easy to maximise.

    Q(s, a) = V(s) - 1/2 (a - mu(s))^T L(s) L(s)^T (a - mu(s)),      L lower triangular, its diagonal an exponential        (erratum E6.7)
    y       = r + gamma (1 - terminated) V'(s')
    phi     down the mean of (Q(s, a) - y)^2 / 2

L L^T is positive definite, so that argmax_a Q = mu(s) and max_a Q = V(s), exactly. The notes name the method and write nothing down.
One torso has three heads: V, mu and the entries of L. mu is squashed into the box by tanh where the box is bounded, and free where it
is not. It acts by mu(s) with noise; networks with a memory learn from sequences.

With errors far beyond 1, all of mu, L and V run in one direction at first, and mu may end at a bound, where tanh has no derivative. So the
network's outputs are in units of `value_scale` rewards; Q and all that is reported are in rewards, the loss in squares of the unit.

Deviations from the paper: no batch normalisation, one update a step, and no imagination rollouts (which need a model, chapter 10).
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
    Carry,
    EnvSpec,
    Learner,
    Number,
    Observation,
    Policy,
    PRNGKey,
    Spec,
    Transition,
    number,
    part,
    setting,
)
from ..nn import MLP, Linear, Network, Optimiser, RunningNorm, Torso, as_network, global_norm
from ..nn.optimise import towards
from ..ops.axes import over
from .continuous import Memories, Sample, require_short
from .critics import SMALL, features_along, from_units, require_box
from .noise import Gaussian, Noise, Noisy, as_noise

MOST_LOG_DIAGONAL = 5.0
"""The diagonal of L is at most the exponential of this."""


class Quadratic(eqx.Module):
    """Q(s, .) of one observation, in units of the box: its largest value, where it lies, and L."""

    value: Float[Array, ""]
    mean: Float[Array, "A"]
    factor: Float[Array, "A A"]

    def times(self, scale: Number) -> "Quadratic":
        """The same function times `scale`."""
        return Quadratic(scale * self.value, self.mean, jnp.sqrt(scale) * self.factor)

    def __call__(self, units: Float[Array, "A"]) -> Float[Array, ""]:
        """Q of an action."""
        return self.value - 0.5 * jnp.sum(jnp.square((units - self.mean) @ self.factor))


class NAFNetwork(eqx.Module):
    """A torso and the three heads."""

    torso: Torso
    value_head: Linear
    mean_head: Linear
    factor_head: Linear
    bounded: tuple[bool, ...] = eqx.field(static=True)

    @staticmethod
    def of(network: Network, spec: EnvSpec, key: PRNGKey) -> "NAFNetwork":
        """Fresh parameters."""
        torso_key, *keys = jax.random.split(key, 4)
        torso, size = network.build(spec.observation, torso_key), spec.action.size
        head = lambda outputs, key: Linear.of(torso.features, outputs, key, gain=SMALL)  # noqa: E731
        value, mean, factor = head(1, keys[0]), head(size, keys[1]), head(size * (size + 1) // 2, keys[2])
        low, high = spec.action.bounds()
        bounded = tuple(bool(b) for b in (np.isfinite(low) & np.isfinite(high)).ravel())
        return NAFNetwork(torso, value, mean, factor, bounded)

    def read(self, features: Float[Array, "F"]) -> Quadratic:
        """Q(s, .) from the torso's features."""
        outputs = self.mean_head(features)
        mean = jnp.where(np.asarray(self.bounded), jnp.tanh(outputs), outputs)
        rows, columns = np.tril_indices(len(self.bounded))
        entries = self.factor_head(features)
        entries = jnp.where(rows == columns, jnp.exp(jnp.minimum(entries, MOST_LOG_DIAGONAL)), entries)
        factor = jnp.zeros((len(self.bounded),) * 2).at[rows, columns].set(entries)
        return Quadratic(self.value_head(features)[0], mean, factor)

    def along(self, carry: Carry, t: Transition) -> tuple[Quadratic, Quadratic]:
        """Q(s, .) at every observation and every `next_observation`."""
        now, following = features_along(self.torso, carry, t)
        read = over(t.reward.ndim, self.read)
        return read(now), read(following)


class NAFState(eqx.Module):
    """Network and target, the optimiser, what observations look like, and the number of updates done."""

    network: NAFNetwork
    target: NAFNetwork
    optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]
    spec: Spec = eqx.field(static=True)


class QuadraticPolicy(Policy):
    """mu(s)."""

    network: NAFNetwork
    norm: RunningNorm | None
    scale: Float[Array, ""]
    spec: Spec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return Memories(self.network.torso.init(), ())

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        del key
        memory, q = self._look(carry, observation)
        return Memories(memory, ()), from_units(self.spec, q.mean.reshape(self.spec.shape)), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        _, q = self._look(carry, observation)
        return {"value": q.value, "mean": from_units(self.spec, q.mean.reshape(self.spec.shape))}

    def _look(self, carry: Carry, observation: Observation) -> tuple[Carry, Quadratic]:
        observation = observation if self.norm is None else self.norm(observation)
        memory, features = self.network.torso(carry.actor, observation)
        return memory, self.network.read(features).times(self.scale)


class NAF(Learner):
    """Normalised advantage functions. Actions in a box, bounded or not; any observation; networks with or without a memory."""

    network: Network = part(MLP(256, 256, activation="relu"), "recipe of the network", converter=as_network)
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    value_scale: Number = number(
        1.0, "rewards that 1 of the network's outputs stands for: about how far returns spread", above=0
    )
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    target_rate: Number = number(0.005, "tau: how far the target moves towards the network", above=0, at_most=1)
    noise: Noise = part(Gaussian(0.2), "noise on the actions while learning", converter=as_noise)
    n_step: int = setting(1, "rewards in a target; more come from sequences of at least as many steps", at_least=1)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    def __check_init__(self) -> None:
        require_short(self.network, self.n_step)

    @property
    def batch(self) -> Literal["transitions", "sequences"]:
        return "sequences" if self.network.has_memory or self.n_step > 1 else "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("box",)

    def init(self, spec: EnvSpec, key: PRNGKey) -> NAFState:
        require_box("NAF", spec, bounded=False)
        network = NAFNetwork.of(self.network, spec, key)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        optimiser = Optimiser(0.0, 1.0).init(network)
        return NAFState(network, network, optimiser, norm, jnp.zeros((), jnp.int32), spec.action)

    def policy(self, state: NAFState, explore: bool) -> Policy:
        now = self.at(state.updates)
        policy = QuadraticPolicy(state.network, state.norm, jnp.asarray(now.value_scale, jnp.float32), state.spec)
        return Noisy.of(policy, now.noise, state.spec) if explore else policy

    def update(
        self, state: NAFState, batch: Batch, key: PRNGKey
    ) -> tuple[NAFState, dict[str, Array], Float[Array, "N"]]:
        del key
        now = self.at(state.updates)
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        sample = Sample.of(batch, state.spec, norm, now.gamma, self.n_step)
        following = state.target.along(sample.memory.actor, sample.t)[1]
        # Everything in units of the scale, targets too, so that the loss is as large as the network's outputs are.
        y = sample.t.reward / now.value_scale + sample.discount * following.value
        units = sample.units.reshape(*sample.t.reward.shape, -1)

        def loss(network: NAFNetwork) -> tuple[Array, tuple[Array, Array]]:
            q, _ = network.along(sample.memory.actor, sample.t)
            found = over(sample.axes, lambda q, units: q(units))(q, units)
            square = sample.by_sample(0.5 * jnp.square(found - y))
            return (sample.weights * square).mean(), (found, q.value)

        (lost, (found, value)), gradient = jax.value_and_grad(loss, has_aux=True)(state.network)
        rule = Optimiser(now.learning_rate, now.max_grad_norm)
        network, optimiser = rule.step(state.network, gradient, state.optimiser)
        found, value, error = (now.value_scale * x for x in (found, value, jnp.abs(found - y)))
        metrics = {
            "q_loss": lost,
            "q_mean": found.mean(),
            "td_error": error.mean(),
            "grad_norm": global_norm(gradient),
            "advantage": (found - value).mean(),
            "saturation": jnp.abs(following.mean).mean(),
        }
        target = towards(state.target, network, now.target_rate)
        state = NAFState(network, target, optimiser, norm, state.updates + 1, state.spec)
        return state, metrics, sample.by_sample(error)
