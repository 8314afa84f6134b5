"""What `check_env` has found so far: problems, one of each kind, and the extremes of what an environment gave."""

import dataclasses
from typing import Any, Literal

import gymnasium.spaces as spaces
import numpy as np

from ..core import from_space
from .translate import Leaf, Parts, Translation

LARGE_OBSERVATION = 100.0
"""Entries beyond this slow the first layer of a network down: normalise."""
LARGE_REWARD = 100.0
"""Rewards beyond this make value losses that drown everything else: scale."""
TOLERANCE = 1e-5
"""Relative slack of bounds, for rounding."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """One thing that is wrong, in one sentence that says what would mend it."""

    severity: Literal["error", "warning"]
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.message}"


class Report:
    """Problems found so far, each kind once."""

    def __init__(self) -> None:
        self.found: dict[str, Problem] = {}

    def error(self, kind: str, message: str) -> None:
        self.found.setdefault(kind, Problem("error", message))

    def warning(self, kind: str, message: str) -> None:
        self.found.setdefault(kind, Problem("warning", message))

    def problems(self) -> list[Problem]:
        return sorted(self.found.values(), key=lambda problem: problem.severity)


class Watch:
    """Extremes of what was observed and rewarded, and how many episodes ended."""

    def __init__(self, translation: Translation) -> None:
        self.leaves = translation.leaves
        self.low: Parts = {}
        self.high: Parts = {}
        self.rewards: list[float] = []
        self.ended = 0

    def observe(self, parts: Parts) -> None:
        """Look at elements with any number of leading axes."""
        for leaf in self.leaves:
            name, flat = leaf.name, np.asarray(parts[leaf.name]).reshape((-1, *leaf.spec.shape))
            low, high = np.asarray(flat.min(0)), np.asarray(flat.max(0))  # NaN stays NaN
            self.low[name] = np.asarray(np.minimum(self.low[name], low)) if name in self.low else low
            self.high[name] = np.asarray(np.maximum(self.high[name], high)) if name in self.high else high

    def report(self, report: Report, limited: bool, steps: int) -> None:
        """What the extremes say about the environment; `limited`: whether something else ends its episodes."""
        for leaf in self.leaves:
            if leaf.name in self.low:
                _report_extremes(report, leaf, self.low[leaf.name], self.high[leaf.name])
        rewards = np.asarray(self.rewards)
        if not np.isfinite(rewards).all():
            report.error("reward", f"a reward was {rewards[~np.isfinite(rewards)][0]}: give finite numbers")
        elif rewards.size and np.abs(rewards).max() > LARGE_REWARD:
            report.warning(
                "reward scale",
                f"rewards reach {rewards[np.abs(rewards).argmax()]:g} in one step: scale them to about 1, "
                "or normalise them while learning",
            )
        elif rewards.size and not rewards.any():
            report.warning(
                "reward scale",
                f"{steps} random steps earned no reward but 0: learning begins with the first one that is "
                "found, so shape the reward or use an algorithm that explores",
            )
        if not self.ended and not limited:
            report.warning(
                "end",
                f"no episode ended within {steps} random steps and there is no time limit: give one "
                "(max_episode_steps, or TimeLimit around a compiled environment)",
            )


def _part(leaf: Leaf) -> str:
    return f"the observation's part {leaf.name!r}" if leaf.name else "the observation"


def _report_extremes(report: Report, leaf: Leaf, low: np.ndarray, high: np.ndarray) -> None:
    spec = leaf.spec
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        report.error(
            f"finite {leaf.name}",
            f"{_part(leaf)} held NaN or infinity: look for a division by 0 or a state that diverges",
        )
        return
    if spec.kind == "box":
        least, most = (np.asarray(bound, np.float64) for bound in spec.bounds())
    else:
        counts = np.asarray(spec.counts if spec.counts else 2).reshape(spec.shape if len(spec.counts) > 1 else ())
        least, most = np.zeros(()), counts - 1.0
    slack = TOLERANCE * np.maximum(1.0, np.where(np.isfinite(most), np.abs(most), 1.0))
    if np.any(low < least - slack) or np.any(high > most + slack):
        wrong = low[low < least - slack] if np.any(low < least - slack) else high[high > most + slack]
        report.error(
            f"bounds {leaf.name}",
            f"{_part(leaf)} was {wrong.ravel()[0]:g}, outside its space {leaf.space}: widen the space, "
            "or clip what is observed",
        )
    size = max(np.abs(low.astype(np.float64)).max(initial=0.0), np.abs(high.astype(np.float64)).max(initial=0.0))
    if spec.kind == "box" and spec.dtype != "uint8" and size > LARGE_OBSERVATION:
        report.warning(
            f"scale {leaf.name}",
            f"{_part(leaf)} reaches {size:g}: normalise observations, or divide by their usual size",
        )


def check_spaces(report: Report, observation: Any, action: Any) -> bool:
    """Whether both spaces can be used at all."""
    for name, space in (("observation", observation), ("action", action)):
        if not isinstance(space, spaces.Space):
            report.error(f"{name} space", f"{name}_space is {space!r}: set it to a space of gymnasium.spaces")
            continue
        try:
            spec = from_space(space)
        except ValueError as cause:
            report.error(f"{name} space", f"{name}_space cannot be used: {cause}")
            continue
        boxes = [
            part for part in ([spec] if spec.kind != "dict" else [part for _, part in spec.parts]) if part.kind == "box"
        ]
        if name == "action" and not all(box.is_bounded for box in boxes):
            report.warning(
                "unbounded",
                f"the action space {space} has no finite bounds, which algorithms that squash or clip their "
                "actions need: give low and high, best -1 and 1",
            )
    return not any(kind.endswith(" space") for kind in report.found)


class Stop(Exception):
    """An error after which going on would show nothing more."""
