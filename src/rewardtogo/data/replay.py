"""Experience replay (chapter 6, Algorithm 11; Lin 1992) as pure functions over a ring of rows, written in place inside a compiled loop.

A row holds one step of each of B environments. Rows are written `unroll` at a time as one block, whatever the number of fields.
`Replay` is what the loop asks of a memory; `UniformReplay` draws every step with the same probability, `PrioritisedReplay` beside it
those that taught most.
"""

import dataclasses
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from ..core import Batch, Configured, PRNGKey, Transition, setting
from . import ring


class ReplayState(eqx.Module):
    """The ring `[rows, B, ...]`, where the next row goes, how many rows are filled, and what drawing depends on (`()`: on nothing).

    `order` is apart from the rest, so that a loop over several batches carries it alone.
    """

    storage: Transition
    position: Int[Array, ""]
    filled: Int[Array, ""]
    order: PyTree[Array] = ()


class Replay(Configured):
    """A memory of the last steps of B environments, out of which batches are drawn."""

    @property
    @abstractmethod
    def size(self) -> int:
        """How many steps it holds at most."""

    @abstractmethod
    def init(self, example: Transition, unroll: int, length: int = 1) -> ReplayState:
        """An empty memory for blocks `[unroll, B, ...]` like `example`, of which only shapes and types are used, out of which
        sequences of `length` steps will be drawn.
        """

    @abstractmethod
    def add(self, state: ReplayState, block: Transition) -> ReplayState:
        """Write a block `[unroll, B, ...]` over the oldest rows."""

    @abstractmethod
    def sample(self, state: ReplayState, key: PRNGKey, batch_size: int) -> Batch:
        """`batch_size` transitions `[N]`, with replacement."""

    @abstractmethod
    def sample_sequences(self, state: ReplayState, key: PRNGKey, batch_size: int, length: int) -> Batch:
        """`batch_size` sequences of `length` consecutive steps of one environment, `[T, N]`; none runs over the write position.

        At least `length` rows must be filled.
        """

    @abstractmethod
    def feedback(self, state: ReplayState, batch: Batch, priorities: Float[Array, "*T N"] | tuple[()]) -> ReplayState:
        """Take notice of what a learner said of a batch drawn from this very state. Changes `order` and nothing else."""


class UniformReplay(Replay):
    """The last `capacity` transitions, each drawn with the same probability."""

    capacity: int = setting(100_000, "transitions it holds; rounded down to whole blocks", at_least=1)
    frames: int = setting(
        0, "pictures in a stacked observation, each then stored once; 0 stores observations as they come", at_least=0
    )

    @property
    def size(self) -> int:
        return self.capacity

    def init(self, example: Transition, unroll: int, length: int = 1) -> ReplayState:
        del length
        return begin(example, self.capacity, unroll, self.frames)

    def add(self, state: ReplayState, block: Transition) -> ReplayState:
        return advance(state, block)

    def sample(self, state: ReplayState, key: PRNGKey, batch_size: int) -> Batch:
        num_envs = state.storage.reward.shape[1]
        indices = jax.random.randint(key, (batch_size,), 0, state.filled * num_envs)
        return read(state, self.frames, indices)

    def sample_sequences(self, state: ReplayState, key: PRNGKey, batch_size: int, length: int) -> Batch:
        rows, num_envs = state.storage.reward.shape
        start_key, env_key = jax.random.split(key)
        oldest = jnp.where(state.filled == rows, state.position, 0)
        start = oldest + jax.random.randint(start_key, (batch_size,), 0, state.filled - length + 1)
        env = jax.random.randint(env_key, (batch_size,), 0, num_envs)
        return read_sequences(state, self.frames, (start % rows) * num_envs + env, length)

    def feedback(self, state: ReplayState, batch: Batch, priorities: Any) -> ReplayState:
        del batch, priorities
        return state


def begin(example: Transition, capacity: int, unroll: int, frames: int) -> ReplayState:
    """Nothing remembered yet, and nothing that drawing depends on."""
    rows = ring.rows_of(capacity, unroll, example.reward.shape[1])
    storage = ring.empty(example, rows, unroll, frames)
    return ReplayState(storage, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def advance(state: ReplayState, block: Transition) -> ReplayState:
    """A block written over the oldest rows; what drawing depends on is left as it is."""
    unroll, rows = block.reward.shape[0], state.storage.reward.shape[0]
    storage = ring.write(state.storage, block, state.position)
    position, filled = (state.position + unroll) % rows, jnp.minimum(state.filled + unroll, rows)
    return dataclasses.replace(state, storage=storage, position=position, filled=filled)


def read(state: ReplayState, frames: int, indices: Int[Array, "N"]) -> Batch:
    """The transitions with these numbers, row * B + environment, each of weight 1."""
    num_envs = state.storage.reward.shape[1]
    transitions, spoilt = ring.read(state.storage, frames, indices // num_envs, indices % num_envs, state.position)
    return Batch(transitions, indices, ring.weights_of(spoilt))


def read_sequences(state: ReplayState, frames: int, indices: Int[Array, "N"], length: int) -> Batch:
    """The sequences that begin at the transitions with these numbers, each of weight 1."""
    rows, num_envs = state.storage.reward.shape
    row = ((indices // num_envs)[None, :] + jnp.arange(length)[:, None]) % rows
    env = jnp.broadcast_to(indices % num_envs, row.shape)
    transitions, spoilt = ring.read(state.storage, frames, row, env, state.position)
    return Batch(transitions, indices, ring.weights_of(spoilt))
