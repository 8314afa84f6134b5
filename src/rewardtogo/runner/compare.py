"""Comparing runs: by algorithm and environment, with what few seeds allow one to say (Agarwal et al. 2021).

A seed's score x_i is the mean return of its last evaluation. Of n seeds, the interquartile mean (IQM) leaves out the lowest and the
highest floor(n/4) and is the mean of the rest; its 95 % interval is the percentile bootstrap over seeds. Two algorithms in the same
environment are compared by

    P(X > Y) = 1/(nm) sum_ij [x_i > y_j] + 1/2 [x_i = y_j],

and its interval resamples the seeds of each algorithm by themselves (a stratified bootstrap).
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..data.files import Damaged, read_json
from .evaluate import BOOTSTRAP, confidence
from .folder import RunFolder
from .plot import evaluations, run_folders

FEW = 5
"""Seeds below which an interval says little."""
ROUNDING = 1.1
"""Budgets round up to whole iterations; runs whose steps differ by no more than this factor took the same number."""


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """The mean of what is left when the lowest and the highest floor(n/4) of n values are left out."""
    ordered = np.sort(np.asarray(values, np.float64), axis)
    count = ordered.shape[axis]
    return np.asarray(np.take(ordered, range(count // 4, count - count // 4), axis).mean(axis))


def probability_of_improvement(x: np.ndarray, y: np.ndarray) -> tuple[float, tuple[float, float]]:
    """P(X > Y), ties counted half, and its 95 % stratified bootstrap interval, the same for the same values."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    wins = (x[:, None] > y[None, :]) + 0.5 * (x[:, None] == y[None, :])
    rng = np.random.default_rng(0)
    # How often each seed is drawn is all that matters, so a resample of all pairs is a product of three matrices.
    counts = [rng.multinomial(len(v), np.full(len(v), 1 / len(v)), BOOTSTRAP) for v in (x, y)]
    spread = np.einsum("rj,rj->r", counts[0] @ wins, counts[1]) / wins.size
    low, high = np.quantile(spread, [0.025, 0.975])
    return float(wins.mean()), (float(low), float(high))


def final_return(folder: RunFolder) -> tuple[float, int]:
    """The mean return of a run's last evaluation and the steps taken by then: of `evaluation.json`, else of `metrics.csv`."""
    file = folder.path / "evaluation.json"
    if file.exists():
        data = read_json(file)
        try:
            return float(data["return_mean"]), int(data["env_steps"])
        except (KeyError, TypeError, ValueError) as error:
            raise Damaged(f"{file} is damaged: it has no numbers return_mean and env_steps") from error
    steps, returns = evaluations(folder)
    if not len(returns):
        raise ValueError(f"{folder.path} has not been evaluated yet: finish it with `rtg resume {folder.path}` first")
    return float(returns[-1]), int(steps[-1])


def compare(runs: Sequence[str | Path]) -> dict[str, Any]:
    """Runs by algorithm and environment, and algorithms against each other in the same environment, as plain data.

    `groups` has a dictionary for each algorithm and environment (`iqm`, `iqm_ci95`, `mean`, `median`, `seeds`, `steps`, `returns`),
    `comparisons` one for each pair, and `warning` says what should keep one from trusting them (None if nothing).
    """
    groups: dict[tuple[str, str], list[RunFolder]] = {}
    for folder in run_folders(runs):
        config = folder.config()
        groups.setdefault((config["env"]["id"], config["algorithm"]), []).append(folder)
    found = [_group(env, algorithm, members) for (env, algorithm), members in sorted(groups.items())]
    pairs = [
        _pair(*sorted(pair, key=lambda g: -g["iqm"]))
        for pair in itertools.combinations(found, 2)
        if pair[0]["env"] == pair[1]["env"]
    ]
    warnings = [f"{g['algorithm']} in {g['env']}: {g['warning']}" for g in found if g["warning"]]
    for pair in pairs:
        steps = {
            g["steps"] for g in found if g["env"] == pair["env"] and g["algorithm"] in (pair["better"], pair["worse"])
        }
        if max(steps) > ROUNDING * min(steps):
            said = " and ".join(f"{s:,}" for s in sorted(steps))
            warnings.append(
                f"{pair['better']} and {pair['worse']} in {pair['env']} took different numbers of steps, {said}"
            )
    return {"groups": found, "comparisons": pairs, "warning": "; ".join(warnings) or None}


def _group(env: str, algorithm: str, members: Sequence[RunFolder]) -> dict[str, Any]:
    scores, steps = zip(*map(final_return, members), strict=True)
    values = np.asarray(scores)
    return {
        "env": env,
        "algorithm": algorithm,
        "seeds": len(values),
        "steps": max(steps),
        "iqm": float(interquartile_mean(values)),
        "iqm_ci95": list(confidence(values, interquartile_mean)),
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "returns": [float(v) for v in values],
        "warning": _warning(members, steps),
    }


def _warning(members: Sequence[RunFolder], steps: Sequence[int]) -> str | None:
    """What should keep one from trusting the numbers of a group."""
    configs = [folder.config() for folder in members]
    seeds = [config["seed"] for config in configs]
    said = []
    if len(members) < FEW:
        few = "one seed says" if len(members) == 1 else f"{len(members)} seeds say"
        said.append(f"{few} little about others, train at least {FEW}")
    if len(set(seeds)) < len(seeds):
        said.append(
            f"seed {next(s for s in seeds if seeds.count(s) > 1)} is there more than once and is no new evidence"
        )
    if max(steps) > ROUNDING * min(steps):
        said.append(f"the runs took between {min(steps):,} and {max(steps):,} steps")
    else:
        plain = [_flat({name: config[name] for name in ("learner", "loop", "env")}) for config in configs]
        different = [name for name in plain[0] if any(p.get(name) != plain[0][name] for p in plain)]
        if different:
            said.append(
                f"the runs differ in {different[0]}" + (f" and {len(different) - 1} more" if different[1:] else "")
            )
    return ", ".join(said) or None


def _flat(data: Any, name: str = "") -> dict[str, Any]:
    if not isinstance(data, dict):
        return {name: data}
    return {k: v for key, part in data.items() for k, v in _flat(part, f"{name}.{key}" if name else key).items()}


def _pair(better: dict[str, Any], worse: dict[str, Any]) -> dict[str, Any]:
    probability, interval = probability_of_improvement(np.asarray(better["returns"]), np.asarray(worse["returns"]))
    return {
        "env": better["env"],
        "better": better["algorithm"],
        "worse": worse["algorithm"],
        "seeds": min(better["seeds"], worse["seeds"]),
        "probability": probability,
        "probability_ci95": list(interval),
    }


def table(found: dict[str, Any]) -> str:
    """What `compare` found, as text for people."""
    rows = [("environment", "algorithm", "seeds", "steps", "IQM", "95 % interval", "mean", "median")]
    for g in found["groups"]:
        low, high = g["iqm_ci95"]
        interval = f"[{low:,.1f}, {high:,.1f}]" if g["seeds"] > 1 else "unknown"
        numbers = (f"{g[name]:,.1f}" for name in ("iqm", "mean", "median"))
        iqm, mean, median = numbers
        rows.append((g["env"], g["algorithm"], str(g["seeds"]), f"{g['steps']:,}", iqm, interval, mean, median))
    lines = _aligned(rows, left=2)
    if found["comparisons"]:
        rows = [("environment", "", "P(higher return)", "95 % interval")]
        for pair in found["comparisons"]:
            low, high = pair["probability_ci95"]
            name = f"{pair['better']} over {pair['worse']}"
            interval = f"[{low:.2f}, {high:.2f}]" if pair["seeds"] > 1 else "unknown"
            rows.append((pair["env"], name, f"{pair['probability']:.2f}", interval))
        lines += ["", *_aligned(rows, left=2)]
    if found["warning"]:
        lines += ["", *(f"warning: {part}" for part in found["warning"].split("; "))]
    return "\n".join(lines)


def _aligned(rows: Sequence[tuple[str, ...]], left: int) -> list[str]:
    """Rows as lines of equal columns, the first `left` of them aligned to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    pad = [str.ljust if i < left else str.rjust for i in range(len(widths))]
    return ["  ".join(f(cell, width) for f, cell, width in zip(pad, row, widths, strict=True)).rstrip() for row in rows]
