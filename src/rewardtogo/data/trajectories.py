"""Trajectories: T actions between T + 1 observations (notes 1.1, erratum E1.1), cut out of transitions and put back.

The last observation is kept whether the episode was terminated or truncated (erratum E1.5), since a truncated one's
value counts. The return is R = sum_t r_t, without a discount.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..core import Action, Observation, Transition


class Trajectory(eqx.Module):
    """One episode, or a piece of one.

    - `observations`: `[T + 1]`, the last one is where the last action led.
    - `actions`, `rewards`: `[T]`.
    - `terminated`, `truncated`: how it ended; neither where it is a piece that goes on elsewhere.
    - `extras`: `[T]`, what the policy said of each action, such as `log_prob`.
    """

    observations: Observation
    actions: Action
    rewards: Float[Array, "T"]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    extras: dict[str, Array]

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def total(self) -> float:
        """The return: the sum of the rewards."""
        return float(np.sum(np.asarray(self.rewards), dtype=np.float64))


def episode_bounds(done: Bool[np.ndarray, "N"]) -> np.ndarray:
    """Where episodes begin and end in N steps, `[E + 1]`: episode e is steps `bounds[e]` to `bounds[e + 1] - 1`.

    Steps after the last end, if there are any, count as an episode of their own.
    """
    ends = np.flatnonzero(done) + 1
    whole = len(ends) > 0 and ends[-1] == len(done)
    return np.concatenate([[0], ends, [] if whole or not len(done) else [len(done)]]).astype(np.int64)


def split_episodes(transitions: Transition) -> list[Trajectory]:
    """The trajectories in a row of transitions `[N]` of one environment, in order; the last one may be a piece."""
    host: Transition = jax.tree.map(np.asarray, transitions)
    bounds = episode_bounds(np.asarray(host.terminated | host.truncated))
    return [_cut(host, int(start), int(stop)) for start, stop in itertools.pairwise(bounds)]


def join_episodes(trajectories: Sequence[Trajectory]) -> Transition:
    """The inverse of `split_episodes`: one row of transitions `[N]`."""
    if not trajectories:
        raise ValueError("no trajectory was given, so there are no transitions: give at least one")
    rows = [_row(trajectory) for trajectory in trajectories]
    return jax.tree.map(lambda *parts: jnp.asarray(np.concatenate(parts)), *rows)


def _cut(t: Transition, start: int, stop: int) -> Trajectory:
    part = lambda tree: jax.tree.map(lambda x: jnp.asarray(x[start:stop]), tree)  # noqa: E731
    final = jax.tree.map(lambda x: x[stop - 1 : stop], t.next_observation)
    observations = jax.tree.map(
        lambda x, last: jnp.asarray(np.concatenate([x[start:stop], last])), t.observation, final
    )
    end = stop - 1
    return Trajectory(
        observations,
        part(t.action),
        part(t.reward),
        jnp.asarray(t.terminated[end]),
        jnp.asarray(t.truncated[end]),
        part(t.extras),
    )


def _row(trajectory: Trajectory) -> Any:
    host: Trajectory = jax.tree.map(np.asarray, trajectory)
    last = np.arange(len(host.rewards)) == len(host.rewards) - 1
    before = jax.tree.map(lambda x: x[:-1], host.observations)
    after = jax.tree.map(lambda x: x[1:], host.observations)
    # Through JAX's types only at the end: a conversion of every piece costs more than the pieces.
    leaves = (before, host.actions, host.rewards, last & host.terminated, last & host.truncated, after, host.extras)
    names = ("observation", "action", "reward", "terminated", "truncated", "next_observation", "extras")
    return Transition(**jax.tree.map(jnp.asarray, dict(zip(names, leaves, strict=True))))
