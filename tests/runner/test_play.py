"""`rtg play`: an episode as a film, of the compiled environment itself, or of Gymnasium's."""

import sys
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from PIL import Image

import rewardtogo as rtg
from rewardtogo.core import env_spec
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.drawing import picture
from rewardtogo.envs.probes import OneStep
from rewardtogo.envs.registry import COMPILED
from rewardtogo.envs.reward_wrappers import NormalizeReward, ScaleReward
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.runner.episode import played
from rewardtogo.runner.look_ahead import plan_by_name
from rewardtogo.runner.play import SECONDS, play
from rewardtogo.runner.policy import load


def frames_of(path):
    film: Any
    with Image.open(path) as film:
        frames = []
        for i in range(film.n_frames):
            film.seek(i)
            frames.append((np.asarray(film.convert("RGB"), int), film.info["duration"]))
    return frames


def stepped(env, policy, seed):
    """An episode by hand: pictures and rewards."""
    reset_key, carry_key, loop_key = jax.random.split(jax.random.key(seed), 3)
    state, observation = jax.jit(lambda k: env.reset(k))(reset_key)
    step = jax.jit(lambda s, a, k: env.step(s, a, k))
    choose = jax.jit(lambda c, o, k: policy(c, o, k))
    pictures: list[Any] = [picture(env, state, observation)]
    states, rewards = [state], []
    carry, over = policy.init(carry_key), False
    while not over:
        act_key, step_key = jax.random.split(jax.random.fold_in(loop_key, len(rewards)))
        carry, action, _ = choose(carry, observation, act_key)
        state, timestep = step(state, env_spec(env).action.clip(action), step_key)
        observation, over = timestep.observation, bool(timestep.terminated | timestep.truncated)
        rewards.append(float(timestep.reward))
        pictures.append(picture(env, state, observation, states))
        states.append(state)
    return pictures, rewards


@pytest.mark.parametrize(
    ("algorithm", "name", "stochastic"),
    [
        ("ppo", "Obstacles", True),
        ("ppo", "CartPole-v1", False),
        ("dqn", "TicTacToe", False),
        ("ppo", "PlanarNavigation", True),
    ],
)
def test_the_film_shows_the_episode_that_is_reported(untrained, algorithm, name, stochastic):
    network = (
        {"network": rtg.CNN(channels=(4,), kernels=(3,), strides=(2,), sizes=(8,))}
        if name == "PlanarNavigation"
        else {}
    )
    run = untrained(algorithm, name, **network)
    path, total, length = play(run, seed=1, stochastic=stochastic)
    pictures, rewards = stepped(COMPILED[name](), load(run).policy(explore=stochastic), 1)
    assert path == run / "episode.gif" and length == len(rewards) and total == pytest.approx(sum(rewards), abs=1e-3)
    frames = frames_of(path)
    # Equal frames are one frame that is shown for longer, so that there may be fewer than steps.
    assert 2 <= len(frames) <= length + 1 and frames[0][0].shape == pictures[0].shape
    # A film has 256 colours.
    for frame, wanted in ((frames[0][0], pictures[0]), (frames[-1][0], pictures[-1])):
        assert np.mean(np.abs(frame - wanted.astype(int)) > 40) < 0.002
    assert np.abs(frames[0][0] - frames[-1][0]).max() > 100
    # The end is shown for a second.
    assert frames[-1][1] >= 800
    if length > 2 * SECONDS:
        assert sum(d for _, d in frames) / 1000 == pytest.approx(SECONDS + 1, rel=0.25) or length > 50 * SECONDS


def test_the_seed_chooses_the_episode(untrained, tmp_path):
    run = untrained("ppo", "CartPole-v1")
    first = play(run, out=tmp_path / "new" / "a.gif", seed=0, stochastic=True)
    assert first[1:] == play(run, out=tmp_path / "b.gif", seed=0, stochastic=True)[1:]
    assert (tmp_path / "new" / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()
    assert len({play(run, out=tmp_path / "c.gif", seed=s, stochastic=True)[2] for s in range(4)}) > 1


@pytest.mark.parametrize("name", ["CartPoleNoVel-v1", "FrozenLake-v1", "Drone", "Tightrope"])
def test_wrapped_and_tabular_environments(untrained, name):
    path, _, length = play(untrained("ppo", name), stochastic=True)
    assert path.exists() and length > 0


def test_arguments_of_the_environment(untrained):
    run = untrained("ppo", "FrozenLake-v1", options={"env_kwargs": {"desc": ["SF", "FG"], "is_slippery": False}})
    path, total, length = play(run, stochastic=True)
    assert total == 1.0 and length >= 2 and frames_of(path)[0][0].shape[0] == frames_of(path)[0][0].shape[1]


def test_a_policy_that_plans_is_filmed(tmp_path):
    found = plan_by_name("random_shooting", "Obstacles", horizon=5, episodes=2, options={"samples": 50})
    path, total, length = found.film(tmp_path / "a.gif", 3)
    assert length == 100 and total == pytest.approx(float(found.returns.mean()), rel=0.6)
    env = COMPILED["Obstacles"]()
    assert total == pytest.approx(played(env, found.policy, jax.random.key(3), "Obstacles")[2], rel=1e-5)
    assert len(frames_of(path)) > 50


def test_an_environment_object(untrained, tmp_path):
    run = untrained("ppo", TimeLimit(CartPole(), 5))
    with pytest.raises(ValueError, match="give it from Python with play"):
        play(run)

    def made(**kwargs):
        return gymnasium.make("CartPole-v1", max_episode_steps=5, **kwargs)

    compiled = TimeLimit(CartPole(), 5)
    envs = [compiled, lambda: compiled, rtg.vectorize(compiled, 3), NormalizeReward(rtg.vectorize(compiled, 2), 0.9)]
    # A wrapper that scales rewards leaves the return that is reported.
    envs.append(ScaleReward(compiled, 7.0))
    for env in envs:
        assert play(run, out=tmp_path / "a.gif", env=env)[1:] == (5.0, 5)
    pytest.importorskip("pygame", reason="Gymnasium draws with the extra render")
    for env in (made, made(render_mode="rgb_array")):
        assert play(run, out=tmp_path / "a.gif", env=env)[1:] == (5.0, 5)
    with pytest.raises(ValueError, match="no picture of the kind rgb_array"):
        play(run, out=tmp_path / "a.gif", env=made())


def test_an_episode_in_gymnasiums_own(untrained):
    pytest.importorskip("pygame", reason="Gymnasium draws with the extra render")
    run = untrained("ppo", "CartPole-v1", options={"backend": "gymnasium"})
    path, total, length = play(run, seed=1)
    assert total == length
    env, policy = gymnasium.make("CartPole-v1"), load(run)
    observation, over, steps = env.reset(seed=1)[0], False, 0
    while not over:
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        over, steps = terminated or truncated, steps + 1
    assert steps == length
    frames = frames_of(path)
    assert 2 <= len(frames) <= length + 1 and frames[0][0].shape == (400, 600, 3)
    assert np.abs(frames[0][0] - frames[-1][0]).max() > 100 and frames[0][0].min() < 50


def test_wrong_requests(untrained, tmp_path):
    run = untrained("ppo", "CartPole-v1")
    with pytest.raises(ValueError, match=r"ending in .gif or .mp4, not to film.avi"):
        play(run, out="film.avi")
    with pytest.raises(ValueError, match="'last' or the 'best' one"):
        play(run, checkpoint="first")
    with pytest.raises(ValueError, match=r"OneStep has no picture: an environment that inherits `rtg.Drawn`"):
        play(untrained("ppo", "OneStep"))
    with pytest.raises(ValueError, match="was not trained in CartPole-v1: it observes or acts in other spaces"):
        play(run, out=tmp_path / "a.gif", env=OneStep())
    assert not (tmp_path / "a.gif").exists()


def test_missing_packages_are_named(untrained, monkeypatch, tmp_path):
    run = untrained("ppo", "CartPole-v1", options={"backend": "gymnasium"})
    assert play(untrained("ppo", "CartPole-v1"), out=tmp_path / "a.gif")[0].exists()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ValueError, match=r"pip install 'rewardtogo\[video\]'"):
        play(run, out=tmp_path / "film.mp4")
    assert not (tmp_path / "film.mp4").exists()
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(
        ValueError, match=r"drawn with pygame, which is not installed: pip install 'rewardtogo\[render\]'"
    ):
        play(run)


def test_mp4(untrained, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="an MP4 needs the extra video")
    path, _, _ = play(untrained("ppo", "CartPole-v1"), out=tmp_path / "film.mp4")
    assert path.read_bytes()[4:8] == b"ftyp"
