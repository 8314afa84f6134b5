r"""Q-learning with continuous actions whose best action is searched for (notes 6.3.3, option 1; Kalashnikov et al. 2018, QT-Opt).

    y     = r + gamma (1 - terminated) max_a' min_e Q_phi_e'(s', a')
    phi   down the mean of sum_e (Q_phi_e(s, a) - y)^2 / 2
    phi'  follows phi by Polyak averaging

There is no actor: `maximiser` finds the action, in the target and while acting, by random samples (`sampled`), by gradient or Newton ascent
from several starts (`ascent`) or by the cross-entropy method (`cem`). It is DQN with another way to take the maximum. To explore, noise is
added to the best action.

Deviations from QT-Opt: the least of `critics` target networks counts inside the search (there, the search is in one and the least of two
values its result); synchronous, one process; squared errors instead of cross-entropy.
"""

from typing import Literal

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
    Spec,
    number,
    part,
    setting,
)
from ..nn import MLP, Network, Optimiser, RunningNorm, as_network
from ..nn.optimise import towards
from .continuous import Memories, Sample, fit_critics, require_short
from .critics import Critics, from_units, least, require_box
from .maximisers import CEM, Maximiser, Maximum, as_maximiser
from .noise import Gaussian, Noise, Noisy, as_noise


class CEMQState(eqx.Module):
    """Critics and their targets, the optimiser, what observations look like, and the number of updates done."""

    critics: Critics
    target_critics: Critics
    optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]
    spec: Spec = eqx.field(static=True)


class SearchingPolicy(Policy):
    """The action that a maximiser finds best by the least of the critics."""

    critics: Critics
    maximiser: Maximiser
    norm: RunningNorm | None
    spec: Spec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return Memories((), self.critics.init())

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        observation = observation if self.norm is None else self.norm(observation)
        best = self._search(carry, observation, key)
        carry = Memories((), self.critics.remember(carry.critics, observation))
        return carry, from_units(self.spec, best.action), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        observation = observation if self.norm is None else self.norm(observation)
        best = self._search(carry, observation, jax.random.key(0))
        return {"value": best.value, "mean": from_units(self.spec, best.action)}

    def _search(self, carry: Carry, observation: Observation, key: PRNGKey) -> Maximum:
        seen = self.critics.see(carry.critics, observation)
        return self.maximiser(lambda units: least(self.critics(seen, units)), self.spec.shape, key)


class CEMQ(Learner):
    """Q-learning whose best action is searched for. Actions in a box; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64, activation="relu"), "recipe of the critics", converter=as_network)
    maximiser: Maximiser = part(CEM(), "how the best action is found: sampled, ascent or cem", converter=as_maximiser)
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    target_rate: Number = number(0.005, "tau: how far the targets move towards the critics", above=0, at_most=1)
    critics: int = setting(2, "critics, the least of which counts", at_least=1)
    noise: Noise = part(Gaussian(0.1), "noise on the actions while learning", converter=as_noise)
    n_step: int = setting(1, "rewards in a target; more come from sequences of at least as many steps", at_least=1)
    max_grad_norm: Number = number(1000.0, "gradients are scaled down to this global norm", above=0)
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    def __check_init__(self) -> None:
        require_short(self.network, self.n_step)

    @property
    def batch(self) -> Literal["transitions", "sequences"]:
        return "sequences" if self.network.has_memory or self.n_step > 1 else "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("box",)

    def init(self, spec: EnvSpec, key: PRNGKey) -> CEMQState:
        require_box("CEMQ", spec)
        critics = Critics.of(self.network, spec, key, self.critics)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        optimiser = Optimiser(0.0, 1.0).init(critics)
        return CEMQState(critics, critics, optimiser, norm, jnp.zeros((), jnp.int32), spec.action)

    def policy(self, state: CEMQState, explore: bool) -> Policy:
        policy = SearchingPolicy(state.critics, self.maximiser, state.norm, state.spec)
        return Noisy.of(policy, self.at(state.updates).noise, state.spec) if explore else policy

    def update(
        self, state: CEMQState, batch: Batch, key: PRNGKey
    ) -> tuple[CEMQState, dict[str, Array], Float[Array, "N"]]:
        now = self.at(state.updates)
        norm = None if state.norm is None else state.norm.update(batch.transitions.observation)
        sample = Sample.of(batch, state.spec, norm, now.gamma, self.n_step)
        best = self._best_following(state, sample, key)
        y = sample.t.reward + sample.discount * best.value
        rule = Optimiser(now.learning_rate, now.max_grad_norm)
        fit = fit_critics(state.critics, state.optimiser, rule, sample, y)
        target = towards(state.target_critics, fit.critics, now.target_rate)
        state = CEMQState(fit.critics, target, fit.optimiser, norm, state.updates + 1, state.spec)
        return state, fit.metrics | {"saturation": jnp.abs(best.action).mean()}, fit.errors

    def _best_following(self, state: CEMQState, sample: Sample, key: PRNGKey) -> Maximum:
        """The best action at every next observation by the least of the target critics, and its value."""
        critics = state.target_critics
        seen = critics.see_along(sample.memory.critics, sample.t)[1]

        def search(seen: Observation, key: PRNGKey) -> Maximum:
            return self.maximiser(lambda units: least(critics(seen, units)), state.spec.shape, key)

        keys = jax.random.split(key, sample.t.reward.shape)
        seen_axis = 0 if critics.each.reader is None else 1
        for _ in range(sample.axes):
            search = jax.vmap(search, in_axes=(seen_axis, 0))
        return search(seen, keys)
