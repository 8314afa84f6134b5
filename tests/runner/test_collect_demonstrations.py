"""`rtg collect`: whole episodes of a run's policy as a dataset."""

import json
import shutil

import jax
import numpy as np
import pytest

from rewardtogo.core import env_spec
from rewardtogo.data import Damaged, load_dataset
from rewardtogo.data.episodes import read_description
from rewardtogo.data.noise import EXPERT
from rewardtogo.envs.cartpole import dynamics
from rewardtogo.envs.registry import make
from rewardtogo.nn import MLP
from rewardtogo.runner import collect
from rewardtogo.runner.collect import collect_demonstrations
from rewardtogo.runner.folder import RunFolder
from rewardtogo.runner.plan import plan
from rewardtogo.runner.policy import save_policy


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Run folders of untrained policies, in CartPole and in Pendulum."""
    root = tmp_path_factory.mktemp("runs")
    for env in ("CartPole-v1", "Pendulum-v1"):
        made = plan("ppo", env, steps=1, preset="none", learner={"network": MLP(4)})
        spec, learner = env_spec(make(env, 1)), made.learner
        state = jax.jit(lambda key, spec=spec, learner=learner: learner.init(spec, key))(jax.random.key(0))
        folder = RunFolder(root / env)
        folder.path.mkdir()
        folder.write_config(made.config)
        save_policy(folder.path, learner, state, spec, {"algorithm": "ppo", "env": env})
    return root


def test_whole_episodes_exactly_as_many(runs, tmp_path):
    path, found = collect_demonstrations(runs / "CartPole-v1", episodes=7, out=tmp_path / "demo")
    dataset = load_dataset(path)
    assert path == tmp_path / "demo" and dataset.num_episodes == found["episodes"] == 7
    assert (found["steps"], found["return_mean"]) == (dataset.num_steps, pytest.approx(dataset.returns.mean()))
    t = dataset.transitions
    # What is stored is what the environment did: the pole follows from the state and the action.
    following = jax.jit(jax.vmap(lambda s, a: dynamics(s, a)))(t.observation, t.action)
    assert np.allclose(following, t.next_observation, atol=1e-5)
    about = read_description(path)["about"]
    assert (about["env"], about["deterministic"], about["collector"]["algorithm"]) == ("CartPole-v1", True, "ppo")


def test_the_same_seed_gives_the_same_bits(runs, tmp_path):
    made = [
        load_dataset(collect_demonstrations(runs / "CartPole-v1", 3, tmp_path / str(n), seed=seed)[0]).transitions
        for n, seed in enumerate((5, 5, 6))
    ]
    assert np.array_equal(made[0].observation, made[1].observation)
    assert not np.array_equal(made[0].observation[:3], made[2].observation[:3])


def test_sampled_actions_are_stored_as_the_environment_got_them(runs, tmp_path):
    path, _ = collect_demonstrations(runs / "Pendulum-v1", 2, tmp_path / "demo", deterministic=False)
    t = load_dataset(path).transitions
    action = np.asarray(t.action)
    # The standard deviation is half the box: about a third of the actions are clipped.
    assert 0.15 < np.mean(np.abs(action) == 2.0) < 0.5 and np.abs(action).max() == 2.0
    assert t.extras["log_prob"].shape == t.reward.shape


def test_noise_keeps_what_the_policy_chose(runs, tmp_path):
    path, _ = collect_demonstrations(runs / "CartPole-v1", 20, tmp_path / "demo", noise=0.5)
    t = load_dataset(path).transitions
    share = float(np.mean(np.asarray(t.action) != np.asarray(t.extras[EXPERT])))
    # Half of the actions are replaced, by the same one in half of the cases.
    assert abs(share - 0.25) < 4 * np.sqrt(0.25 * 0.75 / len(t.reward))
    following = jax.jit(jax.vmap(lambda s, a: dynamics(s, a)))(t.observation, t.action)
    assert np.allclose(following, t.next_observation, atol=1e-5)


def test_unequal_shares_of_given_environments(runs, tmp_path):
    path, found = collect_demonstrations(runs / "CartPole-v1", 5, tmp_path / "demo", env=make("CartPole-v1", 3))
    assert found["episodes"] == load_dataset(path).num_episodes == 5


def test_gymnasium_plays_too(runs, tmp_path):
    path, found = collect_demonstrations(runs / "CartPole-v1", 2, tmp_path / "demo", backend="gymnasium")
    assert found["episodes"] == load_dataset(path).num_episodes == 2


def test_rewards_are_the_environments_own(runs, tmp_path):
    """Even where the run divided them by their running deviation for its learner."""
    config = RunFolder(runs / "Pendulum-v1").config()
    divided = tmp_path / "divided"
    shutil.copytree(runs / "Pendulum-v1", divided)
    config["env"]["kwargs"] = {"normalise_reward": 0.9}
    (divided / "config.json").write_text(json.dumps(config))
    rewards = [
        load_dataset(collect_demonstrations(run, episodes=1, out=tmp_path / f"demo-{i}")[0]).transitions.reward
        for i, run in enumerate([runs / "Pendulum-v1", divided])
    ]
    assert np.array_equal(*rewards) and rewards[0].min() < -1


def test_folders_are_numbered(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = [collect_demonstrations(runs / "CartPole-v1", 1)[0].as_posix() for _ in range(2)]
    assert made == ["datasets/CartPole-v1-1", "datasets/CartPole-v1-2"]


def test_what_is_refused(runs, tmp_path, monkeypatch):
    run = runs / "CartPole-v1"
    with pytest.raises(ValueError, match="must be at least 1, not 0"):
        collect_demonstrations(run, episodes=0)
    with pytest.raises(Damaged, match="there is no run folder"):
        collect_demonstrations(tmp_path / "nothing")
    with pytest.raises(Damaged, match="is not a run folder"):
        collect_demonstrations(tmp_path)
    with pytest.raises(ValueError, match="never written over another one"):
        collect_demonstrations(run, out=runs)
    with pytest.raises(ValueError, match="the policy's observation space is"):
        collect_demonstrations(run, out=tmp_path / "demo", env="Pendulum-v1")
    with pytest.raises(ValueError, match="a probability from 0 to 1, not 2"):
        collect_demonstrations(run, noise=2.0)
    monkeypatch.setattr(collect, "MAX_STEPS", 1)
    with pytest.raises(ValueError, match="did not end within 128 steps"):
        collect_demonstrations(runs / "Pendulum-v1", 1, out=tmp_path / "demo")
    config = RunFolder(run).config()
    moved = RunFolder(tmp_path / "moved")
    moved.path.mkdir()
    moved.write_config({**config, "env": {**config["env"], "by_name": False}})
    for name in ("policy.json", "policy.safetensors"):
        (moved.path / name).write_bytes((run / name).read_bytes())
    with pytest.raises(ValueError, match="environment object"):
        collect_demonstrations(moved.path)
    assert not (tmp_path / "demo").exists()
