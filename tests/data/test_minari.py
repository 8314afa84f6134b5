"""Datasets to Minari and back."""

import sys

import gymnasium.spaces as spaces
import numpy as np
import pytest

from rewardtogo.data import Damaged, from_minari, load_dataset, to_minari

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

SPACES = {
    "box": {"observation": spaces.Box(-1.0, 1.0, (3,)), "action": spaces.Box(-2.0, 3.0, (2,))},
    "discrete": {"observation": spaces.Discrete(5, start=2), "action": spaces.Discrete(3, start=-1)},
    "pictures": {"observation": spaces.Box(0, 255, (4, 4, 3), np.uint8), "action": spaces.MultiDiscrete([2, 3])},
    "parts": {
        "observation": spaces.Dict({"a": spaces.Box(-1.0, 1.0, (2,)), "b": spaces.Discrete(2)}),
        "action": spaces.MultiBinary(2),
    },
}


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("kind", SPACES)
def test_round_trip(kind, walk_dataset, root, item):
    import jax

    dataset = walk_dataset(**SPACES[kind])
    path = to_minari(dataset, f"walk/{kind}-v0", algorithm="random", author="me", description="a walk")
    assert path == root / f"walk/{kind}-v0"
    for name in (f"walk/{kind}-v0", path):
        back = from_minari(name)
        assert back.spec == dataset.spec
        pairs = zip(jax.tree.leaves(back), jax.tree.leaves(dataset), strict=True)
        with item("2.4") as check:
            check(
                sum(int(np.sum(np.asarray(a) != np.asarray(b))) for a, b in pairs), "==", 0, f"numbers changed, {kind}"
            )
    assert load_dataset(f"minari:walk/{kind}-v0").num_steps == dataset.num_steps


def test_minari_sees_what_was_written(walk_dataset):
    dataset = walk_dataset(action=spaces.Discrete(3, start=-1))
    to_minari(dataset, "walk/seen-v0")
    theirs = minari.load_dataset("walk/seen-v0")
    assert (theirs.total_episodes, theirs.total_steps) == (3, 8)
    actions = np.concatenate([episode.actions for episode in theirs])
    assert np.array_equal(actions, np.asarray(dataset.transitions.action) - 1)
    assert all(len(episode.observations) == len(episode.actions) + 1 for episode in theirs)
    assert [bool(e.terminations[-1]) for e in theirs] == [True, False, True]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_an_episode_without_a_flag_is_truncated(root):
    buffer = minari.data_collector.EpisodeBuffer(
        id=0,
        observations=np.zeros((3, 2), np.float32),
        actions=np.array([[1.0], [1.0 + 1e-4]], np.float32),
        rewards=[1.0, 2.0],
        terminations=[False, False],
        truncations=[False, False],
    )
    box = spaces.Box(-1.0, 1.0, (1,))
    options = {"observation_space": spaces.Box(-1.0, 1.0, (2,)), "action_space": box, "data_format": "hdf5"}
    minari.create_dataset_from_buffers("walk/open-v0", [buffer], **options)
    dataset = from_minari("walk/open-v0")
    assert dataset.transitions.truncated.tolist() == [False, True] and not dataset.transitions.terminated.any()
    assert float(dataset.transitions.action.max()) == 1.0


def test_what_cannot_be(walk_dataset, root, monkeypatch):
    with pytest.raises(Damaged, match="there is no Minari dataset walk/none-v0 on this machine"):
        from_minari("walk/none-v0")
    to_minari(walk_dataset(), "walk/twice-v0")
    with pytest.raises(ValueError, match="already exists"):
        to_minari(walk_dataset(), "walk/twice-v0")
    metadata = root / "walk" / "twice-v0" / "data" / "metadata.json"
    metadata.write_text("{}")
    with pytest.raises(Damaged, match="does not state its spaces"):
        from_minari("walk/twice-v0")
    metadata.write_text("{")
    with pytest.raises(Damaged, match=r"no metadata\.json that can be read"):
        from_minari("walk/twice-v0")
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ValueError, match=r"rewardtogo\[minari\]"):
        from_minari("walk/twice-v0")
