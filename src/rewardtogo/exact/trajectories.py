"""Trajectories: T actions and T + 1 observations, of unequal lengths side by side.

    τ = (o_0, a_0, r_0, o_1, ..., a_{T-1}, r_{T-1}, o_T)

The notes let a trajectory end at a_T and still multiply T transition probabilities; the last of them needs the state
it leads to (erratum E1.1). Keeping that last observation is also what a truncated episode bootstraps from (erratum
E1.5).

Source: notes, section 1.1.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..core import Transition

Arrays = Array | np.ndarray


class Trajectories(eqx.Module):
    """N episodes padded to T actions (item 1.8). Padding repeats the last observation and has reward 0.

    - `observations`: `[N, T + 1, ...]`; episode n ends in `observations[n, lengths[n]]`, before any reset.
    - `actions`, `rewards`, `extras` (such as `log_prob`): `[N, T, ...]`.
    - `lengths`: how many actions were taken.
    - `terminated`, `truncated`: how it ended, if it did.
    """

    observations: PyTree[Arrays]
    actions: PyTree[Arrays]
    rewards: Float[Arrays, "... T"]
    lengths: Int[Arrays, "..."]
    terminated: Bool[Arrays, "..."]
    truncated: Bool[Arrays, "..."]
    extras: dict[str, Arrays]

    @property
    def taken(self) -> Bool[Arrays, "N T"]:
        """Which steps are real and not padding."""
        return np.arange(self.rewards.shape[-1])[None] < self.lengths[:, None]

    def returns(self, discount: float | Arrays = 1.0) -> Float[Arrays, "N"]:
        """Σ_t γ^t r_t of each."""
        return (self.rewards * (np.ones(()) * discount) ** np.arange(self.rewards.shape[-1])[None]).sum(-1)


def split_episodes(transitions: Transition) -> Trajectories:
    """Consecutive steps `[T]` of one environment, cut where an episode ended; the last may be unfinished."""
    done = np.asarray(transitions.done)
    steps = len(done)
    ends = np.flatnonzero(done) + 1
    ends = np.append(ends, steps) if not len(ends) or ends[-1] < steps else ends
    starts = np.concatenate([[0], ends[:-1]])
    lengths = ends - starts
    # Step t of episode n is row starts[n] + t of the stream; padding repeats the last row.
    rows = starts[:, None] + np.minimum(np.arange(lengths.max()), lengths[:, None] - 1)
    taken = np.arange(lengths.max()) < lengths[:, None]
    pick = lambda x: np.asarray(x)[rows]  # noqa: E731
    first = lambda x: np.asarray(x)[starts][:, None]  # noqa: E731
    observations = jax.tree.map(
        lambda now, following: np.concatenate([first(now), pick(following)], 1),
        transitions.observation,
        transitions.next_observation,
    )
    return Trajectories(
        observations,
        jax.tree.map(pick, transitions.action),
        np.where(taken, pick(transitions.reward), np.zeros((), np.asarray(transitions.reward).dtype)),
        lengths,
        np.asarray(transitions.terminated)[ends - 1],
        np.asarray(transitions.truncated)[ends - 1],
        {name: pick(value) for name, value in transitions.extras.items()},
    )


def join_episodes(trajectories: Trajectories) -> Transition:
    """The inverse of `split_episodes`: all steps one after another, without the padding."""
    taken = np.asarray(trajectories.taken)
    last = np.arange(taken.shape[1]) == np.asarray(trajectories.lengths)[:, None] - 1
    pick = lambda x: jnp.asarray(np.asarray(x)[taken])  # noqa: E731
    return Transition(
        jax.tree.map(lambda x: pick(x[:, :-1]), trajectories.observations),
        jax.tree.map(pick, trajectories.actions),
        pick(trajectories.rewards),
        pick(last & np.asarray(trajectories.terminated)[:, None]),
        pick(last & np.asarray(trajectories.truncated)[:, None]),
        jax.tree.map(lambda x: pick(x[:, 1:]), trajectories.observations),
        {name: pick(value) for name, value in trajectories.extras.items()},
    )
