"""Learning curves: return against environment steps, one run a line, several seeds of the same thing a mean with a band."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .folder import RunFolder


def group_name(folder: RunFolder) -> str:
    """What runs have in common that belong on one curve: algorithm and environment."""
    config = folder.config()
    return f"{config['algorithm']} · {config['env']['id']}"


def curve(folder: RunFolder) -> tuple[np.ndarray, np.ndarray]:
    """Steps and returns of the rows in which an episode ended; where none ever did (offline), of the evaluations."""
    metrics = folder.metrics()
    returns = metrics["return_mean"]
    if not np.any(np.isfinite(returns)) and "eval_return_mean" in metrics:
        returns = metrics["eval_return_mean"]
    known = np.isfinite(returns)
    return metrics["env_steps"][known], returns[known]


def draw_curves(paths: Sequence[str | Path], out: str | Path) -> Path:
    """Draw the learning curves of some runs into a picture (PNG, SVG or PDF, by the name's ending)."""
    folders = [RunFolder(p) for p in paths]
    groups: dict[str, list[RunFolder]] = {}
    for folder in folders:
        groups.setdefault(group_name(folder), []).append(folder)
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, members in groups.items():
        curves = [c for c in map(curve, members) if len(c[0])]
        if not curves:
            continue
        grid = np.linspace(max(c[0][0] for c in curves), min(c[0][-1] for c in curves), 200)
        table = np.stack([np.interp(grid, *c) for c in curves])
        label = name if len(curves) == 1 else f"{name} ({len(curves)} seeds)"
        (line,) = (
            axes.plot(*curves[0], label=label) if len(curves) == 1 else axes.plot(grid, table.mean(0), label=label)
        )
        if len(curves) > 1:
            spread = table.std(0, ddof=1) / np.sqrt(len(curves))
            axes.fill_between(
                grid,
                table.mean(0) - 1.96 * spread,
                table.mean(0) + 1.96 * spread,
                alpha=0.25,
                color=line.get_color(),
                lw=0,
            )
    if not axes.lines:
        axes.text(0.5, 0.5, "no episode has ended yet", ha="center", va="center", transform=axes.transAxes)
    else:
        axes.legend(frameon=False)
    offline = all(f.config()["loop"]["class"].endswith("Offline") for f in folders)
    axes.set_xlabel("gradient steps" if offline else "environment steps")
    axes.set_ylabel("return of an episode")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(out, dpi=130)
    return Path(out)
