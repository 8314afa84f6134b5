"""A dataset that grows by whole episodes: what is added is what is read, files are whole whenever the process ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import EnvSpec, Spec
from rewardtogo.data import Damaged, Dataset, GrowingDataset, Trajectory, concatenate, load_dataset, save_dataset

SPEC = EnvSpec(Spec("box", (2,), low=(-10.0,), high=(10.0,)), Spec("discrete", (), "int32", counts=(3,)))
ABOUT = {"env": "Made-up", "collector": {"player": "test"}}


def episode(length: int, seed: int) -> Trajectory:
    draws = np.random.default_rng(seed)
    return Trajectory(
        jnp.asarray(draws.normal(size=(length + 1, 2)), jnp.float32),
        jnp.asarray(draws.integers(0, 3, length), jnp.int32),
        jnp.asarray(draws.normal(size=length), jnp.float32),
        jnp.asarray(seed % 2 == 0),
        jnp.asarray(seed % 2 == 1),
        {},
    )


def same(one: Dataset, other: Dataset) -> bool:
    leaves = [jax.tree.leaves(d.transitions) for d in (one, other)]
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in zip(*leaves, strict=True))


def test_it_is_the_dataset_of_its_episodes(tmp_path):
    episodes = [episode(length, seed) for seed, length in enumerate((5, 1, 9, 4))]
    growing = GrowingDataset(tmp_path / "data", SPEC, ABOUT)
    for number, one in enumerate(episodes[:3], 1):
        growing.add(one, begun=number)
        assert same(load_dataset(tmp_path / "data"), Dataset.of_trajectories(episodes[:number], SPEC))
    growing.close()
    again = GrowingDataset(tmp_path / "data", SPEC, ABOUT)
    assert again.lengths == [5, 1, 9] and again.about["begun"] == 3
    assert again.returns == pytest.approx([e.total for e in episodes[:3]])
    again.drop()
    again.add(episodes[3])
    again.close()
    wanted = Dataset.of_trajectories([*episodes[:2], episodes[3]], SPEC)
    assert same(load_dataset(tmp_path / "data"), wanted)
    assert same(concatenate([load_dataset(tmp_path / "data"), wanted]), concatenate([wanted, wanted]))


def test_an_episode_without_an_end_is_not_written(tmp_path):
    growing = GrowingDataset(tmp_path / "data", SPEC, ABOUT)
    one = episode(3, 0)
    endless = Trajectory(one.observations, one.actions, one.rewards, one.truncated, one.truncated, {})
    with pytest.raises(ValueError, match="the last episode has no end"):
        growing.add(endless)
    assert growing.num_episodes == 0 and not list((tmp_path / "data").glob("*.safetensors"))
    with pytest.raises(ValueError, match="has no episode that was added last"):
        growing.drop()
    growing.close()


def test_data_that_was_collected_is_left_alone(tmp_path):
    data = Dataset.of_trajectories([episode(3, 0), episode(2, 1)], SPEC)
    save_dataset(tmp_path / "data", data, {"env": "Made-up", "collector": {"run": "runs/x"}})
    with pytest.raises(
        ValueError, match=r"data is a dataset whose collector is \{'run': 'runs/x'\}, and here it is \{'player'"
    ):
        GrowingDataset(tmp_path / "data", SPEC, ABOUT, ("env", "collector"))
    other = EnvSpec(SPEC.observation, Spec("discrete", (), "int32", counts=(4,)))
    with pytest.raises(
        ValueError, match=r"data's action space is Discrete\(3\) and the environment's is Discrete\(4\)"
    ):
        GrowingDataset(tmp_path / "data", other, ABOUT)
    # Several episodes in one file stay where they are.
    growing = GrowingDataset(tmp_path / "data", SPEC, ABOUT)
    with pytest.raises(ValueError, match="has no episode that was added last"):
        growing.drop()
    growing.add(episode(4, 2))
    growing.drop()
    growing.close()
    assert same(load_dataset(tmp_path / "data"), data)
    (tmp_path / "data" / "episodes-00000.safetensors").write_bytes(b"nothing")
    with pytest.raises(Damaged, match=r"episodes-00000.safetensors is damaged"):
        GrowingDataset(tmp_path / "data", SPEC, ABOUT)
