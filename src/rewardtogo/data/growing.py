"""A dataset that grows on the disk, an episode at a time, and is whole after each: for data that is made slowly and must not be lost.

    DATASET/dataset.json  episodes-00000.safetensors  episodes-00001.safetensors ...  lock

The folder is a dataset like any other (`episodes`), with a file an episode. A new file is written before `dataset.json` names it, and
`dataset.json` is replaced in one step, so that a process that is killed leaves whole episodes only.
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core import EnvSpec
from .checks import require_spec
from .episodes import (
    Dataset,
    describe_dataset,
    load_dataset,
    read_description,
    write_episodes,
)
from .files import sync, write_json
from .lock import FolderLock
from .trajectories import Trajectory

LOCK = "lock"


class GrowingDataset:
    """A dataset's folder to which whole episodes are added; one process at a time.

    - `path`: a folder that does not exist, is empty, or holds a dataset that was begun like this one.
    - `about`: what `dataset.json` says of where the data comes from; `same`: entries of it that must be those of the data that is there.

    Raises `ValueError` where the folder holds something else, data of another environment, or another process adds to it.
    """

    def __init__(self, path: str | Path, spec: EnvSpec, about: dict[str, Any], same: Sequence[str] = ("env",)):
        self.path, self.spec = Path(path), spec
        self.lengths: list[int] = []
        self.returns: list[float] = []
        self._files: list[dict[str, Any]] = []
        self.about = dict(about)
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path} is a file: a dataset is a folder; give another name")
        found = self.path.exists() and any(entry.name != LOCK for entry in self.path.iterdir())
        known = read_description(self.path) if found else None
        if known is not None:
            self._require_same(known, same)
        self._made_parent = not self.path.absolute().parent.exists()
        try:
            otherwise = f"another process adds to {self.path}: use its page, or stop it first"
            self._lock = FolderLock(self.path / LOCK, otherwise)
        except OSError as error:
            raise ValueError(
                f"the dataset folder cannot be made: {error.strerror or error} ({error.filename})"
            ) from error
        try:
            if known is None:
                self._describe()
            else:
                self._read()
        except BaseException:
            self._lock.release()
            raise

    def _require_same(self, known: dict[str, Any], names: Sequence[str]) -> None:
        theirs = known.get("about") or {}
        for name in names:
            if theirs.get(name) != self.about.get(name):
                raise ValueError(
                    f"{self.path} is a dataset whose {name} is {theirs.get(name)}, and here it is {self.about.get(name)}: "
                    "give another folder, in which a new dataset begins"
                )

    def _read(self) -> None:
        known = read_description(self.path)
        self.about = {**(known.get("about") or {}), **self.about}
        if not known.get("files"):
            return
        there = load_dataset(self.path)
        require_spec(there.spec, self.spec, str(self.path))
        self.spec = there.spec
        self.lengths, self.returns = there.lengths.tolist(), there.returns.tolist()
        self._files = known["files"]

    @property
    def num_episodes(self) -> int:
        """How many episodes there are."""
        return len(self.lengths)

    def add(self, episode: Trajectory, **about: Any) -> None:
        """Add a whole episode; it is on the disk when this returns. `about`: entries of `dataset.json` that change with it.

        Raises `ValueError` where the episode is none in the dataset's spaces, or has no end.
        """
        dataset = Dataset.of_trajectories([episode], self.spec)
        number = 1 + max((int(f["name"].split("-")[1].split(".")[0]) for f in self._files), default=-1)
        files = write_episodes(self.path, dataset, first=number)
        self._files += files
        self.lengths += dataset.lengths.tolist()
        self.returns += dataset.returns.tolist()
        self._describe(**about)

    def drop(self) -> None:
        """Take the last episode away again."""
        if not self._files or self._files[-1]["episodes"] != 1:
            raise ValueError(f"{self.path} has no episode that was added last and could be taken away")
        file = self._files.pop()
        self.lengths.pop()
        self.returns.pop()
        self._describe()
        (self.path / file["name"]).unlink(missing_ok=True)

    def _describe(self, **about: Any) -> None:
        self.about |= {**about, "return_mean": float(np.mean(self.returns)) if self.returns else None}
        steps = sum(self.lengths)
        data = describe_dataset(self.spec, self.num_episodes, steps, {}, self._files, self.about)
        write_json(self.path / "dataset.json", data)
        sync(self.path)

    def close(self) -> None:
        """Let others in. A folder without any episode is taken away."""
        self._lock.release()
        if not self._files:
            for name in ("dataset.json", LOCK):
                (self.path / name).unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # somebody's own files lie there too
                self.path.rmdir()
                if self._made_parent:
                    self.path.absolute().parent.rmdir()
