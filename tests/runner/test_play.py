"""`rtg play`: an episode of Gymnasium's environment as a film."""

import sys

import gymnasium
import numpy as np
import pytest
from PIL import Image

from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.registry import COMPILED
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.wrappers import MaskObservation
from rewardtogo.runner.play import MASKED, play
from rewardtogo.runner.policy import load

pytest.importorskip("pygame", reason="films need the extra render")


def test_the_film_shows_the_episode_that_is_reported(untrained):
    run = untrained("ppo", "CartPole-v1")
    path, total, length = play(run, seed=1)
    assert path == run / "episode.gif" and total == length
    env, policy = gymnasium.make("CartPole-v1"), load(run)
    observation, over, steps = env.reset(seed=1)[0], False, 0
    while not over:
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        over, steps = terminated or truncated, steps + 1
    assert steps == length
    with Image.open(path) as film:
        frames = film.n_frames
        first = np.asarray(film.convert("RGB"), float)
        film.seek(frames - 1)
        last = np.asarray(film.convert("RGB"), float)
    # Equal frames are one frame that is shown for longer, so that there may be fewer than steps.
    assert 2 <= frames <= length + 1 and first.shape == (400, 600, 3)
    assert np.abs(first - last).max() > 100 and first.min() < 50


def test_the_seed_chooses_the_episode(untrained, tmp_path):
    run = untrained("ppo", "CartPole-v1")
    first = play(run, out=tmp_path / "new" / "a.gif", seed=0, stochastic=True)
    assert first[1:] == play(run, out=tmp_path / "b.gif", seed=0, stochastic=True)[1:]
    assert len({play(run, out=tmp_path / "c.gif", seed=s, stochastic=True)[2] for s in range(4)}) > 1


def test_hidden_velocities_stay_hidden(untrained):
    path, _, length = play(untrained("ppo", "CartPoleNoVel-v1"))
    assert path.exists() and length > 0
    for name, (base, keep) in MASKED.items():
        limit = COMPILED[name]()
        assert isinstance(limit, TimeLimit) and isinstance(limit.env, MaskObservation)
        assert limit.env.keep == keep and limit.max_steps == gymnasium.spec(base).max_episode_steps


def test_an_environment_object(untrained, tmp_path):
    run = untrained("ppo", TimeLimit(CartPole(), 5))
    with pytest.raises(ValueError, match="give it from Python with play"):
        play(run)

    def made(**kwargs):
        return gymnasium.make("CartPole-v1", max_episode_steps=5, **kwargs)

    for env in (made, made(render_mode="rgb_array")):
        assert play(run, out=tmp_path / "a.gif", env=env)[1:] == (5.0, 5)
    with pytest.raises(ValueError, match="no picture of the kind rgb_array"):
        play(run, out=tmp_path / "a.gif", env=made())


def test_wrong_requests(untrained):
    run = untrained("ppo", "CartPole-v1")
    with pytest.raises(ValueError, match=r"ending in .gif or .mp4, not to film.avi"):
        play(run, out="film.avi")
    with pytest.raises(ValueError, match="'last' or the 'best' one"):
        play(run, checkpoint="first")
    with pytest.raises(ValueError, match="OneStep is one of the compiled environments without a picture"):
        play(untrained("ppo", "OneStep"))


def test_missing_packages_are_named(untrained, monkeypatch, tmp_path):
    run = untrained("ppo", "CartPole-v1")
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
