"""Where a replay keeps its steps: a ring of rows `[rows, B, ...]`, one step of each of B environments a row, written in blocks.

Consecutive steps of an environment are consecutive rows, so that whole sequences can be drawn. With `frames`, every part of the
observation that is a stack of so many pictures is kept picture by picture (`frames.py`); everything else as it comes, 8 bits as 8 bits.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..core import Transition
from . import frames as pictures
from .frames import Frames


def rows_of(capacity: int, unroll: int, num_envs: int) -> int:
    """Rows of a ring of at most `capacity` steps, a whole number of blocks. Raises `ValueError` where not one fits."""
    rows = capacity // (num_envs * unroll) * unroll
    if rows == 0:
        raise ValueError(
            f"a replay of {capacity} transitions cannot hold one block of {unroll} steps in {num_envs} environments: "
            f"give it a capacity of at least {unroll * num_envs}"
        )
    return rows


def empty(example: Transition, rows: int, unroll: int, frames: int) -> Transition:
    """An empty ring for blocks `[unroll, B, ...]` like `example`, of which only shapes and types are used.

    Raises `ValueError` where `frames` is given and no part of the observation is a stack of so many pictures.
    """
    make = lambda x: jnp.zeros((rows, *x.shape[1:]), x.dtype)  # noqa: E731
    ring = jax.tree.map(make, example)
    if not frames:
        return ring
    stacks = [pictures.is_stack(x, frames) for x in jax.tree.leaves(example.observation)]
    if not any(stacks):
        shapes = ", ".join(f"{x.dtype} {tuple(x.shape[2:])}" for x in jax.tree.leaves(example.observation))
        raise ValueError(
            f"a replay with frames={frames} keeps pictures, uint8 of [height, width, channels] with {frames} in each stack, and this "
            f"environment observes {shapes}: use frames=0, which keeps observations as they come"
        )
    keep = lambda x: pictures.empty(x, rows, unroll, frames) if pictures.is_stack(x, frames) else make(x)  # noqa: E731
    nothing = lambda x: jnp.zeros((0,), x.dtype) if pictures.is_stack(x, frames) else make(x)  # noqa: E731
    return dataclasses.replace(
        ring,
        observation=jax.tree.map(keep, example.observation),
        next_observation=jax.tree.map(nothing, example.next_observation),
    )


def _is_frames(x: object) -> bool:
    return isinstance(x, Frames)


def write(ring: Transition, block: Transition, position: Int[Array, ""]) -> Transition:
    """The ring with a block `[unroll, B, ...]` at row `position`."""
    put = lambda ring, new: jax.lax.dynamic_update_slice_in_dim(ring, new, position, 0)  # noqa: E731
    kept, shape = jax.tree.flatten(ring.observation, is_leaf=_is_frames)
    if not any(_is_frames(x) for x in kept):
        return jax.tree.map(put, ring, block)
    seen, following, reward = [], [], block.reward
    leaves = (kept, *(jax.tree.leaves(x) for x in (ring.next_observation, block.observation, block.next_observation)))
    for old, old_next, new, new_next in zip(*leaves, strict=True):
        if isinstance(old, Frames):
            written, right = pictures.write(old, new, new_next, block.done, position)
            reward = jnp.where(right, reward, jnp.nan)
            seen, following = [*seen, written], [*following, old_next]
        else:
            seen, following = [*seen, put(old, new)], [*following, put(old_next, new_next)]
    rest = lambda t: (t.action, t.reward, t.terminated, t.truncated, t.extras)  # noqa: E731
    block = dataclasses.replace(block, reward=reward)
    action, reward, terminated, truncated, extras = jax.tree.map(put, rest(ring), rest(block))
    whole = jax.tree.unflatten
    return Transition(whole(shape, seen), action, reward, terminated, truncated, whole(shape, following), extras)


def read(
    ring: Transition, frames: int, row: Int[Array, "*N"], env: Int[Array, "*N"], position: Int[Array, ""]
) -> tuple[Transition, Bool[Array, "*N"]]:
    """These steps, and which of them must not be learnt from: truncated ones whose last picture is lost.

    They are read in two halves, one after the other in a loop. Out of a loop XLA fuses the writing of a row into the reading, needs the
    ring as it was and as it is for that, and copies all of it at every step: 19 ms of a million steps in HalfCheetah.
    """
    count = row.size
    half = -(-count // 2)
    flat = jnp.stack([row.reshape(-1), env.reshape(-1)], -1)
    halves = jnp.concatenate([flat, flat[: 2 * half - count]]).reshape(2, half, 2)
    found = jax.lax.map(lambda which: _read(ring, frames, which[:, 0], which[:, 1], position), halves)
    return jax.tree.map(lambda x: x.reshape(2 * half, *x.shape[2:])[:count].reshape(*row.shape, *x.shape[2:]), found)


def _read(
    ring: Transition, frames: int, row: Int[Array, "N"], env: Int[Array, "N"], position: Int[Array, ""]
) -> tuple[Transition, Bool[Array, "N"]]:
    kept, shape = jax.tree.flatten(ring.observation, is_leaf=_is_frames)
    take = lambda x: x[row, env]  # noqa: E731
    if not any(_is_frames(x) for x in kept):
        return jax.tree.map(take, ring), jnp.zeros(row.shape, bool)
    terminated, truncated = take(ring.terminated), take(ring.truncated)
    seen, following, spoilt = [], [], jnp.zeros(row.shape, bool)
    for old, old_next in zip(kept, jax.tree.leaves(ring.next_observation), strict=True):
        if isinstance(old, Frames):
            now, after, lost = pictures.read(old, frames, row, env, terminated | truncated, position)
            spoilt = spoilt | (lost & ~terminated)
        else:
            now, after = take(old), take(old_next)
        seen, following = [*seen, now], [*following, after]
    whole, extras = jax.tree.unflatten, jax.tree.map(take, ring.extras)
    action, reward = jax.tree.map(take, (ring.action, ring.reward))
    steps = Transition(whole(shape, seen), action, reward, terminated, truncated, whole(shape, following), extras)
    return steps, spoilt


def weights_of(spoilt: Bool[Array, "*T N"]) -> Float[Array, "N"]:
    """1 for each sample, 0 where a step of it must not be learnt from."""
    return 1.0 - spoilt.reshape(-1, spoilt.shape[-1]).any(0).astype(jnp.float32)
