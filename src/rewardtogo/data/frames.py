"""Pictures kept once: stacks of the last k pictures, and those of the next step, are rebuilt when they are drawn (Mnih et al. 2015).

A stack `[H, W, k C]`, oldest picture first along the last axis, shares k - 1 of its pictures with the one a step before, and with the
stack of the next step: stored as they come, every picture lies in memory 2 k times (a million stacks of four 84 x 84 pictures are 56 GB).
Here only the newest picture of every stack is stored, in a ring beside the replay's own, and what the ring cannot tell is kept apart:

- how many steps its episode had before a row, so that no stack reaches into the episode before: it repeats the episode's first
  picture, or is blank there, whichever the environment does;
- the true last picture of every episode, which no later row shows, in a ring of its own with room for `ENDINGS` of the rows;
- the picture after the newest row.

A replay whose episodes are shorter than 1 / `ENDINGS` steps loses its oldest last pictures. A terminated step is then given its own newest
picture in place of it, which no target looks at (its discount is 0); a truncated one the weight 0.

Stacks that do not follow these rules cannot be rebuilt. It shows when they are written, and the reward of such a step becomes NaN, which
stops a run: better no answer than another picture in silence.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt8

ENDINGS = 1 / 32
"""Room for the last pictures of episodes, as a part of the rows."""


class Frames(eqx.Module):
    """Pictures of one part of the observations of B environments.

    - `pictures`: a ring of the newest picture of each stack; longer than the replay's, so that the oldest row has its whole stack.
    - `position`: where the next picture goes.
    - `since`: for each row of the replay, the steps since its episode began, at most k - 1, and whether it began with a `blank` stack.
    - `ending`, `endings`, `ended`: the running number of a row's last picture, the ring of these, how many there were.
    - `ahead`: the picture after the newest row; `next_since` and `next_blank` of the row that comes next.
    """

    pictures: UInt8[Array, "P B H W C"]
    position: Int[Array, ""]
    since: Int[Array, "R B"]
    blank: Bool[Array, "R B"]
    ending: Int[Array, "R B"]
    endings: UInt8[Array, "F B H W C"]
    ended: Int[Array, "B"]
    ahead: UInt8[Array, "B H W C"]
    next_since: Int[Array, "B"]
    next_blank: Bool[Array, "B"]


def is_stack(x: jax.ShapeDtypeStruct | Array, frames: int) -> bool:
    """Whether a part `[T, B, ...]` of observations is a stack of `frames` pictures."""
    return x.dtype == jnp.uint8 and len(x.shape) == 5 and x.shape[-1] % frames == 0


def empty(example: jax.ShapeDtypeStruct | Array, rows: int, unroll: int, frames: int) -> Frames:
    """Room for `rows` steps of stacks like `example`, `[unroll, B, H, W, k C]`, written `unroll` at a time."""
    _, num_envs, height, width, depth = example.shape
    picture = (num_envs, height, width, depth // frames)
    spare = -(-(frames - 1) // unroll) * unroll
    endings = max(unroll, int(rows * ENDINGS))
    whole = lambda *shape: jnp.zeros(shape, jnp.int32)  # noqa: E731
    return Frames(
        jnp.zeros((rows + spare, *picture), jnp.uint8),
        whole(),
        whole(rows, num_envs).astype(jnp.int8),
        jnp.zeros((rows, num_envs), bool),
        whole(rows, num_envs),
        jnp.zeros((endings, *picture), jnp.uint8),
        whole(num_envs),
        jnp.zeros(picture, jnp.uint8),
        whole(num_envs).astype(jnp.int8),
        jnp.zeros(num_envs, bool),
    )


def write(
    state: Frames,
    observation: UInt8[Array, "T B H W K"],
    next_observation: UInt8[Array, "T B H W K"],
    done: Bool[Array, "T B"],
    position: Int[Array, ""],
) -> tuple[Frames, Bool[Array, "T B"]]:
    """A block of steps at row `position`, and which of them can be rebuilt."""
    depth = state.pictures.shape[-1]
    frames = observation.shape[-1] // depth
    newest, after = observation[..., -depth:], next_observation[..., -depth:]
    first = jnp.concatenate([newest] * (frames - 1), -1) if frames > 1 else newest[..., :0]
    older, same = observation[..., :-depth], lambda a, b: (a == b).all((-3, -2, -1))
    begins_blank, repeats = ~older.any((-3, -2, -1)), same(older, first)

    def step(loop: tuple[Array, Array, Array], now: tuple[Array, Array, Array]) -> tuple[tuple, tuple]:
        since, blank, ended = loop
        done, begins_blank, repeats = now
        start = since == 0
        blank = jnp.where(start, begins_blank & ~repeats, blank)
        following = jnp.where(done, 0, jnp.minimum(since + 1, frames - 1)).astype(jnp.int8)
        # A stack of one picture always begins an episode of its own, and has nothing older to be right or wrong.
        right = ~start | begins_blank | repeats
        return (following, blank, ended + done), (since, blank, ended, right)

    begin = (state.next_since, state.next_blank, state.ended)
    (next_since, next_blank, ended), (since, blank, ending, right) = jax.lax.scan(
        step, begin, (done, begins_blank, repeats)
    )
    right = right & same(next_observation[..., :-depth], observation[..., depth:])
    room = state.endings.shape[0]
    # A row outside of the ring is not written.
    place = jnp.where(done, ending % room, room)
    endings = state.endings.at[place, jnp.arange(done.shape[1])[None]].set(after, mode="drop")
    put = lambda ring, new, at: jax.lax.dynamic_update_slice_in_dim(ring, new, at, 0)  # noqa: E731
    written = Frames(
        put(state.pictures, newest, state.position),
        (state.position + done.shape[0]) % state.pictures.shape[0],
        put(state.since, since, position),
        put(state.blank, blank, position),
        put(state.ending, ending, position),
        endings,
        ended,
        after[-1],
        next_since,
        next_blank,
    )
    return written, right


def read(
    state: Frames,
    frames: int,
    row: Int[Array, "*N"],
    env: Int[Array, "*N"],
    done: Bool[Array, "*N"],
    position: Int[Array, ""],
) -> tuple[UInt8[Array, "*N H W K"], UInt8[Array, "*N H W K"], Bool[Array, "*N"]]:
    """The stacks of the observations and of the next observations of these rows, and where the last picture of an episode is lost.

    `position` is where the replay's next row goes.
    """
    size, rows = state.pictures.shape[0], state.since.shape[0]
    age = (position - 1 - row) % rows
    place = state.position - 1 - age
    since, ending = state.since[row, env].astype(jnp.int32), state.ending[row, env]
    back = jnp.broadcast_to(jnp.arange(frames - 1, -1, -1), (*row.shape, frames))
    from_start = jnp.minimum(back, since[..., None])
    stack = state.pictures[(place[..., None] - from_start) % size, env[..., None]]
    hidden = state.blank[row, env][..., None] & (back > since[..., None])
    stack = jnp.where(hidden[..., None, None, None], jnp.zeros((), jnp.uint8), stack)

    def where(condition: Array, one: Array, other: Array) -> Array:
        return jnp.where(condition[..., None, None, None], one, other)

    inside = where(age == 0, state.ahead[env], state.pictures[(place + 1) % size, env])
    lost = done & (state.ended[env] - ending > state.endings.shape[0])
    last = where(lost, stack[..., -1, :, :, :], state.endings[ending % state.endings.shape[0], env])
    after = where(done, last, inside)
    following = jnp.concatenate([stack[..., 1:, :, :, :], after[..., None, :, :, :]], -4)
    return _join(stack), _join(following), lost


def _join(stack: UInt8[Array, "*N k H W C"]) -> UInt8[Array, "*N H W K"]:
    """Pictures along a leading axis to pictures along the last one."""
    joined = jnp.moveaxis(stack, -4, -2)
    return joined.reshape(*joined.shape[:-2], -1)
