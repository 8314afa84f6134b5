"""Learning curves: return against environment steps, one run a line, several seeds of the same thing a mean with a band."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from .folder import RunFolder

ENDINGS = (".png", ".svg", ".pdf", ".jpg", ".webp")
GRID = 200
"""Points of a mean over seeds, whose rows need not lie at the same steps."""
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
"""Colours that can be told apart without seeing all of them (Okabe and Ito 2008)."""
DASHES = ("-", "--", ":", "-.")
"""How the lines are drawn, which changes when the colours begin anew."""


def group_name(folder: RunFolder) -> str:
    """What runs have in common that belong on one curve: algorithm and environment."""
    config = folder.config()
    return f"{config['algorithm']} · {config['env']['id']}"


def run_folders(paths: Sequence[str | Path]) -> list[RunFolder]:
    """The run folders of some paths, each once; a folder of runs (`--num-seeds` with `--out`) stands for all of them."""
    found: dict[Path, RunFolder] = {}
    for path in map(Path, paths):
        inside = sorted(p.parent for p in path.glob("*/config.json")) if not (path / "config.json").exists() else []
        for one in inside or [path]:
            found.setdefault(one.resolve(), RunFolder(one))
    if not found:
        raise ValueError("there is no run to look at: give at least one run folder")
    return list(found.values())


def curve(folder: RunFolder) -> tuple[np.ndarray, np.ndarray]:
    """Steps and returns of the rows in which an episode ended; where none ever did (offline), of the evaluations."""
    metrics = _metrics(folder)
    known = np.isfinite(metrics["return_mean"])
    return (metrics["env_steps"][known], metrics["return_mean"][known]) if known.any() else evaluations(folder)


def evaluations(folder: RunFolder) -> tuple[np.ndarray, np.ndarray]:
    """Steps and mean returns of the evaluations while training."""
    metrics = _metrics(folder)
    returns = metrics.get("eval_return_mean", np.full_like(metrics["env_steps"], np.nan))
    known = np.isfinite(returns)
    return metrics["env_steps"][known], returns[known]


def _metrics(folder: RunFolder) -> dict[str, np.ndarray]:
    empty = {"env_steps": np.zeros(0), "return_mean": np.zeros(0)}
    return folder.metrics() if folder.metrics_file.exists() else empty


def smooth(values: np.ndarray, share: float = 0.1) -> np.ndarray:
    """Means over a window of about `share` of the curve, centred, cut off at both ends."""
    half, at = int(len(values) * share / 2), np.arange(len(values))
    sums = np.concatenate([[0.0], np.cumsum(values)])
    first, last = np.maximum(at - half, 0), np.minimum(at + half + 1, len(values))
    return (sums[last] - sums[first]) / (last - first)


def band(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps that all curves have, the mean over curves there, and half the width of its 95 % interval (Student's t)."""
    first, last = max(c[0][0] for c in curves), min(c[0][-1] for c in curves)
    grid = np.linspace(first, max(first, last), GRID)
    table = np.stack([np.interp(grid, *c) for c in curves])
    return grid, table.mean(0), student(len(curves) - 1) * table.std(0, ddof=1) / np.sqrt(len(curves))


def student(freedom: int) -> float:
    """The 97.5 % quantile of Student's t distribution: from a table up to 10, then by its series about the normal one."""
    table = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
    if freedom <= len(table):
        return table[freedom - 1]
    z = 1.959964
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)


def draw_curves(paths: Sequence[str | Path], out: str | Path) -> Path:
    """Draw the learning curves of some runs into a picture, of a kind by the name's ending.

    One run is drawn as it is, faintly, with a running mean; several of one algorithm and environment as their mean with its 95 %
    interval. Evaluations, which act without exploring, are dots.
    """
    file = picture_file(out)
    folders = run_folders(paths)
    groups: dict[str, list[RunFolder]] = {}
    for folder in folders:
        groups.setdefault(group_name(folder), []).append(folder)
    figure = Figure(figsize=(7.2, 4.3), layout="constrained")
    axes = figure.add_subplot()
    same = len({name.split(" · ")[1] for name in groups}) == 1
    for i, (name, members) in enumerate(groups.items()):
        style = {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i // len(COLOURS) % len(DASHES)]}
        _draw_group(axes, name.split(" · ")[0] if same else name, members, style)
    title = "" if not same else next(iter(groups)).split(" · ")[1] if len(groups) > 1 else next(iter(groups))
    _dress(axes, folders, title)
    return save_figure(figure, file)


def picture_file(out: str | Path) -> Path:
    """The file that a picture goes to. Raises `ValueError` for a name that does not end like a picture's."""
    file = Path(out)
    if file.suffix.lower() not in ENDINGS:
        raise ValueError(f"a picture is written to a file ending in {', '.join(ENDINGS)}, not to {out}")
    return file


def save_figure(figure: Figure, file: Path) -> Path:
    """Write a picture."""
    FigureCanvasAgg(figure)
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        figure.savefig(file, dpi=130)
    except ImportError as error:
        raise ValueError(f"{file} cannot be written: {error}") from error
    return file


def _draw_group(axes: Axes, name: str, members: Sequence[RunFolder], style: dict[str, Any]) -> None:
    """The line of one algorithm in one environment."""
    curves = [c for c in map(curve, members) if len(c[0])]
    if not curves:
        return
    if len(curves) > 1:
        steps, mean, half = band(curves)
        label = f"{name}, mean of {len(curves)} seeds and its 95 % interval"
        axes.plot(steps, mean, label=label, lw=1.8, zorder=3, **style)
        axes.fill_between(steps, mean - half, mean + half, color=style["color"], alpha=0.18, lw=0, zorder=2)
    else:
        steps, returns = curves[0]
        calm = smooth(returns)
        if np.allclose(calm, returns):
            axes.plot(steps, returns, label=name, lw=1.8, zorder=3, **style)
        else:
            axes.plot(steps, returns, color=style["color"], alpha=0.25, lw=1, zorder=1)
            axes.plot(steps, calm, label=f"{name}, running mean", lw=1.8, zorder=3, **style)
    _draw_evaluations(axes, members, style["color"])


def _draw_evaluations(axes: Axes, members: Sequence[RunFolder], colour: str) -> None:
    """A dot an evaluation, or the mean of the seeds where all were evaluated at the same steps."""
    dots = [d for d in map(evaluations, members) if len(d[0])]
    if not dots:
        return
    label = "evaluation, without exploring"
    steps, returns = (np.concatenate(parts) for parts in zip(*dots, strict=True))
    if len(dots) > 1 and all(np.array_equal(d[0], dots[0][0]) for d in dots):
        steps, returns = dots[0][0], np.mean([d[1] for d in dots], axis=0)
        label = "evaluation, without exploring, mean"
    axes.plot(steps, returns, linestyle="", marker="o", ms=4.5, mfc="white", mec=colour, label=label, zorder=4)


def _dress(axes: Axes, folders: Sequence[RunFolder], title: str) -> None:
    """Names, units, numbers that can be read, and a legend that covers nothing."""
    if not axes.lines:
        axes.text(0.5, 0.5, "no episode has ended yet", ha="center", va="center", transform=axes.transAxes)
    offline = all(f.config()["loop"].get("class", "").endswith("Offline") for f in folders)
    axes.set_xlabel("gradient steps" if offline else "environment steps")
    axes.set_ylabel("return of an episode")
    axes.set_title(title, fontsize=11)
    # Long numbers need more room than Matplotlib leaves them.
    axes.xaxis.set_major_locator(MaxNLocator(8 if axes.get_xlim()[1] < 1e6 else 5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}"))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:,.6g}"))
    axes.margins(x=0.02)
    axes.grid(alpha=0.25, lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.lines:
        axes.legend(frameon=False, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
