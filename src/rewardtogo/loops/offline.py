"""Learn from a dataset, without an environment: imitation (chapter 2) and offline reinforcement learning (chapter 15)."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core import (
    Algorithm,
    Batch,
    Configured,
    EnvSpec,
    Episodes,
    Learner,
    Policy,
    PRNGKey,
    State,
    Transition,
    fix_horizon,
    setting,
)
from ..data.episodes import Dataset
from .collect import fresh_carry


class HeldOut(eqx.Module):
    """Which steps are learnt from and which are not, and the best state by what the learner says of the latter.

    - `rows`: the steps of the data, those of training episodes first, `train` of them.
    - `best`, `best_loss`: of the iterations so far; `stale`: iterations since then.
    """

    rows: Int[Array, "N"]
    train: Int[Array, ""]
    best: State
    best_loss: Float[Array, ""]
    stale: Int[Array, ""]


class OfflineState(eqx.Module):
    """The learner's state, and what belongs to held-out data where there is any; the data itself never changes."""

    learner: State
    held_out: HeldOut | None = None


class Offline(Algorithm, Configured):
    """Each iteration takes `updates` gradient steps, each on a batch drawn uniformly from the data, with replacement.

    Learners that want sequences get windows of `length` consecutive steps. A window may begin anywhere in an episode,
    with a fresh memory, and may run over the end of an episode into the next one, where the memory is reset; the first
    episode follows the last one. No environment is ever stepped (item 15.2).

    With `validation` > 0 that share of the episodes, drawn by the seed, is never learnt from; after each iteration the learner's
    metric `monitor` is taken from a batch of them, and the policy is the one that did best there. After `patience` iterations
    without a better one the learner stays as it is (early stopping).

    Raises `ValueError` where the learner wants fresh rollouts, where there is no data, or less than two episodes to split.
    """

    dataset: Dataset
    learner: Learner
    batch_size: int = setting(256, "transitions (or sequences) in a batch", at_least=1)
    updates: int = setting(10, "gradient steps in an iteration", at_least=1)
    length: int = setting(16, "steps of a sequence, for learners that want sequences", at_least=1)
    validation: float = setting(0.0, "share of the episodes that is held out, from 0 to below 1")
    patience: int = setting(
        0, "iterations without a better validation after which learning stops; 0: never", at_least=0
    )
    monitor: str = setting("bc_loss", "the metric that is small where the learner is good, for validation")

    def __check_init__(self) -> None:
        if self.learner.batch == "rollout":
            raise ValueError(
                f"{type(self.learner).__name__} needs fresh rollouts of its own policy, which a dataset cannot give: "
                "use OnPolicy with an environment"
            )
        if self.dataset.num_steps == 0:
            raise ValueError(
                "the dataset has no steps, so there is nothing to learn from: collect at least one episode"
            )
        if self.validation and self.dataset.num_episodes < 2:
            raise ValueError("a dataset of one episode cannot be split into two of whole episodes: collect more")
        if not 0.0 <= self.validation < 1.0:
            raise ValueError(f"Offline.validation must be in [0, 1), not {self.validation}")
        if self.patience and not self.validation:
            raise ValueError("early stopping looks at held-out episodes: give validation, such as 0.1, or no patience")

    @staticmethod
    def default_num_envs() -> int:
        """Environments side by side where nobody says how many; only an evaluation has any."""
        return 1

    @property
    def spec(self) -> EnvSpec:
        return self.dataset.spec

    @property
    def steps_per_iteration(self) -> int:
        return self.updates

    @property
    def initial_steps(self) -> int:
        return 0

    def with_horizon(self, iterations: int) -> "Offline":
        return dataclasses.replace(self, learner=fix_horizon(self.learner, iterations * self.updates))

    def init(self, key: PRNGKey) -> OfflineState:
        learner = self.learner.init(self.spec, key)
        if not self.validation:
            return OfflineState(learner)
        rows, train = split_rows(self.dataset.transitions, self.validation, jax.random.fold_in(key, 1))
        return OfflineState(
            learner, HeldOut(rows, train, learner, jnp.asarray(jnp.inf, jnp.float32), jnp.zeros((), jnp.int32))
        )

    def step(self, state: OfflineState, key: PRNGKey) -> tuple[OfflineState, tuple[dict[str, jax.Array], Episodes]]:
        held_out = state.held_out

        def update(learner: State, key: PRNGKey) -> tuple[State, dict[str, jax.Array]]:
            sample_key, update_key = jax.random.split(key)
            batch = self._batch(learner, held_out, True, sample_key)
            learner, metrics, _ = self.learner.update(learner, batch, update_key)
            return learner, metrics

        if self.updates == 1:
            learner, metrics = update(state.learner, key)
        else:
            learner, metrics = jax.lax.scan(update, state.learner, jax.random.split(key, self.updates))
            metrics = jax.tree.map(jnp.mean, metrics)
        if held_out is None:
            return OfflineState(learner), (metrics, Episodes.none())
        state, judged = self._judge(state, held_out, learner, jax.random.fold_in(key, 1))
        return state, (metrics | judged, Episodes.none())

    def learned(self, state: OfflineState) -> State:
        return state.learner if state.held_out is None else state.held_out.best

    def policy(self, state: OfflineState, explore: bool = False) -> Policy:
        return self.learner.policy(self.learned(state), explore)

    def _batch(self, learner: State, held_out: HeldOut | None, training: bool, key: PRNGKey) -> Batch:
        data = self.dataset.transitions
        if held_out is None:
            return sample_batch(self.learner, learner, data, self.dataset.num_steps, self.batch_size, self.length, key)
        first = 0 if training else held_out.train
        size = held_out.train if training else self.dataset.num_steps - held_out.train
        return sample_batch(
            self.learner, learner, data, size, self.batch_size, self.length, key, lambda row: held_out.rows[first + row]
        )

    def _judge(
        self, state: OfflineState, held_out: HeldOut, learner: State, key: PRNGKey
    ) -> tuple[OfflineState, dict[str, jax.Array]]:
        """What the learner says of held-out data, from which it learns nothing: of the update only the metric is kept."""
        sample_key, update_key = jax.random.split(key)
        over = jnp.asarray(False) if not self.patience else held_out.stale >= self.patience
        learner = jax.tree.map(lambda old, new: jnp.where(over, old, new), state.learner, learner)
        metrics = self.learner.update(learner, self._batch(learner, held_out, False, sample_key), update_key)[1]
        if self.monitor not in metrics:
            raise ValueError(
                f"{type(self.learner).__name__} has no metric {self.monitor!r} to validate by: name one of {', '.join(metrics)}"
            )
        loss = metrics[self.monitor]
        better = ~over & (loss < held_out.best_loss)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), learner, held_out.best)
        least = jnp.where(better, loss, held_out.best_loss)
        stale = jnp.where(better, 0, held_out.stale + 1)
        judged = {"validation_loss": loss, "best_validation_loss": least, "stopped": over.astype(jnp.float32)}
        return OfflineState(learner, HeldOut(held_out.rows, held_out.train, best, least, stale)), judged


def split_rows(transitions: Transition, share: float, key: PRNGKey) -> tuple[Int[Array, "N"], Int[Array, ""]]:
    """Rows of whole episodes, those to learn from first, and how many these are; of at least one episode each, drawn at random."""
    done = transitions.done
    episode = jnp.cumsum(done) - done
    count = done.sum()
    size = len(done)
    number = jax.random.uniform(key, (size,)) + (jnp.arange(size) >= count)
    place = jnp.argsort(jnp.argsort(number))
    held_out = place[episode] < jnp.clip(jnp.round(share * count), 1, count - 1)
    return jnp.argsort(held_out, stable=True), (~held_out).sum()


def sample_batch(
    learner: Learner,
    state: State,
    transitions: Transition,
    size: int | Int[Array, ""],
    batch_size: int,
    length: int,
    key: PRNGKey,
    place: Callable[[Array], Array] = lambda row: row,
) -> Batch:
    """A batch, as the learner wants it, from the first `size` of a row of transitions, drawn uniformly with replacement.

    Transitions `[N]`, or windows of `length` steps `[T, N]` with fresh memories as `extras["carry"]`. `place` says where the
    i-th of the `size` lies, where they are not the first.
    """
    row_key, carry_key = jax.random.split(key)
    row = jax.random.randint(row_key, (batch_size,), 0, size)
    weights = jnp.ones(batch_size)
    if learner.batch == "transitions":
        row = place(row)
        return Batch(jax.tree.map(lambda x: x[row], transitions), row, weights)
    rows = place((row[None, :] + jnp.arange(length)[:, None]) % size)
    windows = jax.tree.map(lambda x: x[rows], transitions)
    carry = fresh_carry(learner.policy(state, explore=True), carry_key, batch_size)
    # The memory before later steps follows from the data; there is only room for it.
    carry = jax.tree.map(lambda x: jnp.broadcast_to(x[None], (length, *x.shape)), carry)
    extras = {**windows.extras, "carry": carry}
    return Batch(dataclasses.replace(windows, extras=extras), rows[0], weights)
