"""Where rows of metrics go: `metrics.csv`, TensorBoard, Weights & Biases, behind one interface."""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from .folder import RunFolder

Row = dict[str, Any]


class Sink(ABC):
    """Takes the rows of one run."""

    @abstractmethod
    def write(self, rows: Sequence[Row]) -> None:
        """Write finished rows, in order."""

    @abstractmethod
    def close(self) -> None:
        """Finish."""


class CSV(Sink):
    """The run folder's own table."""

    def __init__(self, folder: RunFolder):
        self.folder = folder

    def write(self, rows: Sequence[Row]) -> None:
        self.folder.append_rows(rows)

    def close(self) -> None:
        pass


class TensorBoard(Sink):
    """Event files in the run folder; needs the extra `tensorboard`."""

    def __init__(self, folder: RunFolder, config: dict[str, Any]):
        del config
        self._protocol = _imported("tensorboard.compat.proto.summary_pb2", "tensorboard").Summary
        event = _imported("tensorboard.compat.proto.event_pb2", "tensorboard").Event
        writer = _imported("tensorboard.summary.writer.event_file_writer", "tensorboard").EventFileWriter
        self._event, self._writer = event, writer(str(folder.path / "tensorboard"))

    def write(self, rows: Sequence[Row]) -> None:
        for row in rows:
            values = [self._protocol.Value(tag=name, simple_value=float(value)) for name, value in _finite(row).items()]
            self._writer.add_event(self._event(step=int(row["env_steps"]), summary=self._protocol(value=values)))
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


class WandB(Sink):
    """A run at Weights & Biases, named after the folder; needs the extra `wandb`."""

    def __init__(self, folder: RunFolder, config: dict[str, Any]):
        wandb = _imported("wandb", "wandb")
        self._run = wandb.init(project="rewardtogo", name=folder.path.name, dir=str(folder.path), config=config)

    def write(self, rows: Sequence[Row]) -> None:
        for row in rows:
            self._run.log(_finite(row), step=int(row["env_steps"]))

    def close(self) -> None:
        self._run.finish()


SINKS = {"tensorboard": TensorBoard, "wandb": WandB}


def require_sinks(names: Sequence[str]) -> None:
    """Raise `ValueError` unless all of these sinks exist and what they need is installed."""
    for name in names:
        if name not in SINKS:
            raise ValueError(f"there is no sink {name!r}: choose from {', '.join(SINKS)}")
        _imported(name, name)


def _finite(row: Row) -> dict[str, float]:
    return {name: float(value) for name, value in row.items() if value is not None and np.isfinite(value)}


def _imported(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f"writing to {extra} needs it installed: pip install 'rewardtogo[{extra}]'") from error
