"""DQN: Q-learning with a replay and a target network (chapter 6, Algorithms 12 and 13; Mnih et al. 2015), double or plain.

Minimises the Huber loss of Q(s, a) - y over batches from the replay, with

    plain   y = r + gamma (1 - terminated) max_a' Q_target(s', a')
    double  y = r + gamma (1 - terminated) Q_target(s', argmax_a' Q(s', a'))            (van Hasselt et al. 2016)

or with the sum of n discounted rewards and the value n steps on (`n_step`; uncorrected, so that exploration in between biases it), and
acts by epsilon-greedy choice. Every `target_period` updates the target moves: Q_target <- (1 - tau) Q_target + tau Q, a hard copy
where tau is 1, Polyak averaging where `target_period` is 1 and tau small. A network with a memory learns from sequences, each
replayed from the memory that was stored when acting.

Deviations from the paper: Adam instead of RMSProp; the loss is Huber's (the paper clips the error's gradient, which is the same);
observations are not preprocessed here.
"""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
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
    Transition,
    number,
    part,
    require_action,
    setting,
)
from ..data.n_step import DISCOUNT, n_step_windows
from ..nn import (
    MLP,
    Linear,
    Network,
    Optimiser,
    RunningNorm,
    Torso,
    action_mask,
    as_network,
    global_norm,
    is_recurrent,
    unroll,
)
from ..ops.schedules import Linear as LinearSchedule
from ..ops.td import double_q_target, huber, q_target

FORBIDDEN = -1e9
"""The Q value of a masked action: finite, so that nothing multiplied by 0 becomes NaN."""


def _over(axes: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one step mapped over `axes` leading axes."""
    for _ in range(axes):
        function = jax.vmap(function)
    return function


class QNetwork(eqx.Module):
    """A torso and one output an action."""

    torso: Torso
    head: Linear

    @staticmethod
    def of(network: Network, spec: EnvSpec, key: PRNGKey) -> "QNetwork":
        """Fresh parameters."""
        torso_key, head_key = jax.random.split(key)
        torso = network.build(spec.observation, torso_key)
        return QNetwork(torso, Linear.of(torso.features, spec.action.counts[0], head_key, gain=1.0))

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "A"]]:
        """Memory after the observation, and Q of every action; masked ones get `FORBIDDEN`."""
        carry, features = self.torso(carry, observation)
        return carry, self._read(features, action_mask(observation))

    def _read(self, features: Float[Array, "F"], mask: Array | None) -> Float[Array, "A"]:
        q = self.head(features)
        return q if mask is None else jnp.where(mask > 0, q, FORBIDDEN)

    def along(self, t: Transition) -> tuple[Float[Array, "*N A"], Float[Array, "*N A"]]:
        """Q at every observation and every `next_observation`, of transitions `[N]` or of sequences `[T, N]`; with a memory
        each sequence goes on from the memory that was stored with its first step.
        """
        if not is_recurrent(self.torso):
            read = _over(t.reward.ndim, lambda o: self((), o)[1])
            return read(t.observation), read(t.next_observation)

        def one(t: Transition) -> tuple[Array, Array]:
            first = jax.tree.map(lambda x: x[0], t.extras["carry"])
            carries, features = unroll(self.torso, first, t.observation, t.done)
            _, following = jax.vmap(lambda c, o: self(c, o))(carries, t.next_observation)
            return jax.vmap(lambda x, m: self._read(x, m))(features, action_mask(t.observation)), following

        return jax.vmap(one, in_axes=1, out_axes=1)(t)


class DQNState(eqx.Module):
    """Online and target network, optimiser, what observations look like, and the number of updates done."""

    network: QNetwork
    target: QNetwork
    optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class GreedyPolicy(Policy):
    """argmax_a Q(s, a), or a uniformly random allowed action with probability `epsilon`."""

    network: QNetwork
    norm: RunningNorm | None
    epsilon: Float[Array, ""]

    def init(self, key: PRNGKey) -> Carry:
        del key
        return self.network.torso.init()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        carry, q = self._q(carry, observation)
        explore_key, action_key = jax.random.split(key)
        mask = action_mask(observation)
        allowed = jnp.zeros_like(q) if mask is None else jnp.where(mask > 0, 0.0, -jnp.inf)
        anything = jax.random.categorical(action_key, allowed)
        chosen = jnp.where(jax.random.uniform(explore_key) < self.epsilon, anything, jnp.argmax(q))
        return carry, chosen.astype(jnp.int32), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        q = self._q(carry, observation)[1]
        return {"q_values": q, "value": q.max()}

    def _q(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "A"]]:
        return self.network(carry, observation if self.norm is None else self.norm(observation))


class DQN(Learner):
    """Deep Q-learning. Discrete actions; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64, activation="relu"), "recipe of the Q network", converter=as_network)
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    epsilon: Number = number(
        LinearSchedule(1.0, 0.05, fraction=0.2), "probability of a random action while learning", at_least=0, at_most=1
    )
    target_rate: Number = number(
        1.0, "tau: how far the target moves towards the network; 1 copies it", above=0, at_most=1
    )
    target_period: int = setting(250, "updates between two moves of the target", at_least=1)
    n_step: int = setting(1, "rewards in a target; more come from sequences of at least as many steps", at_least=1)
    double: bool = setting(False, "let the online network choose the action that the target network values")
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)
    huber: Number = number(1.0, "errors beyond this count linearly", above=0)
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    @property
    def batch(self) -> Literal["transitions", "sequences"]:
        return "sequences" if self.network.has_memory or self.n_step > 1 else "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete",)

    def __check_init__(self) -> None:
        if self.network.has_memory and self.n_step > 1:
            raise ValueError(
                f"n_step={self.n_step} takes steps out of their sequence, which a network with a memory needs whole: use n_step=1"
            )

    def init(self, spec: EnvSpec, key: PRNGKey) -> DQNState:
        require_action("DQN", spec, self.action_kinds)
        network = QNetwork.of(self.network, spec, key)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        optimiser = self._optimiser().init(network)
        return DQNState(network, network, optimiser, norm, jnp.zeros((), jnp.int32))

    def policy(self, state: DQNState, explore: bool) -> GreedyPolicy:
        epsilon = self.at(state.updates).epsilon if explore else 0.0
        return GreedyPolicy(state.network, state.norm, jnp.asarray(epsilon, jnp.float32))

    def update(
        self, state: DQNState, batch: Batch, key: PRNGKey
    ) -> tuple[DQNState, dict[str, Array], Float[Array, "*T N"]]:
        del key
        now, t = self.at(state.updates), batch.transitions
        norm = None if state.norm is None else state.norm.update(t.observation)
        if norm is not None:
            standard = _over(t.reward.ndim, norm)
            t = eqx.tree_at(
                lambda t: (t.observation, t.next_observation),
                t,
                (standard(t.observation), standard(t.next_observation)),
            )
        if self.n_step > 1:
            t = n_step_windows(t, self.n_step, now.gamma)
        discount = t.extras.get(DISCOUNT, now.gamma * (1.0 - t.terminated))
        by_sample = lambda x: x if x.ndim == 1 else x.mean(0)  # noqa: E731

        def loss(network: QNetwork) -> tuple[Array, tuple[Array, Array]]:
            q, following = network.along(t)
            _, target_following = state.target.along(t)
            # Where plain Q-learning has no use for the online values, the compiler drops their computation.
            value_of = double_q_target if self.double else lambda r, d, target, _: q_target(r, d, target)
            y = _over(t.reward.ndim, value_of)(t.reward, discount, target_following, following)
            chosen = jnp.take_along_axis(q, t.action[..., None], -1)[..., 0]
            error = chosen - jax.lax.stop_gradient(y)
            return (batch.weights * by_sample(huber(error, now.huber))).mean(), (chosen, error)

        (value, (chosen, error)), gradient = jax.value_and_grad(loss, has_aux=True)(state.network)
        network, optimiser = now._optimiser().step(state.network, gradient, state.optimiser)
        updates = state.updates + 1
        tau = jnp.where(updates % self.target_period == 0, now.target_rate, 0.0)
        target = jax.tree.map(
            lambda old, new: jnp.where(tau == 1.0, new, old + tau * (new - old)), state.target, network
        )
        metrics = {
            "q_loss": value,
            "q_mean": chosen.mean(),
            "td_error": jnp.abs(error).mean(),
            "grad_norm": global_norm(gradient),
            "epsilon": now.epsilon,
        }
        return DQNState(network, target, optimiser, norm, updates), metrics, jnp.abs(error)

    def _optimiser(self) -> Optimiser:
        return Optimiser(self.learning_rate, self.max_grad_norm)
