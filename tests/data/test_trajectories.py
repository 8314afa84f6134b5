"""Item 1.8: T actions between T + 1 observations, cut and put back together."""

import jax
import numpy as np
import pytest

from rewardtogo.data import join_episodes, split_episodes


def differences(a, b) -> int:
    """How many numbers of two trees differ; trees of different structure do not compare at all."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return sum(int(x.dtype != y.dtype) + int(np.sum(np.asarray(x) != np.asarray(y))) for x, y in pairs)


def test_shapes_and_round_trip(walk_transitions, item):
    row, _ = walk_transitions(lengths=(3, 1, 4, 2), extras=True)
    episodes = split_episodes(row)
    with item("1.8") as check:
        check(len(episodes), "==", 4, "trajectories")
        for episode, length in zip(episodes, (3, 1, 4, 2), strict=True):
            check(len(episode.actions), "==", length, "actions")
            check(len(episode.extras["log_prob"]), "==", length, "log-probabilities")
            check(len(episode.observations), "==", length + 1, "observations")
        check(differences(join_episodes(episodes), row), "==", 0, "numbers that a round trip changed")
        check(differences(split_episodes(join_episodes(episodes[1:3])), episodes[1:3]), "==", 0, "the other way round")


def test_return_is_the_sum_of_rewards(walk_transitions, item):
    row, _ = walk_transitions()
    reward = np.asarray(row.reward, np.float64)
    with item("1.8") as check:
        for episode, wanted in zip(split_episodes(row), (reward[:3].sum(), reward[3], reward[4:].sum()), strict=True):
            check(abs(episode.total - wanted), "<=", 1e-12, "return against the sum of rewards")


def test_the_last_observation_is_kept_either_way(walk_transitions, item):
    row, _ = walk_transitions()
    with item("1.8") as check:
        for episode, end in zip(split_episodes(row), (2, 3, 7), strict=True):
            error = np.abs(np.asarray(episode.observations[-1]) - np.asarray(row.next_observation[end])).max()
            check(error, "==", 0.0, "truncated" if episode.truncated else "terminated")


def test_a_piece_without_an_end(walk_transitions):
    row, _ = walk_transitions()
    piece = split_episodes(jax.tree.map(lambda x: x[:6], row))[-1]
    assert len(piece) == 2 and not piece.terminated and not piece.truncated
    assert differences(join_episodes([piece]), jax.tree.map(lambda x: x[4:6], row)) == 0


def test_nothing_to_join():
    with pytest.raises(ValueError, match="no trajectory was given"):
        join_episodes([])
