r"""DAgger: ask the expert about the states that the learner comes to (notes, Algorithm 1; Ross et al. 2011).

In round i, from 1,

    1. pi_i = beta_i pi* + (1 - beta_i) pi_hat_i acts: in every step the expert with probability beta_i, else the learner
    2. the expert labels every observation of it; what was done is discarded
    3. D <- D and the labelled observations
    4. pi_hat_{i+1} is fitted to D

and the result is the best pi_hat_i, by its mistakes in states that it had not learnt from: those it has just come to.

What the notes print (erratum E2.7) never ends, returns a trajectory and leaves out beta. N rounds; a policy; beta_1 = 1 and
(1/N) sum_i beta_i -> 0, by default 1 in the first round and 0 after it, where the first round's data is the expert's own. The guarantee
is about the best policy and not the last (erratum E2.5): the loss under its own distribution is at most eps_N + O(1/N).

With beta = 1 throughout and noise on what the expert does, this is DART (Laskey et al. 2017): the expert shows the way back
from errors while it drives, and with `adapt_noise` it errs as much as the learner does.

Deviations: the learner goes on from its last parameters (`restart` begins anew each round, as in the paper); it acts with its
likeliest action (`explore` samples); the newest policy has come to no states yet and is not among the candidates.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core import (
    MASK,
    Action,
    Actor,
    Algorithm,
    Carry,
    Configured,
    EnvSpec,
    Episodes,
    Learner,
    Number,
    Observation,
    Policy,
    PRNGKey,
    State,
    Transition,
    VectorEnv,
    env_spec,
    fix_horizon,
    number,
    setting,
)
from ..data.checks import require_spec
from ..data.episodes import Dataset
from ..data.noise import EXPERT, perturb
from ..loops.collect import begin, collect
from ..loops.offline import sample_batch
from ..nn.heads import half_width
from ..ops.schedules import Linear
from .experts import require_expert

OWN = "own_action"
"""Name, in the `extras` of what was collected, of the learner's likeliest action."""


class DAggerState(eqx.Module):
    """Learner; where the environments stand; the data, filled up to `written` rows; and the best policy so far.

    - `written`: rows ever written; beyond the capacity the oldest are replaced.
    - `best`, `best_mistakes`: the learner as it was when it made the fewest, infinitely many before any was judged.
    - `noise`: on the expert's actions in the next round.
    """

    learner: State
    actor: Actor
    data: Transition
    written: Int[Array, ""]
    rounds: Int[Array, ""]
    best: State
    best_mistakes: Float[Array, ""]
    noise: Float[Array, ""]


class Queries(eqx.Module):
    """What a round asks: observations `[T, B]` to be labelled, and what is known of them.

    - `transitions`: what happened; `action` is what was done, which nobody learns from.
    - `own`: the learner's likeliest actions.
    - `labels`: the expert's actions, where the expert is a function; None where somebody has yet to be asked.
    """

    transitions: Transition
    own: Action
    labels: Action | None

    @property
    def observations(self) -> Observation:
        """What is to be labelled, `[T, B]`."""
        return self.transitions.observation


class Mixed(Policy):
    """pi_i: the expert, with noise, with probability beta, else the learner. Keeps what both would do."""

    acting: Policy
    greedy: Policy
    expert: Policy | None
    beta: Float[Array, ""]
    noise: Float[Array, ""]
    spec: EnvSpec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        expert = () if self.expert is None else self.expert.init(key)
        return self.acting.init(key), self.greedy.init(key), expert

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        act_key, greedy_key, expert_key, coin_key, noise_key = jax.random.split(key, 5)
        acting, action, _ = self.acting(carry[0], observation, act_key)
        greedy, own, _ = self.greedy(carry[1], observation, greedy_key)
        if self.expert is None:
            return (acting, greedy, ()), action, {OWN: own}
        expert, label, _ = self.expert(carry[2], observation, expert_key)
        label = self.spec.action.clip(label)
        mask = observation.get(MASK) if isinstance(observation, dict) else None
        done = perturb(self.spec.action, label, self.noise, noise_key, mask)
        action = jnp.where(jax.random.bernoulli(coin_key, self.beta), done, action)
        return (acting, greedy, expert), action, {OWN: own, EXPERT: label}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.greedy.inspect(carry[1], observation)


class DAgger(Algorithm, Configured):
    """A learner that imitates, in an environment, with an expert to ask. An iteration is a round.

    - `expert`: a `Policy`; `as_expert` makes one of a function of an observation. None where labels come from outside: then the
      learner alone acts, and a round is `act`, somebody's labels, `learn`; `step` composes the two for experts that answer by themselves.
    - `demonstrations`: data to begin with, which the first policy is fitted to.

    Raises `ValueError` where the learner wants rollouts, where spaces differ, and where the data has no room for a round.
    """

    env: VectorEnv
    learner: Learner
    expert: Any = None
    demonstrations: Dataset | None = None
    unroll: int = setting(256, "steps in each environment in a round", at_least=1)
    updates: int = setting(200, "gradient steps after each round", at_least=1)
    batch_size: int = setting(128, "labelled observations (or sequences) in a batch", at_least=1)
    length: int = setting(16, "steps of a sequence, for learners that want sequences", at_least=1)
    beta: Number = number(Linear(1.0, 0.0, 1), "chance that the expert acts, by round", at_least=0, at_most=1)
    noise: Number = number(0.0, "on the expert's actions: spread in half boxes, chance of another choice", at_least=0)
    adapt_noise: bool = setting(False, "later rounds have as much noise as the learner has error (DART)")
    restart: bool = setting(False, "fit each round's policy from fresh parameters")
    explore: bool = setting(False, "the learner samples its actions while it acts")
    capacity: int = setting(0, "rows of data that there is room for; 0 is as many as the rounds make", at_least=0)

    def __check_init__(self) -> None:
        if self.learner.batch == "rollout":
            raise ValueError(
                f"{type(self.learner).__name__} needs fresh rollouts of its own policy, and labelled data is none: use a "
                "learner that imitates, such as BC"
            )
        if self.demonstrations is not None:
            require_spec(self.demonstrations.spec, self.spec, "the data")
        if self.expert is not None:
            require_expert(self.expert, self.spec)
        if 0 < self.capacity < self._given + self.steps_per_iteration:
            raise ValueError(
                f"there is room for {self.capacity} rows, and the data to begin with and one round are "
                f"{self._given + self.steps_per_iteration}: give more capacity, or 0"
            )

    @staticmethod
    def default_num_envs() -> int:
        """Environments side by side where nobody says how many."""
        return 4

    @property
    def spec(self) -> EnvSpec:
        return env_spec(self.env)

    @property
    def steps_per_iteration(self) -> int:
        return self.unroll * self.env.num_envs

    @property
    def initial_steps(self) -> int:
        return 0

    @property
    def _given(self) -> int:
        return 0 if self.demonstrations is None else self.demonstrations.num_steps

    def with_horizon(self, iterations: int) -> "DAgger":
        fits = 1 if self.restart else iterations + (self._given > 0)
        return dataclasses.replace(
            self,
            learner=fix_horizon(self.learner, fits * self.updates),
            beta=fix_horizon(self.beta, iterations),
            noise=fix_horizon(self.noise, iterations),
            capacity=self.capacity or self._given + iterations * self.steps_per_iteration,
        )

    def init(self, key: PRNGKey) -> DAggerState:
        learner_key, actor_key, fit_key = jax.random.split(key, 3)
        learner = self.learner.init(self.spec, learner_key)
        zero = jnp.zeros((), jnp.int32)
        noise = jnp.asarray(self.at(zero).noise, jnp.float32)
        actor = begin(self.env, self._policy(learner, jnp.zeros(()), noise), actor_key)
        data = self._empty()
        if self.demonstrations is not None:
            given = _labelled(self.demonstrations.transitions)
            data = jax.tree.map(lambda room, rows: room.at[: self._given].set(rows), data, given)
        written = jnp.asarray(self._given, jnp.int32)
        state = DAggerState(learner, actor, data, written, zero, learner, jnp.asarray(jnp.inf, jnp.float32), noise)
        if self._given:
            state = dataclasses.replace(state, learner=self._fit(state, fit_key)[0])
        return state

    def step(self, state: DAggerState, key: PRNGKey) -> tuple[DAggerState, tuple[dict[str, jax.Array], Episodes]]:
        if self.expert is None:
            raise ValueError(
                "there is no expert to ask: use act and learn, with labels from wherever they come; a person gives them with `rtg label`"
            )
        act_key, learn_key = jax.random.split(key)
        state, queries, episodes = self.act(state, act_key)
        state, metrics = self.learn(state, queries, queries.labels, learn_key)
        return state, (metrics, episodes)

    def act(self, state: DAggerState, key: PRNGKey) -> tuple[DAggerState, Queries, Episodes]:
        """The first half of a round: act, and ask."""
        beta = jnp.asarray(self.at(state.rounds).beta, jnp.float32)
        policy = self._policy(state.learner, beta, state.noise)
        actor, rollout, episodes = collect(self.env, policy, state.actor, key, self.unroll)
        t = rollout.transitions
        queries = Queries(dataclasses.replace(t, extras={}), t.extras[OWN], t.extras.get(EXPERT))
        return dataclasses.replace(state, actor=actor), queries, episodes

    def learn(
        self,
        state: DAggerState,
        queries: Queries,
        labels: Action,
        key: PRNGKey,
        known: Bool[Array, "T B"] | None = None,
    ) -> tuple[DAggerState, dict[str, Array]]:
        """The second half: judge the policy by its labels `[T, B]`, add them to the data, fit the next policy to all of it.

        `known` says which of the labels there are, at least one; the other observations are left out. None where nobody passed.
        """
        spec = self.spec.action
        labels = spec.clip(jnp.asarray(labels, spec.dtype))
        mistakes = _mistakes(self.spec, queries.own, labels, known)
        # The very first policy was fitted to nothing.
        judged = (state.rounds > 0) | (self._given > 0)
        better = judged & (mistakes <= state.best_mistakes)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), state.learner, state.best)
        state = dataclasses.replace(
            self._aggregated(state, queries.transitions, labels, known),
            best=best,
            best_mistakes=jnp.where(better, mistakes, state.best_mistakes),
            rounds=state.rounds + 1,
        )
        learner, metrics = self._fit(state, key)
        own = jnp.asarray(self.at(state.rounds).noise, jnp.float32)
        noise = jnp.where(self.adapt_noise, _spread(self.spec, mistakes), own)
        metrics |= {
            "mistakes": mistakes,
            "best_mistakes": jnp.where(jnp.isfinite(state.best_mistakes), state.best_mistakes, mistakes),
            "labels": (state.written - self._given).astype(jnp.float32),
            "beta": jnp.asarray(self.at(state.rounds - 1).beta, jnp.float32),
            "noise": state.noise,
        }
        return dataclasses.replace(state, learner=learner, noise=noise), metrics

    def learned(self, state: DAggerState) -> State:
        """The best policy's learner; the newest one where none was judged yet."""
        judged = jnp.isfinite(state.best_mistakes)
        # Of several seeds everything has a leading axis more.
        along = lambda x: judged.reshape(judged.shape + (1,) * (x.ndim - judged.ndim))  # noqa: E731
        return jax.tree.map(lambda best, new: jnp.where(along(new), best, new), state.best, state.learner)

    def policy(self, state: DAggerState, explore: bool = False) -> Policy:
        return self.learner.policy(self.learned(state), explore)

    def _policy(self, learner: State, beta: Array, noise: Array) -> Mixed:
        acting = self.learner.policy(learner, self.explore)
        return Mixed(acting, self.learner.policy(learner, False), self.expert, beta, noise, self.spec)

    def _empty(self) -> Transition:
        rows = self.capacity or self._given + self.steps_per_iteration
        many = lambda tree: jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), tree)  # noqa: E731
        seen, never = many(self.spec.observation.zeros()), jnp.zeros(rows, bool)
        return Transition(
            seen, many(self.spec.action.zeros()), jnp.zeros(rows), never, never, many(self.spec.observation.zeros()), {}
        )

    def _aggregated(self, state: DAggerState, t: Transition, labels: Action, known: Array | None) -> DAggerState:
        """The data with the rows of a round, one environment after the other; a sequence ends where the next one begins, and at a gap."""
        last = jnp.broadcast_to((jnp.arange(self.unroll) == self.unroll - 1)[:, None], t.reward.shape)
        if known is not None:
            last = last | ~jnp.concatenate([known[1:], known[-1:]])
        t = dataclasses.replace(t, action=labels, truncated=t.truncated | (last & ~t.terminated))
        in_a_row = lambda x: jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:])  # noqa: E731
        rows = jax.tree.map(in_a_row, t)
        capacity = len(state.data.reward)
        kept = jnp.ones(len(rows.reward), bool) if known is None else in_a_row(known)
        count = jnp.cumsum(kept.astype(jnp.int32))
        # What has no label gets a place that does not exist.
        place = jnp.where(kept, (state.written + count - 1) % capacity, capacity)
        data = jax.tree.map(lambda room, new: room.at[place].set(new, mode="drop"), state.data, rows)
        return dataclasses.replace(state, data=data, written=state.written + count[-1])

    def _fit(self, state: DAggerState, key: PRNGKey) -> tuple[State, dict[str, Array]]:
        fresh_key, loop_key = jax.random.split(key)
        learner = self.learner.init(self.spec, fresh_key) if self.restart else state.learner
        size = jnp.minimum(state.written, len(state.data.reward))

        def update(learner: State, key: PRNGKey) -> tuple[State, dict[str, Array]]:
            sample_key, update_key = jax.random.split(key)
            batch = sample_batch(self.learner, learner, state.data, size, self.batch_size, self.length, sample_key)
            learner, metrics, _ = self.learner.update(learner, batch, update_key)
            return learner, metrics

        learner, metrics = jax.lax.scan(update, learner, jax.random.split(loop_key, self.updates))
        return learner, jax.tree.map(jnp.mean, metrics)


def _labelled(t: Transition) -> Transition:
    """Transitions with the expert's action as theirs, and nothing else kept."""
    return dataclasses.replace(t, action=t.extras.get(EXPERT, t.action), extras={})


def _mistakes(spec: EnvSpec, own: Action, labels: Action, known: Array | None) -> Float[Array, ""]:
    """Share of entries of the learner's choices that are not the expert's; in boxes the mean squared distance, in half boxes."""
    if spec.action.kind == "box":
        unit: np.ndarray = half_width(spec.action)[None, None]
        wrong = jnp.square((spec.action.clip(own) - labels) / unit)
    else:
        wrong = (own != labels).astype(jnp.float32)
    if known is None:
        return wrong.mean()
    return wrong.mean(where=known.reshape(known.shape + (1,) * (wrong.ndim - 2)))


def _spread(spec: EnvSpec, mistakes: Array) -> Array:
    """The noise that errs as much as a learner with so many mistakes."""
    return jnp.sqrt(mistakes) if spec.action.kind == "box" else mistakes
