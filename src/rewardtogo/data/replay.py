"""Experience replay (chapter 6, Algorithm 11; Lin 1992) as pure functions over a ring of rows, written in place inside a compiled loop.

A row holds one step of each of B environments, so that consecutive steps of an environment are consecutive rows and whole sequences
can be drawn. Rows are written `unroll` at a time as one block, whatever the number of fields. Types are kept: 8-bit pictures stay 8-bit.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..core import Batch, Configured, PRNGKey, Transition, setting


class ReplayState(eqx.Module):
    """The ring `[rows, B, ...]`, where the next row goes, and how many rows are filled."""

    storage: Transition
    position: Int[Array, ""]
    filled: Int[Array, ""]


class UniformReplay(Configured):
    """The last `capacity` transitions, each drawn with the same probability."""

    capacity: int = setting(100_000, "transitions it holds; rounded down to whole blocks", at_least=1)

    def init(self, example: Transition, unroll: int) -> ReplayState:
        """An empty ring for blocks `[unroll, B, ...]` like `example`, of which only shapes and types are used."""
        num_envs = example.reward.shape[1]
        rows = self.capacity // (num_envs * unroll) * unroll
        if rows == 0:
            raise ValueError(
                f"a replay of {self.capacity} transitions cannot hold one block of {unroll} steps in {num_envs} environments: "
                f"give it a capacity of at least {unroll * num_envs}"
            )
        storage = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape[1:]), x.dtype), example)
        return ReplayState(storage, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))

    def add(self, state: ReplayState, block: Transition) -> ReplayState:
        """Write a block `[unroll, B, ...]` over the oldest rows."""
        unroll, rows = block.reward.shape[0], state.storage.reward.shape[0]
        write = lambda ring, new: jax.lax.dynamic_update_slice_in_dim(ring, new, state.position, 0)  # noqa: E731
        storage = jax.tree.map(write, state.storage, block)
        return ReplayState(storage, (state.position + unroll) % rows, jnp.minimum(state.filled + unroll, rows))

    def sample(self, state: ReplayState, key: PRNGKey, batch_size: int) -> Batch:
        """`batch_size` transitions `[N]`, with replacement."""
        num_envs = state.storage.reward.shape[1]
        indices = jax.random.randint(key, (batch_size,), 0, state.filled * num_envs)
        transitions = jax.tree.map(lambda x: x[indices // num_envs, indices % num_envs], state.storage)
        return Batch(transitions, indices, jnp.ones(batch_size))

    def sample_sequences(self, state: ReplayState, key: PRNGKey, batch_size: int, length: int) -> Batch:
        """`batch_size` sequences of `length` consecutive steps of one environment, `[T, N]`; none runs over the write position.

        At least `length` rows must be filled.
        """
        rows, num_envs = state.storage.reward.shape[:2]
        start_key, env_key = jax.random.split(key)
        oldest = jnp.where(state.filled == rows, state.position, 0)
        start = oldest + jax.random.randint(start_key, (batch_size,), 0, state.filled - length + 1)
        env = jax.random.randint(env_key, (batch_size,), 0, num_envs)
        row = (start[None, :] + jnp.arange(length)[:, None]) % rows
        transitions = jax.tree.map(lambda x: x[row, jnp.broadcast_to(env, row.shape)], state.storage)
        return Batch(transitions, (start % rows) * num_envs + env, jnp.ones(batch_size))
