"""Learn from a dataset, without an environment: imitation (chapter 2) and offline reinforcement learning (chapter 15)."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

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
    fix_horizon,
    setting,
)
from ..data.episodes import Dataset
from .collect import fresh_carry


class OfflineState(eqx.Module):
    """The learner's state; the data never changes."""

    learner: State


class Offline(Algorithm, Configured):
    """Each iteration takes `updates` gradient steps, each on a batch drawn uniformly from the data, with replacement.

    Learners that want sequences get windows of `length` consecutive steps. A window may begin anywhere in an episode,
    with a fresh memory, and may run over the end of an episode into the next one, where the memory is reset; the first
    episode follows the last one. No environment is ever stepped (item 15.2).

    Raises `ValueError` where the learner wants fresh rollouts, or where there is no data.
    """

    dataset: Dataset
    learner: Learner
    batch_size: int = setting(256, "transitions (or sequences) in a batch", at_least=1)
    updates: int = setting(10, "gradient steps in an iteration", at_least=1)
    length: int = setting(16, "steps of a sequence, for learners that want sequences", at_least=1)

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
        return OfflineState(self.learner.init(self.spec, key))

    def step(self, state: OfflineState, key: PRNGKey) -> tuple[OfflineState, tuple[dict[str, jax.Array], Episodes]]:
        def update(learner: State, key: PRNGKey) -> tuple[State, dict[str, jax.Array]]:
            sample_key, update_key = jax.random.split(key)
            learner, metrics, _ = self.learner.update(learner, self._sample(learner, sample_key), update_key)
            return learner, metrics

        if self.updates == 1:
            learner, metrics = update(state.learner, key)
        else:
            learner, metrics = jax.lax.scan(update, state.learner, jax.random.split(key, self.updates))
            metrics = jax.tree.map(jnp.mean, metrics)
        return OfflineState(learner), (metrics, Episodes.none())

    def learned(self, state: OfflineState) -> State:
        return state.learner

    def policy(self, state: OfflineState, explore: bool = False) -> Policy:
        return self.learner.policy(state.learner, explore)

    def _sample(self, learner: State, key: PRNGKey) -> Batch:
        """Transitions `[N]`, or sequences `[T, N]` with fresh memories as `extras["carry"]`."""
        row_key, carry_key = jax.random.split(key)
        size = self.dataset.num_steps
        row = jax.random.randint(row_key, (self.batch_size,), 0, size)
        weights = jnp.ones(self.batch_size)
        if self.learner.batch == "transitions":
            return Batch(jax.tree.map(lambda x: x[row], self.dataset.transitions), row, weights)
        rows = (row[None, :] + jnp.arange(self.length)[:, None]) % size
        windows = jax.tree.map(lambda x: x[rows], self.dataset.transitions)
        carry = fresh_carry(self.learner.policy(learner, explore=True), carry_key, self.batch_size)
        # The memory before later steps follows from the data; there is only room for it.
        carry = jax.tree.map(lambda x: jnp.broadcast_to(x[None], (self.length, *x.shape)), carry)
        extras = {**windows.extras, "carry": carry}
        return Batch(dataclasses.replace(windows, extras=extras), row, weights)
