"""The picture of a solved board: colours for values, arrows for actions, letters for holes, cliffs and goals."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from .plot import picture_file, save_figure
from .solve import Panel, Solved, cell


def draw_solution(found: Solved, out: str | Path) -> Path:
    """Draw the boards of a solved environment into a file. Raises `ValueError` where it is no board."""
    if not found.panels:
        raise ValueError(f"{found.env} is no board that could be drawn: --json gives its values and policy")
    rows, columns = found.panels[0].states.shape
    size = 0.75 if columns > 8 else 0.95
    across = len(found.panels)
    figure = Figure(figsize=(size * columns * across + 1.6, size * rows + 1.1), layout="constrained")
    shown = np.concatenate([_values(found, panel).ravel() for panel in found.panels])
    low, high = np.nanmin(shown), np.nanmax(shown)
    for index, panel in enumerate(found.panels):
        axes = figure.add_subplot(1, across, index + 1)
        picture = axes.imshow(_values(found, panel), cmap="viridis", vmin=low, vmax=high if high > low else low + 1)
        axes.set_facecolor("#dddddd")
        for r in range(rows):
            for c in range(columns):
                value, symbol = cell(found, panel, r, c, True)
                level = (_values(found, panel)[r, c] - low) / max(high - low, 1e-12)
                colour = "black" if not value or level > 0.6 else "white"
                axes.text(c, r - 0.16 if value else r, symbol, ha="center", va="center", color=colour, fontsize=13)
                axes.text(c, r + 0.27, value, ha="center", va="center", color=colour, fontsize=7)
        for r, c in panel.walls:
            axes.plot([c + 0.5, c + 0.5], [r - 0.5, r + 0.5], color="black", linewidth=4, solid_capstyle="butt")
        axes.set_xticks(np.arange(columns + 1) - 0.5, [])
        axes.set_yticks(np.arange(rows + 1) - 0.5, [])
        axes.grid(color="white", linewidth=1)
        axes.tick_params(length=0)
        axes.set_title(panel.title or f"{found.env}, γ = {found.gamma:g}", fontsize=9)
        if index == across - 1:
            figure.colorbar(picture, ax=axes, label="V*", shrink=0.9)
    return save_figure(figure, picture_file(out))


def _values(found: Solved, panel: Panel) -> np.ndarray:
    """Values of the squares, NaN where nothing is done."""
    values = found.solution.value.values[panel.states].copy()
    rows, columns = panel.states.shape
    idle = [[not cell(found, panel, r, c, True)[0] for c in range(columns)] for r in range(rows)]
    values[np.array(idle)] = np.nan
    return values
