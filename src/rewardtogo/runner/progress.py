"""What a person sees while a run goes on, on stderr: a bar on a terminal, a line now and then in a file."""

import sys
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

LINE_EVERY = 10.0
"""Seconds between two lines where there is no terminal."""


class Reporter:
    """Shows progress; silent if asked to be."""

    def __init__(self, total: int, start: int = 0, quiet: bool = False):
        self.console = Console(file=sys.stderr, quiet=quiet, highlight=False, soft_wrap=True)
        self._total, self._first = total, start
        self._last_line, self._return, self._announced = time.monotonic(), float("nan"), False
        self._began: float | None = None
        self._bar: Progress | None = None
        if self.console.is_terminal and not quiet:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[info]}"),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=self.console, transient=True)
            self._task = self._bar.add_task("compiling", total=total, completed=start, info="")
            self._bar.start()

    def say(self, text: str) -> None:
        """A line that stays."""
        self.console.print(text, markup=False)

    def update(self, steps: int, seconds: float, compile_seconds: float, rows: list[dict[str, Any]]) -> None:
        """After a chunk: where the run stands."""
        for row in rows:
            value = np.nanmean(row["return_mean"]) if np.any(np.isfinite(row["return_mean"])) else np.nan
            self._return = float(value) if np.isfinite(value) else self._return
        if not self._announced:
            self.say(f"compiled in {compile_seconds:.1f} s")
            self._announced = True
        rate = (steps - self._first) / max(seconds, 1e-9)
        shown = "no episode has ended yet" if np.isnan(self._return) else f"return {self._return:.1f}"
        info = f"{steps:,} steps   {rate:,.0f} steps/s   {shown}"
        if self._bar is not None:
            self._bar.update(self._task, completed=min(steps, self._total), description="training", info=info)
        elif time.monotonic() - self._last_line > LINE_EVERY:
            self._last_line = time.monotonic()
            self.say(f"{100 * min(steps, self._total) / self._total:3.0f} %   {info}")

    def close(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.stop()
