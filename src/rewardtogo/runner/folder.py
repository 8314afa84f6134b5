"""The run folder: one run, everything it needs to be read, evaluated, resumed, in arrays, JSON and CSV.

config.json  metrics.csv  evaluation.json  policy.safetensors + policy.json  best/  checkpoints/NNNNNNNN/  curve.png
"""

import contextlib
import csv
import io
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..data.files import FORMAT, Damaged, load_tree, read_json, save_tree, sync, write_json, write_text

KEEP = 2
"""Checkpoints that are kept: the last one and the one before it."""
FIRST_COLUMNS = ("iteration", "env_steps", "return_mean", "length_mean", "episodes", "seconds")
CONFIG = {name: int for name in ("seed", "steps", "iterations", "row_every", "eval_every", "eval_episodes")} | {
    "algorithm": str,
    "env": dict,
    "learner": dict,
    "loop": dict,
}
CONFIG_ENV = {"id": str, "backend": str, "num_envs": int, "kwargs": dict, "by_name": bool}
"""What a run's configuration cannot do without."""
LAST_COLUMNS = ("eval_return_mean", "eval_return_stochastic")


def safe_name(text: str) -> str:
    """`text` with everything that a file system may dislike replaced by `_`."""
    return re.sub(r"[^A-Za-z0-9._-]", "_", text)


def new_folders(out: str | None, algorithm: str, env: str, seeds: Sequence[int]) -> list[Path]:
    """Fresh empty folders, one a seed. Raises `ValueError` where they cannot be made, or where `out` is not empty."""
    try:
        if out is not None:
            base = Path(out)
            if base.exists() and (not base.is_dir() or any(base.iterdir())):
                raise ValueError(
                    f"{base} exists and is not empty: a run is never written over another one; "
                    "give another --out, or continue this one with `rtg resume`"
                )
            base.mkdir(parents=True, exist_ok=True)
            folders = [base] if len(seeds) == 1 else [base / f"seed-{seed}" for seed in seeds]
            for folder in folders:
                folder.mkdir(exist_ok=True)
            return folders
        return [_numbered(Path("runs"), safe_name(f"{algorithm}-{env}-{seed}")) for seed in seeds]
    except OSError as error:
        raise ValueError(f"the run folder cannot be made: {error.strerror or error} ({error.filename})") from error


def _numbered(base: Path, name: str) -> Path:
    base.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = base / f"{name}-{number}"
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
        number += 1


class RunFolder:
    """Reads and writes one run folder."""

    def __init__(self, path: str | Path):
        self.path = Path(path)

    # --- configuration ---------------------------------------------------------------------------------------------------------

    def write_config(self, config: dict[str, Any]) -> None:
        """Write `config.json`."""
        write_json(self.path / "config.json", {"format": FORMAT, **config})

    def config(self) -> dict[str, Any]:
        """Read `config.json`. Raises `Damaged` where this is no run folder, or a newer one."""
        if not self.path.exists():
            raise Damaged(f"there is no run folder {self.path}")
        file = self.path / "config.json"
        if not file.exists():
            raise Damaged(f"{self.path} is not a run folder: it has no config.json")
        data = read_json(file)
        if not isinstance(data, dict) or not isinstance(data.get("format"), int):
            raise Damaged(f"{file} is not a run's configuration")
        if data["format"] > FORMAT:
            raise Damaged(
                f"{file} has format {data['format']}, which is newer than this library's {FORMAT}: install a newer rewardtogo"
            )
        for part, wanted in ((data, CONFIG), (data.get("env"), CONFIG_ENV), (data.get("loop"), {"class": str})):
            for name, kind in wanted.items():
                value = part.get(name) if isinstance(part, dict) else None
                least = 0 if name in ("seed", "num_envs") else 1
                if not isinstance(value, kind) or (kind is int and isinstance(value, int) and value < least):
                    raise Damaged(f"{file} is damaged: its {name!r} is {'missing' if value is None else repr(value)}")
        return data

    # --- checkpoints -----------------------------------------------------------------------------------------------------------

    @property
    def _checkpoints(self) -> Path:
        return self.path / "checkpoints"

    def iterations(self) -> list[int]:
        """Iterations that have a whole checkpoint, in order."""
        names = self._checkpoints.iterdir() if self._checkpoints.exists() else ()
        return sorted(int(p.name) for p in names if p.is_dir() and p.name.isdigit())

    def checkpoint_folder(self, iteration: int) -> Path:
        """Where the checkpoint of an iteration is, if there is one."""
        return self._checkpoints / f"{iteration:08d}"

    def save_checkpoint(self, iteration: int, state: Any, about: dict[str, Any]) -> None:
        """Write a checkpoint under a temporary name, sync it, rename it, and only then remove the oldest.

        Raises `OSError` where the disk is full or cannot be written; what was there before is whole then.
        """
        final = self.checkpoint_folder(iteration)
        if final.exists():
            return
        temporary = self._checkpoints / f".{final.name}.tmp"
        for half_written in self._checkpoints.glob(".*.tmp"):  # by a process that was killed
            shutil.rmtree(half_written, ignore_errors=True)
        try:
            temporary.mkdir(parents=True)
            save_tree(temporary / "state.safetensors", state, {"content": "checkpoint"})
            write_json(temporary / "about.json", {"format": FORMAT, "iteration": iteration, **about})
            sync(temporary)
            temporary.rename(final)
            sync(self._checkpoints)
        except Exception as error:
            shutil.rmtree(temporary, ignore_errors=True)
            if isinstance(error, OSError):
                raise
            raise OSError(f"the checkpoint {final} could not be written: {error}") from error
        for old in self.iterations()[:-KEEP]:
            shutil.rmtree(self._checkpoints / f"{old:08d}", ignore_errors=True)

    def load_checkpoint(self, iteration: int, like: Any) -> tuple[Any, dict[str, Any]]:
        """The state and what was said of it. Raises `Damaged`, naming the file, where it cannot be used."""
        folder = self.checkpoint_folder(iteration)
        if not folder.exists():
            have = ", ".join(map(str, self.iterations())) or "none"
            raise Damaged(f"{self.path} has no checkpoint {iteration} (it has {have})")
        about = read_json(folder / "about.json") if (folder / "about.json").exists() else None
        if not isinstance(about, dict) or about.get("iteration") != iteration:
            raise Damaged(f"{folder / 'about.json'} is damaged or missing")
        return load_tree(folder / "state.safetensors", like), about

    # --- metrics ---------------------------------------------------------------------------------------------------------------

    @property
    def metrics_file(self) -> Path:
        """`metrics.csv`."""
        return self.path / "metrics.csv"

    def append_rows(self, rows: Sequence[dict[str, Any]]) -> None:
        """Add rows to `metrics.csv`, with a header where it is new."""
        if not rows:
            return
        text = io.StringIO()
        new = not self.metrics_file.exists()
        if new:
            metrics = sorted(set(rows[0]) - set(FIRST_COLUMNS) - set(LAST_COLUMNS))
            header = [*FIRST_COLUMNS, *metrics, *LAST_COLUMNS]
        else:
            with self.metrics_file.open(newline="") as file:
                header = next(csv.reader(file))
        writer = csv.writer(text, lineterminator="\n")
        if new:
            writer.writerow(header)
        writer.writerows([_cell(row.get(name)) for name in header] for row in rows)
        with self.metrics_file.open("a", newline="", encoding="utf-8") as file:
            file.write(text.getvalue())

    def drop_rows_after(self, iteration: int) -> None:
        """Remove the rows that a resumed run will write again, and a half-written last line."""
        if not self.metrics_file.exists():
            return
        lines = self._table().splitlines()
        if not lines:
            self.metrics_file.unlink()
            return
        width = lines[0].count(",")
        whole = [line for line in lines[1:] if line.count(",") == width and line.split(",")[0].isdigit()]
        kept = [line for line in whole if int(line.split(",")[0]) <= iteration]
        write_text(self.metrics_file, "\n".join([lines[0], *kept]) + "\n")

    def _table(self) -> str:
        try:
            return self.metrics_file.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise Damaged(f"{self.metrics_file} is damaged: it is not text") from error

    def metrics(self) -> dict[str, np.ndarray]:
        """The columns of `metrics.csv` as arrays, NaN where a cell is empty. Raises `Damaged` where there is no such table."""
        if not self.metrics_file.exists():
            raise Damaged(f"{self.path} has no metrics.csv: the run has not finished its first row")
        rows = list(csv.reader(self._table().splitlines()))
        if not rows or "env_steps" not in rows[0] or "return_mean" not in rows[0]:
            raise Damaged(f"{self.metrics_file} is damaged: it has no columns env_steps and return_mean")
        body = [row for row in rows[1:] if len(row) == len(rows[0])]
        try:
            return {
                name: np.asarray([float(row[i]) if row[i] else np.nan for row in body])
                for i, name in enumerate(rows[0])
            }
        except ValueError as error:
            raise Damaged(f"{self.metrics_file} is damaged: {error}") from error


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, (float, np.floating)) and np.isnan(value)):
        return ""
    return (
        str(int(value))
        if isinstance(value, (int, np.integer)) or (float(value).is_integer() and abs(value) < 2**53)
        else f"{float(value):.9g}"
    )
