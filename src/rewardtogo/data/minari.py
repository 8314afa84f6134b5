"""Datasets from and to Minari, the Farama Foundation's format of offline data (Younis et al. 2024); extra `minari`.

Observations, actions, rewards and ends of episodes travel; what a policy said of its actions (`extras`) and Minari's
`infos` do not. Discrete actions count from 0 here and from the space's start there. Minari's episodes are whole by
definition, so that one whose last step has no flag counts as truncated.
"""

import inspect
import json
import os
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np

from ..core import EnvSpec, Spec, from_space
from .episodes import Dataset
from .files import Damaged
from .trajectories import Trajectory

SLACK = 1e-3
"""How far beyond a box's bound, in units of half its width, a recorded action is put down to rounding and clipped."""


def from_minari(dataset: str | Path) -> Dataset:
    """Read a dataset that lies on this machine.

    - `dataset`: a Minari id, such as `D4RL/door/human-v2`, or the path of its folder.

    Raises `ValueError` where Minari is not installed, where it has no such dataset, or where the data cannot be used.
    """
    minari = _minari()
    folder = _folder(str(dataset))
    try:
        described = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise Damaged(f"{folder} is not a Minari dataset: it has no metadata.json that can be read") from error
    if "observation_space" not in described or "action_space" not in described:
        # Minari would make the environment that the file names, which means to run code that a file names.
        raise Damaged(f"{folder} does not state its spaces: write it again with a newer Minari")
    try:
        source = minari.MinariDataset(folder)
        spec = EnvSpec(from_space(source.observation_space), from_space(source.action_space))
        trajectories = [_inward(spec, episode) for episode in source.iterate_episodes() if len(episode.rewards)]
    except (KeyError, OSError, AssertionError, ImportError) as error:
        raise Damaged(f"Minari cannot read {folder}: {error}") from error
    if not trajectories:
        raise Damaged(f"{folder} has no episodes: record at least one")
    return Dataset.of_trajectories(trajectories, spec)


def to_minari(
    dataset: Dataset,
    dataset_id: str,
    *,
    env: str | None = None,
    algorithm: str | None = None,
    author: str | None = None,
    description: str | None = None,
) -> Path:
    """Write a dataset where Minari keeps its own (`MINARI_DATASETS_PATH`), and return its folder.

    - `dataset_id`: `namespace/name-v0`.
    - `env`: the Gymnasium id of the environment, so that Minari can make it again.

    Raises `ValueError` where Minari is not installed, has such a dataset already, or does not like the id.
    """
    minari = _minari()
    action, observation = dataset.spec.action, dataset.spec.observation
    buffers = []
    for number, episode in enumerate(dataset.episodes()):
        host: Trajectory = jax.tree.map(np.asarray, episode)
        last = np.arange(len(host.rewards)) == len(host.rewards) - 1
        buffers.append(
            minari.data_collector.EpisodeBuffer(
                id=number,
                observations=_outward(observation, host.observations),
                actions=_outward(action, host.actions),
                rewards=host.rewards,
                terminations=last & host.terminated,
                truncations=last & host.truncated,
            )
        )
    options: dict[str, Any] = {"env": env, "algorithm_name": algorithm, "author": author, "description": description}
    create = minari.create_dataset_from_buffers
    if "jpeg_encoding" in inspect.signature(create).parameters:
        options["jpeg_encoding"] = False  # JPEG would change the pictures
    try:
        with warnings.catch_warnings():
            # Minari warns of every optional description that is left out.
            warnings.simplefilter("ignore", UserWarning)
            create(
                dataset_id,
                buffers,
                observation_space=observation.to_space(),
                action_space=action.to_space(),
                data_format="hdf5",
                **options,
            )
    except (OSError, ImportError) as error:
        raise ValueError(f"Minari cannot write {dataset_id}: {error}") from error
    return _folder(dataset_id).parent


def _minari() -> ModuleType:
    try:
        import h5py
        import minari
    except ImportError as error:
        raise ValueError(
            f'Minari datasets need packages that are not installed ({error}): pip install "rewardtogo[minari]"'
        ) from error
    del h5py
    return minari


def _folder(dataset: str) -> Path:
    """The folder with the data of a dataset, given by path or by id."""
    root = Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")
    tried = [Path(dataset), Path(dataset, "data"), root / dataset / "data"]
    for folder in tried:
        if (folder / "metadata.json").is_file():
            return folder
    raise Damaged(
        f"there is no Minari dataset {dataset} on this machine (looked in {root}): "
        f"fetch it with `minari download {dataset}`, or set MINARI_DATASETS_PATH"
    )


def _start(spec: Spec) -> np.ndarray | int:
    return np.asarray(spec.start, np.int64).reshape(spec.shape) if spec.start else 0


def _flat(tree: Any, name: str = "") -> dict[str, Any]:
    if isinstance(tree, (tuple, list)):
        tree = {str(i): part for i, part in enumerate(tree)}
    if not isinstance(tree, dict):
        return {name: tree}
    nested = [_flat(part, f"{name}.{key}" if name else str(key)) for key, part in tree.items()]
    return {key: part for parts in nested for key, part in parts.items()}


def _columns(spec: Spec, tree: Any) -> Any:
    flat = _flat(tree) if spec.kind == "dict" else {"": tree}
    parts = dict(spec.parts) if spec.kind == "dict" else {"": spec}
    read = {name: _column(part, np.asarray(flat[name])) for name, part in parts.items()}
    return read if spec.kind == "dict" else read[""]


def _column(spec: Spec, array: np.ndarray) -> np.ndarray:
    # One choice is stored as a number or as an array of one number.
    array = array.reshape(len(array), *spec.shape)
    return (array - _start(spec)).astype(spec.dtype) if spec.start else array.astype(spec.dtype)


def _inward(spec: EnvSpec, episode: Any) -> Trajectory:
    actions = _columns(spec.action, episode.actions)
    if spec.action.kind == "box":
        low, high = spec.action.bounds()
        reach = SLACK * np.where(np.isfinite(high) & np.isfinite(low), high - low, 1.0) / 2
        near = np.clip(actions, low, high)
        actions = np.where(np.abs(actions - near) <= reach, near, actions).astype(spec.action.dtype)
    terminated = bool(episode.terminations[-1])
    fields = {
        "observations": _columns(spec.observation, episode.observations),
        "actions": actions,
        "rewards": np.asarray(episode.rewards, np.float32),
        "terminated": np.asarray(terminated),
        "truncated": np.asarray(bool(episode.truncations[-1]) or not terminated),
        "extras": {},
    }
    return Trajectory(**jax.tree.map(jax.numpy.asarray, fields))


def _outward(spec: Spec, tree: Any) -> Any:
    if spec.kind == "dict":
        return {name: _outward(part, tree[name]) for name, part in spec.parts}
    return (
        np.asarray(tree, np.int64) + _start(spec) if spec.kind in ("discrete", "multi_discrete") else np.asarray(tree)
    )
