"""Atari games behind the door: preparation, both ends of an episode, lives, scores, and a memory that stores each picture once."""

import importlib.util
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.envs import atari
from rewardtogo.envs.atari import Atari, Game
from rewardtogo.runner.plan import plan

needs_ale = pytest.mark.skipif(importlib.util.find_spec("ale_py") is None, reason="ale-py is not installed")
SMALL = {"size": 20, "num_threads": 1}


def roll(env: Any, steps: int, seed: int = 0) -> Any:
    """First observation and timesteps `[T, B]` of random play in one compiled scan, as NumPy."""
    keys = jax.random.split(jax.random.key(seed), env.num_envs)
    actions = jax.random.randint(jax.random.key(seed), (steps, env.num_envs), 0, int(env.action_space.n))

    @jax.jit
    def program(actions: Any, keys: Any) -> Any:
        state, first = env.reset(keys)
        return first, jax.lax.scan(lambda s, a: env.step(s, a, keys), state, actions)[1]

    return jax.tree.map(np.asarray, jax.block_until_ready(program(actions, keys)))


@needs_ale
@pytest.mark.parametrize("by_life", [False, True])
def test_stacks_follow_each_other_and_ends_keep_their_last_picture(by_life):
    """Breakout at random loses five lives in some 200 steps; the limit of frames cuts some games before."""
    env = rtg.make("ALE/Breakout-v5", 3, episodic_life=by_life, max_frames=480, **SMALL)
    first, t = roll(env, 400)
    assert env.observation_space.shape == (20, 20, 4) and t.observation.dtype == np.uint8
    before = np.concatenate([first[None], t.observation[:-1]])
    np.testing.assert_array_equal(t.final_observation[..., :-1], before[..., 1:])
    ended = t.terminated | t.truncated
    np.testing.assert_array_equal(t.observation[~ended], t.final_observation[~ended])
    assert not t.observation[ended][..., :-1].any() and t.observation[ended][..., -1].any()
    assert t.final_observation[ended][..., -1].any()
    assert t.truncated.any() and not (t.truncated & t.terminated).any()
    assert (t.terminated.sum() > 10) if by_life else (t.terminated.sum() < 10)


@needs_ale
def test_rewards_are_cut_and_scores_are_not():
    """Ms Pacman pays 10 and more for a step."""
    _, t = roll(rtg.make("ALE/MsPacman-v5", 2, **SMALL), 150)
    assert t.reward.max() == 1.0 and t.extras["raw_reward"].max() >= 10.0
    np.testing.assert_array_equal(t.reward, np.clip(t.extras["raw_reward"], -1, 1))
    _, whole = roll(rtg.make("ALE/MsPacman-v5", 2, clip_rewards=False, **SMALL), 150)
    np.testing.assert_array_equal(whole.reward, t.extras["raw_reward"])
    again = roll(rtg.make("ALE/MsPacman-v5", 2, **SMALL), 150)[1]
    np.testing.assert_array_equal(again.observation, t.observation)  # the seed decides everything


@needs_ale
def test_the_end_of_a_game_keeps_its_score():
    """Freeway and the like pay in the last step too: the sum of scores is that of a plain loop."""
    games = Atari("ALE/Pong-v5", 2, {"max_frames": 200, "size": 20})
    games.reset(seed=0)
    for _ in range(60):
        _, reward, terminated, truncated, info = games.step(np.zeros(2, np.int32))
        if (terminated | truncated).any():
            np.testing.assert_array_equal(info["final_info"]["raw_reward"], info["raw_reward"])
            assert info["final_obs"].shape == (2, 20, 20, 4)
            break
    else:
        raise AssertionError("no game was cut")
    assert truncated.any() and np.isfinite(reward).all()


@needs_ale
@pytest.mark.parametrize("by_life", [False, True])
def test_a_memory_of_single_pictures_is_that_of_everything(by_life):
    """Bit for bit, on Breakout itself: no reward became NaN, and every batch is the same."""
    env = rtg.make("ALE/Breakout-v5", 2, episodic_life=by_life, max_frames=480, **SMALL)
    first, t = roll(env, 160)
    observation = np.concatenate([first[None], t.observation[:-1]])
    none = np.zeros(t.reward.shape, np.int32)
    steps = rtg.Transition(
        *(jnp.asarray(x) for x in (observation, none, t.reward, t.terminated, t.truncated, t.final_observation)), {}
    )
    batches = []
    for frames in (4, 0):
        memory = rtg.UniformReplay(240, frames=frames)

        @jax.jit
        def fill(steps: Any, memory: Any = memory) -> Any:
            state = memory.init(jax.tree.map(lambda x: x[:40], steps), 40)
            for i in range(0, 160, 40):
                state = memory.add(state, jax.tree.map(lambda x: x[i : i + 40], steps))  # noqa: B023
            return memory.sample(state, jax.random.key(0), 500)

        batches.append(fill(steps))
    jax.tree.map(np.testing.assert_array_equal, *batches)
    assert np.isfinite(batches[0].transitions.reward).all()
    assert (batches[0].transitions.truncated | batches[0].transitions.terminated).any()


@needs_ale
def test_a_game_to_watch_is_the_one_that_is_played():
    game = Game("ALE/Pong-v5", render_mode="rgb_array", **SMALL)
    observation, _ = game.reset(seed=3)
    assert observation.shape == (20, 20, 4) and game.render().shape == (80, 80, 3)
    for _ in range(5):
        observation, reward, terminated, truncated, _ = game.step(2)
        assert game.observation_space.contains(observation) and not (terminated or truncated)
    np.testing.assert_array_equal(game.render()[::4, ::4, 0], observation[..., -1])
    assert isinstance(reward, float)


@needs_ale
def test_the_preset_stores_pictures_once():
    made = plan("dqn", "ALE/Pong-v5", steps=100, num_envs=2, env_kwargs=SMALL)
    assert made.algorithm.replay == rtg.UniformReplay(100_000, frames=4)  # type: ignore[attr-defined]
    assert made.config["env"]["id"] == "ALE/Pong-v5"


@needs_ale
@pytest.mark.parametrize(
    ("name", "options", "match"),
    [
        ("ALE/Pongg-v5", {}, "no Atari game 'ALE/Pongg-v5': did you mean ALE/Pong-v5"),
        ("ALE/Pong-v5", {"frameskip": 4}, "no option 'frameskip': did you mean frame_skip"),
        ("ALE/Pong-v5", {"stack": 0}, "stack .* at least 1, not 0"),
        ("ALE/Pong-v5", {"clip_rewards": 1}, "clip_rewards .* true or false"),
        ("ALE/Pong-v5", {"repeat_action_probability": 2}, r"in \[0, 1\], not 2"),
    ],
)
def test_what_cannot_be_is_refused(name, options, match):
    with pytest.raises(ValueError, match=match):
        rtg.make(name, 1, **options)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ale_py", None)
    with pytest.raises(ValueError, match=r"rewardtogo\[atari\]"):
        atari.Atari("ALE/Pong-v5")
