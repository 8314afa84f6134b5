"""Demonstrations and other recorded experience: whole episodes in memory, and in files of arrays and JSON (item 2.4).

    DATASET/dataset.json  episodes-00000.safetensors  episodes-00001.safetensors ...

`dataset.json` says what the data is: format, environment, spaces, who collected it and how. In a file each episode has
T actions and T + 1 observations, one episode after the other, so that no observation is stored twice. Nothing of a file
is ever run.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core import MASK, EnvSpec, PRNGKey, Spec, Transition
from .checks import checked
from .checks import require_spec as require_spec
from .files import FORMAT, Damaged, load_tree, read_json, save_tree, sync, write_json
from .noise import check_noise, perturb
from .trajectories import Trajectory, episode_bounds, join_episodes, split_episodes

FILE_BYTES = 2**28
"""About how much goes into one file."""
MINARI = "minari:"
"""What a path begins with where it names a Minari dataset."""


class Dataset(eqx.Module):
    """Whole episodes of one environment, one after the other, and the spaces of that environment.

    `transitions` are `[N]`; an episode ends where `terminated` or `truncated` says so, and `next_observation` is what
    came before any reset. Make one with `Dataset.of`, which checks what it is given.
    """

    transitions: Transition
    spec: EnvSpec = eqx.field(static=True)

    @staticmethod
    def of(transitions: Transition, spec: EnvSpec) -> "Dataset":
        """A dataset from a row of transitions `[N]`.

        Raises `ValueError`, in one sentence, where they are not whole episodes of finite numbers in these spaces.
        """
        return Dataset(Transition(**jax.tree.map(jnp.asarray, checked(transitions, spec))), spec)

    @staticmethod
    def of_trajectories(trajectories: Sequence[Trajectory], spec: EnvSpec) -> "Dataset":
        """A dataset from whole episodes."""
        return Dataset.of(join_episodes(trajectories), spec)

    @property
    def num_steps(self) -> int:
        """N."""
        return len(self.transitions.reward)

    @property
    def num_episodes(self) -> int:
        """How many episodes there are."""
        return len(self.bounds) - 1

    @property
    def bounds(self) -> Int[np.ndarray, "E1"]:
        """Episode e is steps `bounds[e]` to `bounds[e + 1] - 1`."""
        return episode_bounds(np.asarray(self.transitions.terminated) | np.asarray(self.transitions.truncated))

    @property
    def lengths(self) -> Int[np.ndarray, "E"]:
        """Steps of each episode."""
        return np.diff(self.bounds)

    @property
    def returns(self) -> Float[np.ndarray, "E"]:
        """Sum of the rewards of each episode, without a discount."""
        return np.add.reduceat(np.asarray(self.transitions.reward, np.float64), self.bounds[:-1])

    def episodes(self) -> Iterator[Trajectory]:
        """The episodes, in order."""
        return iter(split_episodes(self.transitions))

    def take(self, episodes: Sequence[int] | Int[np.ndarray, "K"]) -> "Dataset":
        """The dataset of these episodes, in this order; one may come more than once."""
        bounds = self.bounds
        wrong = [int(e) for e in episodes if not 0 <= e < len(bounds) - 1]
        if wrong or not len(episodes):
            raise ValueError(
                f"episodes are numbered from 0 to {len(bounds) - 2} here, and there must be at least one: "
                f"{f'there is no episode {wrong[0]}' if wrong else 'none was asked for'}"
            )
        rows = np.concatenate([np.arange(bounds[e], bounds[e + 1]) for e in episodes])
        return Dataset(jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[rows]), self.transitions), self.spec)

    def split(self, fraction: float, key: PRNGKey) -> tuple["Dataset", "Dataset"]:
        """Two datasets of whole episodes, drawn at random: about `fraction` of them, and the rest; neither is empty."""
        count = self.num_episodes
        if not 0.0 < fraction < 1.0:
            raise ValueError(f"the fraction of episodes in the first part must lie between 0 and 1, not {fraction}")
        if count < 2:
            raise ValueError("a dataset of one episode cannot be split into two of whole episodes: collect more")
        order = np.asarray(jax.random.permutation(key, count))
        first = min(max(round(fraction * count), 1), count - 1)
        return self.take(np.sort(order[:first])), self.take(np.sort(order[first:]))

    def with_noise(self, noise: float, key: PRNGKey) -> "Dataset":
        """The same episodes with noise on the recorded actions (`noise.perturb`): a demonstrator whose labels err."""
        check_noise(self.spec.action, noise)
        keys = jax.random.split(key, self.num_steps)
        t = self.transitions
        mask = t.observation.get(MASK) if isinstance(t.observation, dict) else None
        actions = jax.vmap(lambda a, k, m: perturb(self.spec.action, a, noise, k, m))(t.action, keys, mask)
        return eqx.tree_at(lambda d: d.transitions.action, self, actions)


def concatenate(datasets: Sequence[Dataset]) -> Dataset:
    """The episodes of several datasets of one environment, in order."""
    if not datasets:
        raise ValueError("no dataset was given: give at least one")
    first = datasets[0]
    for other in datasets[1:]:
        require_spec(other.spec, first.spec)
        if set(other.transitions.extras) != set(first.transitions.extras):
            raise ValueError(
                f"one dataset keeps {sorted(first.transitions.extras)} of each step and another one "
                f"{sorted(other.transitions.extras)}: they cannot be put together"
            )
    join = lambda *parts: jnp.asarray(np.concatenate([np.asarray(p) for p in parts]))  # noqa: E731
    return Dataset(jax.tree.map(join, *(d.transitions for d in datasets)), first.spec)


def save_dataset(
    path: str | Path, dataset: Dataset, about: dict[str, Any] | None = None, *, file_bytes: int = FILE_BYTES
) -> Path:
    """Write a dataset to a new folder, whole or not at all, and return the folder.

    - `about`: plain data on where it comes from: `env`, `collector`, `deterministic`, `versions`, or whatever else.
    - `file_bytes`: about how much goes into one file; an episode is never split.

    Raises `ValueError` where the folder is not empty or cannot be made.
    """
    final = Path(path)
    require_new(final)
    temporary = final.with_name(f".{final.name}.tmp")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
    except OSError as error:
        raise ValueError(f"the dataset folder cannot be made: {error.strerror or error} ({error.filename})") from error
    try:
        files = write_episodes(temporary, dataset, file_bytes)
        extras = {k: {"shape": list(v.shape[1:]), "dtype": str(v.dtype)} for k, v in dataset.transitions.extras.items()}
        count, steps = dataset.num_episodes, dataset.num_steps
        write_json(temporary / "dataset.json", describe_dataset(dataset.spec, count, steps, extras, files, about or {}))
        sync(temporary)
        if final.exists():
            final.rmdir()
        os.replace(temporary, final)
        sync(final.absolute().parent)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return final


def require_new(path: Path) -> None:
    """Raise `ValueError` unless nothing, or an empty folder, is at `path`."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(
            f"{path} exists and is not empty: a dataset is never written over another one; give another folder"
        )


def load_dataset(path: str | Path) -> Dataset:
    """Read a dataset's folder; `minari:ID` reads one of Minari's instead (see `minari.from_minari`).

    Raises `Damaged`, a `ValueError`, saying which file cannot be used and why.
    """
    if str(path).startswith(MINARI):
        from .minari import from_minari

        return from_minari(str(path).removeprefix(MINARI))
    folder = Path(path)
    data = read_description(folder)
    try:
        spec = EnvSpec(Spec.from_json(data["observation"]), Spec.from_json(data["action"]))
        files = [(folder / Path(f["name"]).name, int(f["episodes"]), int(f["steps"])) for f in data["files"]]
        extras = {name: (tuple(e["shape"]), np.dtype(e["dtype"])) for name, e in data["extras"].items()}
        for space in (spec.observation, spec.action):
            space.to_space()  # raises where the description makes no sense
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, AssertionError) as error:
        raise Damaged(
            f"{folder / 'dataset.json'} is damaged: it does not describe spaces and files ({error})"
        ) from error
    if not files:
        raise Damaged(f"{folder} has no episodes: collect at least one")
    parts = [_read_file(file, episodes, steps, spec, extras) for file, episodes, steps in files]
    whole: Any = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts) if len(parts) > 1 else parts[0]
    try:
        dataset = Dataset.of(Transition(**jax.tree.map(jnp.asarray, whole)), spec)
    except ValueError as error:
        raise Damaged(f"the dataset {folder} cannot be used: {error}") from error
    if (dataset.num_steps, dataset.num_episodes) != (data.get("steps"), data.get("episodes")):
        raise Damaged(
            f"{folder} should have {data.get('episodes')} episodes and {data.get('steps')} steps, and has "
            f"{dataset.num_episodes} and {dataset.num_steps}: a file is missing or of another dataset"
        )
    return dataset


def read_description(path: str | Path) -> dict[str, Any]:
    """What `dataset.json` says. Raises `Damaged` where there is none, or a newer one."""
    folder = Path(path)
    if not folder.exists():
        raise Damaged(f"there is no dataset {folder}: make one with `rtg collect RUN --out {folder}`")
    file = folder / "dataset.json"
    if not file.is_file():
        raise Damaged(f"{folder} is not a dataset: it has no dataset.json")
    data = read_json(file)
    if not isinstance(data, dict) or data.get("content") != "dataset" or not isinstance(data.get("format"), int):
        raise Damaged(f"{file} is not the description of a dataset")
    if data["format"] > FORMAT:
        raise Damaged(
            f"{file} has format {data['format']}, which is newer than this library's {FORMAT}: "
            "install a newer rewardtogo"
        )
    return data


def describe_dataset(
    spec: EnvSpec,
    episodes: int,
    steps: int,
    extras: dict[str, Any],
    files: list[dict[str, Any]],
    about: dict[str, Any],
) -> dict[str, Any]:
    """What `dataset.json` says."""
    return {
        "format": FORMAT,
        "content": "dataset",
        "episodes": episodes,
        "steps": steps,
        "observation": spec.observation.to_json(),
        "action": spec.action.to_json(),
        "extras": extras,
        "files": files,
        "about": about,
    }


def write_episodes(
    folder: Path, dataset: Dataset, file_bytes: int = FILE_BYTES, first: int = 0
) -> list[dict[str, Any]]:
    """Write a dataset's files, numbered from `first`; what `dataset.json` says of each."""
    t: Transition = jax.tree.map(np.asarray, dataset.transitions)
    bounds = dataset.bounds
    step_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(t)) / len(t.reward)
    group = ((bounds[1:] - 1) * step_bytes // file_bytes).astype(int)
    files = []
    for number, g in enumerate(np.unique(group), first):
        chosen = np.flatnonzero(group == g)
        start, stop = int(bounds[chosen[0]]), int(bounds[chosen[-1] + 1])
        done = (t.terminated | t.truncated)[start:stop]
        # An episode's last observation follows its others: the T + 1 observations lie together.
        place = np.flatnonzero(done) + 1
        observation = jax.tree.map(
            lambda x, last: np.insert(x[start:stop], place, last[start:stop][done], axis=0),  # noqa: B023
            t.observation,
            t.next_observation,
        )
        row = {
            "observation": observation,
            **{
                n: jax.tree.map(lambda x: x[start:stop], v)  # noqa: B023
                for n, v in vars(t).items()
                if not n.endswith("observation")
            },
        }
        name = f"episodes-{number:05d}.safetensors"
        save_tree(folder / name, row, {"content": "episodes"})
        files.append({"name": name, "episodes": len(chosen), "steps": stop - start})
    return files


def _read_file(path: Path, episodes: int, steps: int, spec: EnvSpec, extras: dict[str, tuple]) -> dict[str, Any]:
    array = lambda n, shape, dtype: jax.ShapeDtypeStruct((n, *shape), np.dtype(dtype))  # noqa: E731
    like = {
        "observation": _like(spec.observation, steps + episodes),
        "action": _like(spec.action, steps),
        "reward": array(steps, (), "float32"),
        "terminated": array(steps, (), bool),
        "truncated": array(steps, (), bool),
        "extras": {name: array(steps, shape, dtype) for name, (shape, dtype) in extras.items()},
    }
    found: dict[str, Any] = jax.tree.map(np.asarray, load_tree(path, like))
    done = found["terminated"] | found["truncated"]
    if done.sum() != episodes or not done[-1]:
        raise Damaged(
            f"{path} should hold {episodes} whole episodes, and holds {done.sum()} ends of episodes"
            f"{'' if done[-1] else ' with steps after the last one'}: an end is missing or too many"
        )
    place = np.arange(steps) + np.concatenate([[0], np.cumsum(done)[:-1]])
    observation = found.pop("observation")
    return {
        "observation": jax.tree.map(lambda x: x[place], observation),
        **found,
        "next_observation": jax.tree.map(lambda x: x[place + 1], observation),
    }


def _like(spec: Spec, size: int) -> Any:
    if spec.kind == "dict":
        return {name: _like(part, size) for name, part in spec.parts}
    return jax.ShapeDtypeStruct((size, *spec.shape), np.dtype(spec.dtype))
