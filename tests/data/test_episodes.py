"""Item 2.4: datasets of whole episodes, in memory and in files."""

import json
from pathlib import Path

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import EnvSpec, from_space
from rewardtogo.data import Damaged, Dataset, concatenate, load_dataset, save_dataset
from rewardtogo.data.checks import require_spec
from rewardtogo.data.noise import check_noise

SPACES = {
    "box": {"observation": spaces.Box(-1.0, 1.0, (2, 3)), "action": spaces.Box(-2.0, 3.0, (2,))},
    "discrete": {"observation": spaces.Discrete(5), "action": spaces.Discrete(3, start=-1)},
    "factored": {"observation": spaces.MultiBinary(4), "action": spaces.MultiDiscrete([2, 3])},
    "bits": {"observation": spaces.Box(0, 255, (4, 4, 3), np.uint8), "action": spaces.MultiBinary(3)},
    "parts": {
        "observation": spaces.Dict(
            {"where": spaces.Box(-1.0, 1.0, (2,)), "deep": spaces.Dict({"k": spaces.Discrete(2)})}
        ),
        "action": spaces.Discrete(2),
    },
}


def differing_bytes(a: Dataset, b: Dataset) -> int:
    assert a.spec == b.spec and jax.tree.structure(a) == jax.tree.structure(b)
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    raw = lambda x: np.frombuffer(np.ascontiguousarray(x).tobytes(), np.uint8)  # noqa: E731
    return sum(
        int(np.sum(raw(x) != raw(y))) if x.dtype == y.dtype and x.shape == y.shape else x.nbytes for x, y in pairs
    )


@pytest.mark.parametrize("kind", SPACES)
def test_saving_and_loading_changes_no_bit(kind, walk_dataset, tmp_path, item):
    dataset = walk_dataset(**SPACES[kind], extras=kind == "box")
    save_dataset(tmp_path / "demo", dataset, {"env": "Walk-v0"})
    with item("2.4") as check:
        check(differing_bytes(dataset, load_dataset(tmp_path / "demo")), "==", 0, f"bytes changed, {kind}")


def test_many_files(walk_dataset, tmp_path, item):
    dataset = walk_dataset(lengths=(3, 1, 4, 2, 5))
    save_dataset(tmp_path / "demo", dataset, file_bytes=150)
    files = sorted(p.name for p in (tmp_path / "demo").glob("*.safetensors"))
    assert files == [f"episodes-{n:05d}.safetensors" for n in range(len(files))] and len(files) > 2
    with item("2.4") as check:
        check(differing_bytes(dataset, load_dataset(tmp_path / "demo")), "==", 0, "bytes changed, several files")


def test_what_dataset_json_says(walk_dataset, tmp_path):
    dataset = walk_dataset()
    save_dataset(tmp_path / "demo", dataset, {"env": "Walk-v0", "deterministic": True})
    said = json.loads((tmp_path / "demo" / "dataset.json").read_text())
    assert (said["episodes"], said["steps"], said["about"]["env"]) == (3, 8, "Walk-v0")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["demo"]


def test_a_failed_save_leaves_nothing(walk_dataset, tmp_path):
    with pytest.raises(TypeError):
        save_dataset(tmp_path / "demo", walk_dataset(), {"env": object()})
    assert not list(tmp_path.iterdir())


def test_bounds_lengths_returns(walk_dataset, item):
    dataset = walk_dataset()
    reward = np.asarray(dataset.transitions.reward, np.float64)
    assert dataset.bounds.tolist() == [0, 3, 4, 8] and dataset.lengths.tolist() == [3, 1, 4]
    assert (dataset.num_episodes, dataset.num_steps) == (3, 8)
    wanted = [reward[:3].sum(), reward[3], reward[4:].sum()]
    with item("2.4") as check:
        check(np.abs(dataset.returns - wanted).max(), "<=", 1e-12, "returns")
        check(
            differing_bytes(Dataset.of_trajectories(list(dataset.episodes()), dataset.spec), dataset),
            "==",
            0,
            "episodes",
        )


def test_split_and_concatenate(walk_dataset, key, item):
    dataset = walk_dataset(lengths=tuple(range(1, 11)))
    first, second = dataset.split(0.3, key)
    assert (first.num_episodes, second.num_episodes) == (3, 7)
    assert sorted([*first.lengths, *second.lengths]) == list(range(1, 11))
    whole = concatenate([first, second])
    order = np.argsort(whole.lengths)
    with item("2.4") as check:
        check(differing_bytes(whole.take(order), dataset), "==", 0, "split, concatenated, put in order")
    assert [d.num_episodes for d in dataset.split(1e-3, key)] == [1, 9]
    assert [d.num_episodes for d in dataset.split(0.999, key)] == [9, 1]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda d, k: d.split(0.0, k), "must lie between 0 and 1, not 0"),
        (lambda d, k: d.take([0]).split(0.5, k), "one episode cannot be split"),
        (lambda d, k: d.take([3]), "there is no episode 3"),
        (lambda d, k: d.take([]), "none was asked for"),
        (lambda d, k: concatenate([]), "no dataset was given"),
        (lambda d, k: d.with_noise(1.5, k), "a probability from 0 to 1, not 1.5"),
        (
            lambda d, k: check_noise(from_space(spaces.Box(-1, 1, (1,))), -1.0),
            "a standard deviation of at least 0, not -1",
        ),
    ],
)
def test_bad_requests(call, words, walk_dataset, key):
    with pytest.raises(ValueError, match=words):
        call(walk_dataset(), key)


def test_other_spaces_do_not_mix(walk_dataset):
    with pytest.raises(ValueError, match="another environment"):
        concatenate([walk_dataset(), walk_dataset(action=spaces.Discrete(4))])
    with pytest.raises(ValueError, match=r"keeps \['log_prob'\] of each step and another one \[\]"):
        concatenate([walk_dataset(extras=True), walk_dataset()])


def test_require_spec():
    spec = EnvSpec(from_space(spaces.Box(-1, 1, (2,))), from_space(spaces.Box(-1, 1, (1,))))
    wider = EnvSpec(from_space(spaces.Box(-9, 9, (2,))), spec.action)
    require_spec(spec, wider)
    for other, what in (
        (EnvSpec(from_space(spaces.Box(-1, 1, (3,))), spec.action), "observation"),
        (EnvSpec(spec.observation, from_space(spaces.Box(-2, 2, (1,)))), "action"),
    ):
        with pytest.raises(ValueError, match=f"the dataset's {what} space is"):
            require_spec(spec, other)


# --- what cannot be a dataset ------------------------------------------------------------------------------------------


def changed(row, **fields):
    return eqx.tree_at(lambda t: [getattr(t, n) for n in fields], row, [jnp.asarray(v) for v in fields.values()])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: jax.tree.map(lambda x: x[:0], t), "no episodes"),
        (
            lambda t: changed(t, reward=t.reward.at[3].set(jnp.nan)),
            "the reward of step 0 of episode 1 is NaN or infinite",
        ),
        (
            lambda t: changed(t, observation=t.observation.at[5, 1].set(jnp.inf)),
            "the observation of step 1 of episode 2",
        ),
        (lambda t: changed(t, terminated=t.terminated.at[-1].set(False)), "the last episode has no end"),
        (
            lambda t: changed(t, action=t.action.at[1].set(3)),
            "the action of step 1 of episode 0 is 3, which is outside",
        ),
        (lambda t: changed(t, action=t.action.at[7].set(-1)), "step 3 of episode 2 is -1"),
        (lambda t: changed(t, action=t.action[1:]), r"the action has shape \(7,\) for 8 steps"),
        (lambda t: changed(t, action=t.action.astype(jnp.float32)), "the action has the type float32"),
        (lambda t: changed(t, observation=t.observation[:, :1]), "the observation has shape"),
        (lambda t: changed(t, terminated=t.terminated.astype(jnp.int32)), "one truth value a step"),
        (lambda t: changed(t, terminated=t.terminated.at[2].set(False)), "step 2 of episode 0 is not the observation"),
    ],
)
def test_what_cannot_be_a_dataset(change, words, walk_transitions):
    row, spec = walk_transitions()
    with pytest.raises(ValueError, match=words) as caught:
        Dataset.of(change(row), spec)
    assert str(caught.value).count("\n") == 0


def test_actions_out_of_a_box(walk_transitions):
    row, spec = walk_transitions(action=spaces.Box(-2.0, 3.0, (2,)))
    with pytest.raises(ValueError, match="outside the action space"):
        Dataset.of(changed(row, action=row.action.at[0, 1].set(3.5)), spec)


def test_masks(walk_transitions, key):
    inner = spaces.Dict({"action_mask": spaces.MultiBinary(3), "x": spaces.Box(-1.0, 1.0, (1,))})
    row, spec = walk_transitions(observation=inner)
    forbidden = jnp.zeros((8, 3), jnp.int8).at[:, 0].set(1)
    observation = {**row.observation, "action_mask": forbidden}
    following = {**row.next_observation, "action_mask": forbidden}
    row = eqx.tree_at(
        lambda t: (t.observation, t.next_observation, t.action), row, (observation, following, row.action * 0)
    )
    dataset = Dataset.of(row, spec)
    assert not np.any(dataset.with_noise(1.0, key).transitions.action)
    with pytest.raises(ValueError, match="which its action_mask forbids"):
        Dataset.of(changed(row, action=row.action.at[4].set(1)), spec)


# --- files that cannot be used -----------------------------------------------------------------------------------------


def rewrite(path: Path, **changes) -> None:
    file = path / "dataset.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def no_file(path: Path) -> None:
    next(path.glob("*.safetensors")).unlink()


def cut_file(path: Path) -> None:
    file = next(path.glob("*.safetensors"))
    file.write_bytes(file.read_bytes()[:-20])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda p: (p / "dataset.json").unlink(), "is not a dataset: it has no dataset.json"),
        (lambda p: (p / "dataset.json").write_text("{"), "is damaged: it is not JSON"),
        (lambda p: (p / "dataset.json").write_text("[]"), "is not the description of a dataset"),
        (lambda p: rewrite(p, format=99), "format 99, which is newer"),
        (lambda p: rewrite(p, observation={}), "does not describe spaces and files"),
        (lambda p: rewrite(p, action={"kind": "discrete", "shape": []}), "does not describe spaces and files"),
        (lambda p: rewrite(p, files=[{}]), "does not describe spaces and files"),
        (lambda p: rewrite(p, files=[]), "has no episodes"),
        (lambda p: rewrite(p, episodes=4), "should have 4 episodes and 8 steps, and has 3 and 8"),
        (
            lambda p: rewrite(p, files=[{"name": "episodes-00000.safetensors", "episodes": 2, "steps": 8}]),
            "was expected",
        ),
        (no_file, "is missing"),
        (cut_file, "is damaged and cannot be read"),
    ],
)
def test_files_that_cannot_be_used(damage, words, walk_dataset, tmp_path):
    path = save_dataset(tmp_path / "demo", walk_dataset())
    damage(path)
    with pytest.raises(Damaged, match=words) as caught:
        load_dataset(path)
    assert str(caught.value).count("\n") == 0


def test_no_folder_and_a_full_folder(walk_dataset, tmp_path):
    with pytest.raises(Damaged, match="there is no dataset"):
        load_dataset(tmp_path / "nothing")
    (tmp_path / "full").mkdir()
    save_dataset(tmp_path / "full", walk_dataset())
    with pytest.raises(ValueError, match="never written over another one"):
        save_dataset(tmp_path / "full", walk_dataset())
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot be made"):
        save_dataset(tmp_path / "file" / "demo", walk_dataset())


def test_a_file_with_a_missing_end(walk_dataset, tmp_path):
    from safetensors.numpy import load_file, save_file

    path = save_dataset(tmp_path / "demo", walk_dataset())
    file = next(path.glob("*.safetensors"))
    arrays = load_file(file)
    arrays["['terminated']"][2] = False
    save_file(arrays, file, {"format": "1"})
    with pytest.raises(Damaged, match="should hold 3 whole episodes, and holds 2 ends"):
        load_dataset(path)


# --- noise -------------------------------------------------------------------------------------------------------------


def test_noise_on_choices(walk_dataset, key, item):
    dataset = walk_dataset(lengths=(200,) * 5)
    noisy = dataset.with_noise(0.3, key)
    share = float(np.mean(np.asarray(noisy.transitions.action) != np.asarray(dataset.transitions.action)))
    # A replacement is a different one of the 3 choices in 2 cases of 3.
    error = abs(share - 0.3 * 2 / 3) / np.sqrt(0.2 * 0.8 / 1000)
    with item("2.4") as check:
        check(error, "<=", 4.0, "standard errors of the share of changed actions")
        check(differing_bytes(dataset.with_noise(0.0, key), dataset), "==", 0, "without noise")
        check(
            float(jnp.abs(noisy.transitions.observation - dataset.transitions.observation).max()),
            "==",
            0.0,
            "observations",
        )


def test_noise_in_boxes(walk_dataset, key, item):
    dataset = walk_dataset(action=spaces.Box(-10.0, 10.0, (2,)), lengths=(200,) * 5)
    noisy = np.asarray(dataset.with_noise(0.05, key).transitions.action)
    before = np.asarray(dataset.transitions.action)
    inside = np.abs(before) < 7.0
    spread = np.std((noisy - before)[inside])
    with item("2.4") as check:
        check(abs(spread - 0.5) / (0.5 / np.sqrt(2 * inside.sum())), "<=", 4.0, "standard errors of the noise's sd")
        check(np.abs(noisy).max(), "<=", 10.0, "actions stay in their space")
