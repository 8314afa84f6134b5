"""Asynchronous value iteration: always the state whose value is most wrong next (Moore and Atkeson 1993; Peng and Williams 1993).

    s = argmax_s |(B V)(s) - V(s)|,   V(s) <- (B V)(s),   then the priorities of the states that may lead to s

until no priority is above what the tolerance allows. Value iteration may update states in any order, as long as none is left out for ever
(Bertsekas 1982); this order does no work where nothing has changed, which is nearly everywhere while the news of a goal travels back.

The priorities are exact: a predecessor's is computed anew, from all of its actions. The largest is found in a tree of two levels, blocks of
about the square root of the number of states.

Source: notes, section 5.2.2 (item 5.8).
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core import Solution
from ..envs.sparse import SparseMDP, sparse_of
from .dynamic_programming import ROUNDING, check_settings, first_values, solution_of
from .operators import Lookahead, Problem, lookahead

CALL = 20_000
"""Backups to a compiled call, so that Ctrl-C is heard."""


class Queue(eqx.Module):
    """Values, how wrong each is, and the largest of each block of them. Padded to whole blocks with priority 0."""

    value: Float[Array, "S"]
    priority: Float[Array, "P"]
    block_max: Float[Array, "C"]
    backups: Int[Array, ""]


def _width(states: int) -> int:
    return max(1, math.isqrt(states))


def _put(queue: Queue, state: Array, priority: Array, width: int) -> Queue:
    block = state // width
    priorities = queue.priority.at[state].set(priority)
    largest = jax.lax.dynamic_slice_in_dim(priorities, block * width, width).max()
    return Queue(queue.value, priorities, queue.block_max.at[block].set(largest), queue.backups)


@eqx.filter_jit
def _back_up(
    ahead: Lookahead, offsets: Array, sources: Array, queue: Queue, threshold: Array, limit: Array, width: int
) -> Queue:
    """Backups of the most wrong state until none is wrong by more than the threshold, or there were `limit` of them."""

    def wrong(value: Array, state: Array) -> Array:
        return jnp.abs(ahead.rows(state[None]).best(value)[0] - value[state])

    def one(queue: Queue) -> Queue:
        block = jnp.argmax(queue.block_max)
        inside = jnp.argmax(jax.lax.dynamic_slice_in_dim(queue.priority, block * width, width))
        state = block * width + inside
        value = queue.value.at[state].set(ahead.rows(state[None]).best(queue.value)[0])
        queue = Queue(value, queue.priority, queue.block_max, queue.backups + 1)
        # A state that may lead back to itself is among its own predecessors, and gets its true priority there.
        queue = _put(queue, state, jnp.zeros(()), width)

        def again(i: Array, queue: Queue) -> Queue:
            return _put(queue, sources[i], wrong(queue.value, sources[i]), width)

        return jax.lax.fori_loop(offsets[state], offsets[state + 1], again, queue)

    return jax.lax.while_loop(lambda q: (q.block_max.max() > threshold) & (q.backups < limit), one, queue)


def prioritised_sweeping(
    problem: Problem,
    *,
    tolerance: float = 1e-8,
    max_sweeps: int = 1_000_000,
    initial: Float[np.ndarray, "S"] | None = None,
) -> Solution:
    """V*, one state at a time, the most wrong one first.

    `stats["backups"]` counts single updates, `stats["sweeps"]` the same in units of the number of states. Raises `ValueError` as
    `value_iteration` does.
    """
    check_settings(tolerance, "norm", max_sweeps)
    lookahead(problem)
    sparse = problem if isinstance(problem, SparseMDP) else sparse_of(problem)
    gamma, states, arrays = float(sparse.discount), sparse.num_states, lookahead(sparse)
    offsets, sources = sparse.predecessors()
    width = _width(states)
    blocks = -(-states // width)
    start = first_values(initial, states)
    with jax.enable_x64(True):
        ahead = jax.tree.map(jnp.asarray, arrays)
        value = jnp.asarray(start)
        priority = jnp.zeros(blocks * width).at[:states].set(jnp.abs(ahead.best(value) - value))
        queue = Queue(value, priority, priority.reshape(blocks, width).max(-1), jnp.asarray(0))
        # Where every priority is below this, |BV - V| is, everywhere, which is what Algorithm 7 stops by.
        wanted = tolerance if gamma == 1 else np.inf if gamma == 0 else tolerance * (1 - gamma) / (2 * gamma)
        most, given = max_sweeps * states, (jnp.asarray(offsets), jnp.asarray(sources))
        while True:
            threshold = max(wanted, ROUNDING * float(jnp.abs(queue.value).max()))
            done = float(queue.block_max.max()) <= threshold
            if done or int(queue.backups) >= most:
                break
            limit = jnp.asarray(min(int(queue.backups) + CALL, most))
            queue = _back_up(ahead, *given, queue, jnp.asarray(threshold), limit, width)
        value = np.asarray(queue.value)
    backups = int(queue.backups)
    stats = {"sweeps": np.asarray(backups / states), "backups": np.asarray(backups)}
    return solution_of(sparse, value, np.asarray(arrays.q(value)), done, stats)
