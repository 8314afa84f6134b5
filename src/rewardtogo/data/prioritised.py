r"""Prioritised experience replay, proportional variant (Schaul et al. 2016, Algorithm 1): steps with large errors are drawn more often.

$$P(i) = \frac{p_i^\alpha}{\sum_k p_k^\alpha}, \qquad p_i = |\delta_i| + \epsilon, \qquad
w_i = \Big(\frac{1}{N P(i)}\Big)^\beta \Big/ \max_j w_j.$$

New steps get the largest priority there has been, so that each is likely to be learnt from soon; a batch takes one step from each of
as many equal parts of the sum of priorities (stratified). The weights undo the bias that uneven drawing gives to expectations, wholly at
beta = 1, to which it grows over training.

Sequences have a priority each, at their first step (Kapturowski et al. 2019):
$\eta \max_t |\delta_t| + (1 - \eta)\, \mathrm{mean}_t |\delta_t|$.
A place has priority 0 while a sequence from there would run over the end of what is written.

Deviations: weights are divided by the largest of the batch, not of the whole memory, as DeepMind's own later code does. The learner's loss
multiplies by the weights; the step size is not reduced to a quarter, as the paper does for its own settings.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core import Batch, Number, PRNGKey, Transition, number, setting
from ..ops.schedules import Linear
from . import sum_tree
from .replay import Replay, ReplayState, advance, begin, read, read_sequences


class Priorities(eqx.Module):
    """p^alpha of every place as a tree of sums, the largest there has been, how many batches were learnt from, and the length of
    the sequences that begin at a place.
    """

    tree: sum_tree.Levels
    largest: Float[Array, ""]
    batches: Int[Array, ""]
    length: int = eqx.field(static=True)


class PrioritisedReplay(Replay):
    """The last `capacity` transitions, drawn in proportion to a power of their last error."""

    capacity: int = setting(100_000, "transitions it holds; rounded down to whole blocks", at_least=1)
    alpha: Number = number(0.6, "how much priorities count: 0 draws uniformly, 1 in proportion", at_least=0, at_most=1)
    beta: Number = number(
        Linear(0.4, 1.0), "how far weights undo the bias of drawing: 1 wholly, 0 not at all", at_least=0, at_most=1
    )
    offset: Number = number(1e-6, "added to every error, so that no step is forgotten for ever", above=0)
    mix: Number = number(
        0.9, "a sequence's priority: so much of its largest error, the rest of the mean", at_least=0, at_most=1
    )
    frames: int = setting(
        0, "pictures in a stacked observation, each then stored once; 0 stores observations as they come", at_least=0
    )

    @property
    def size(self) -> int:
        return self.capacity

    def init(self, example: Transition, unroll: int, length: int = 1) -> ReplayState:
        state = begin(example, self.capacity, unroll, self.frames)
        tree = sum_tree.zeros(state.storage.reward.size)
        order = Priorities(tree, jnp.ones(()), jnp.zeros((), jnp.int32), length)
        return dataclasses.replace(state, order=order)

    def add(self, state: ReplayState, block: Transition) -> ReplayState:
        """A place gets the largest priority when a whole sequence can begin there, and 0 when what was there is overwritten."""
        unroll, (rows, num_envs) = block.reward.shape[0], state.storage.reward.shape
        order, state = state.order, advance(state, block)
        back = jnp.arange(-min(unroll + order.length - 1, rows), 0)
        # Rows before the first one exist only after the ring has gone round.
        whole = (back <= -order.length) & ((state.filled == rows) | (_end(state) + back >= 0))
        place = ((_end(state) + back) % rows)[:, None] * num_envs + jnp.arange(num_envs)[None]
        new = jnp.broadcast_to(jnp.where(whole, order.largest, 0.0)[:, None], place.shape)
        size, place = rows * num_envs, place.ravel()
        some = place[:: sum_tree.RADIX] if num_envs * unroll > 2 * sum_tree.RADIX else place
        # The places are one run, or two where it goes over the end of the ring: these rows of the tree are all that it touches.
        touched = jnp.concatenate([some, jnp.stack([place[-1], 0, size - 1])]) // sum_tree.RADIX
        tree = sum_tree.assign(order.tree, place, new.ravel(), touched)
        return dataclasses.replace(state, order=dataclasses.replace(order, tree=tree))

    def sample(self, state: ReplayState, key: PRNGKey, batch_size: int) -> Batch:
        _require_length(state, 1)
        indices, weights = self._draw(state, key, batch_size)
        batch = read(state, self.frames, indices)
        return dataclasses.replace(batch, weights=weights * batch.weights)

    def sample_sequences(self, state: ReplayState, key: PRNGKey, batch_size: int, length: int) -> Batch:
        _require_length(state, length)
        indices, weights = self._draw(state, key, batch_size)
        batch = read_sequences(state, self.frames, indices, length)
        return dataclasses.replace(batch, weights=weights * batch.weights)

    def feedback(self, state: ReplayState, batch: Batch, priorities: Float[Array, "*T N"] | tuple[()]) -> ReplayState:
        """Raises `ValueError` where the learner gave none."""
        if isinstance(priorities, tuple):
            raise ValueError(
                "a prioritised replay needs the learner's errors by sample, and this learner gives none: use the uniform replay"
            )
        now, order = self.at(state.order.batches), state.order
        error = jnp.abs(priorities)
        if error.ndim > 1:
            error = now.mix * error.max(0) + (1.0 - now.mix) * error.mean(0)
        # What must not be learnt from (weight 0) is not drawn again. It also makes the write of new priorities wait for the last
        # look at the old ones, without which XLA copies the whole tree.
        power = jnp.where(batch.weights > 0, (error + now.offset) ** now.alpha, 0.0)
        tree = sum_tree.assign(order.tree, batch.indices, power)
        largest = jnp.maximum(order.largest, power.max())
        return dataclasses.replace(state, order=Priorities(tree, largest, order.batches + 1, order.length))

    def _draw(self, state: ReplayState, key: PRNGKey, batch_size: int) -> tuple[Int[Array, "N"], Float[Array, "N"]]:
        order, num_envs = state.order, state.storage.reward.shape[1]
        total = sum_tree.total(order.tree)
        part = (jnp.arange(batch_size) + jax.random.uniform(key, (batch_size,))) / batch_size
        indices = sum_tree.find(order.tree, part * total)
        probability = sum_tree.values(order.tree, indices) / total
        places = ((state.filled - order.length + 1) * num_envs).astype(jnp.float32)
        weights = (places * probability) ** -self.at(order.batches).beta
        return indices, weights / weights.max()


def _end(state: ReplayState) -> Int[Array, ""]:
    """Where the next row goes, counted from the ring's beginning: its length and not 0 where the ring has just become full."""
    return jnp.where((state.position == 0) & (state.filled > 0), state.storage.reward.shape[0], state.position)


def _require_length(state: ReplayState, length: int) -> None:
    if state.order.length != length:
        raise ValueError(
            f"this replay keeps priorities of sequences of {state.order.length} steps and was asked for sequences of {length}: "
            f"make it with init(..., length={length})"
        )
