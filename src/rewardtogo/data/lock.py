"""A lock on a folder: one process at a time works in it."""

import os
from pathlib import Path
from typing import IO


class FolderLock:
    """Keeps a second process out; the system lets go of it when this one ends, however it ends.

    `path` is the file that is locked; `otherwise` the sentence of the `ValueError` where another process has it.
    """

    def __init__(self, path: Path, otherwise: str):
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: IO[bytes] | None = path.open("a+b")
        try:
            _lock(self._file)
        except OSError as error:
            self._file.close()
            raise ValueError(otherwise) from error

    def release(self) -> None:
        """Let others in."""
        if self._file is not None:
            self._file.close()
            self._file = None


if os.name == "nt":
    import msvcrt

    def _lock(file: IO[bytes]) -> None:
        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
else:
    import fcntl

    def _lock(file: IO[bytes]) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
