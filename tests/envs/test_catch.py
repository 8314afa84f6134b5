"""Catch, played by hand and by the best policy; and memories of its pictures, stored once and stored whole."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.envs import Catch, FrameStack
from rewardtogo.envs.catch import CatchState

KEY = jax.random.key(0)


def play(column: int, actions: list[int]) -> tuple[list[np.ndarray], list[float], list[bool]]:
    """Pictures, rewards and ends of one episode by NumPy alone."""
    paddle, pictures, rewards, ends = 2, [], [], []
    for row, action in enumerate(actions, 1):
        paddle = min(4, max(0, paddle + action - 1))
        board = np.zeros((10, 5), np.uint8)
        board[row, column] = board[9, paddle] = 255
        pictures.append(board[..., None])
        rewards.append(0.0 if row < 9 else 1.0 if paddle == column else -1.0)
        ends.append(row == 9)
    return pictures, rewards, ends


@pytest.mark.parametrize("column", range(5))
def test_steps_are_those_played_by_hand(column):
    actions = np.random.default_rng(column).integers(0, 3, (20, 9))
    state = CatchState(*(jnp.asarray(x, jnp.int32) for x in (0, column, 2)))
    episode = lambda a: jax.lax.scan(lambda s, a: Catch().step(s, a, KEY), state, a)[1]  # noqa: E731
    found = jax.device_get(jit(jax.vmap(episode))(jnp.asarray(actions)))
    for i, sequence in enumerate(actions.tolist()):
        pictures, rewards, ends = play(column, sequence)
        np.testing.assert_array_equal(found.observation[i], np.stack(pictures))
        assert found.reward[i].tolist() == rewards and found.terminated[i].tolist() == ends
        assert not found.truncated.any()


def test_the_best_policy_never_misses_and_chance_is_as_computed(item):
    """Optimum 1, from every column. At random the paddle meets the ball with chance 1/5: its column does not depend on any move."""
    random_return = 2 / 5 - 1

    def episode(key: jax.Array, wise: bool) -> jax.Array:
        state, _ = Catch().reset(key)

        def step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            action = 1 + jnp.sign(state.column - state.paddle) if wise else jax.random.randint(key, (), 0, 3)
            state, timestep = Catch().step(state, action, key)
            return state, timestep.reward

        return jax.lax.scan(step, state, jax.random.split(key, 9))[1].sum()

    keys = jax.random.split(KEY, 4000)
    best, worst = (jit(jax.vmap(lambda k, w=w: episode(k, w)))(keys) for w in (True, False))
    with item("6.6") as check:
        check(float(best.min()), "==", 1.0, "Catch: return of the best policy, the worst of 4000 episodes")
        check(
            abs(float(worst.mean()) - random_return), "<=", 0.05, "Catch: return at random beside -0.6 by enumeration"
        )
    assert random_return == pytest.approx(-0.6)


@pytest.mark.parametrize("memory", [rtg.UniformReplay, rtg.PrioritisedReplay])
def test_learning_from_pictures_stored_once_is_learning_from_all_of_them(memory, item):
    """The same bits in the network after twenty updates, through the seam of the ring."""
    env = rtg.vectorize(FrameStack(Catch(5, 3), 3), 4)
    learner = rtg.DQN(network=rtg.CNN((2,), (3,), (1,), (4,)), epsilon=0.3, target_period=3)
    found = []
    for frames in (3, 0):
        loop = rtg.OffPolicy(env, learner, memory(96, frames=frames), unroll=4, warm_up=64, batch_size=16)
        loop = loop.with_horizon(20)
        many = lambda key, loop=loop: jax.lax.fori_loop(  # noqa: E731
            0, 20, lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0], loop.init(key)
        )
        found.append(jax.device_get(jit(many)(KEY)))
    once, whole = (jax.tree.leaves(s.learner) for s in found)
    gaps = [np.abs(np.float64(a) - np.float64(b)).max() for a, b in zip(once, whole, strict=True)]
    with item("6.2") as check:
        check(max(gaps), "==", 0.0, f"parameters after 20 updates, frames once or whole, {memory.__name__}")
    assert int(found[0].learner.updates) == 20 and np.isfinite(once[0]).all()


@pytest.mark.parametrize(("rows", "columns"), [(1, 5), (10, 0)])
def test_boards_without_room_are_refused(rows, columns):
    with pytest.raises(ValueError, match="at least 2 rows and 1 column"):
        Catch(rows, columns)
