"""Figure 1.1: a Markov chain, and how its state distribution settles.

Above, the chain unrolled in time: s_{t+1} depends on the past through s_t alone. Left, its states and the
probabilities of moving between them. Right, d_t = d_0 P^t (lines), the shares of states in sampled chains (dots), and
the stationary d = d P (dashes).

Source: notes, figure 1.1; erratum E1.4 on what the arrows say.
"""

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch
from matplotlib.path import Path

from ..exact import chain_distributions, simulate_chain, stationary_distribution

TRANSITIONS = np.array([[0.1, 0.6, 0.3, 0.0], [0.0, 0.5, 0.2, 0.3], [0.2, 0.0, 0.4, 0.4], [0.5, 0.0, 0.0, 0.5]])
"""P of the chain that is drawn."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#aa4499")
"""Of its states; told apart by people with colour-blindness too."""

CENTRES = np.array([[-1.0, 0.85], [1.0, 0.85], [1.0, -0.85], [-1.0, -0.85]])
RADIUS = 0.24
INK = "#333333"


def draw(seed: int = 0, num_chains: int = 1000, steps: int = 14) -> Figure:
    """The figure; `num_chains` chains of `steps` steps are simulated from `seed`, all from state 0."""
    figure = Figure(figsize=(10, 5.4), layout="constrained")
    axes = figure.subplot_mosaic(
        [["unrolled", "unrolled"], ["graph", "curves"]], height_ratios=[1, 3.6], width_ratios=[1, 1.3]
    )
    _draw_unrolled(axes["unrolled"])
    _draw_graph(axes["graph"])
    _draw_curves(axes["curves"], seed, num_chains, steps)
    return figure


def _blank(axis: Axes, width: float, height: float) -> None:
    axis.set(xlim=(-width, width), ylim=(-height, height), aspect="equal")
    axis.axis("off")


def _node(axis: Axes, centre: np.ndarray, radius: float, label: str, colour: str, fill: str) -> None:
    axis.add_patch(Circle((centre[0], centre[1]), radius, facecolor=fill, edgecolor=colour, linewidth=1.8, zorder=2))
    axis.text(centre[0], centre[1], label, ha="center", va="center", fontsize=13, color=INK, zorder=3)


def _arrow(axis: Axes, start: np.ndarray, end: np.ndarray, bend: float = 0.0) -> None:
    axis.add_patch(
        FancyArrowPatch(
            (start[0], start[1]), (end[0], end[1]), connectionstyle=f"arc3,rad={bend}", arrowstyle="-|>",
            mutation_scale=13, linewidth=1.3, color=INK, shrinkA=0, shrinkB=0, zorder=1,
        )
    )  # fmt: skip


def _draw_unrolled(axis: Axes) -> None:
    _blank(axis, 6.0, 0.75)
    places = np.array([-4.0, -2.0, 0.0, 2.0, 4.0])
    for place, label in zip(places, ["$s_0$", "$s_1$", "$s_2$", "$\\cdots$", "$s_T$"], strict=True):
        if label == "$\\cdots$":
            axis.text(place, 0, label, ha="center", va="center", fontsize=15, color=INK)
        else:
            _node(axis, np.array([place, 0.0]), 0.42, label, INK, "#f2f2f2")
    for left in places[:-1]:
        _arrow(axis, np.array([left + 0.5, 0.0]), np.array([left + 1.5, 0.0]))
    axis.text(places[0] + 1, 0.2, "$P(s_1 | s_0)$", ha="center", va="bottom", fontsize=10, color=INK)
    axis.set_title("Given $s_t$, the next state $s_{t+1}$ is independent of everything before", fontsize=11)


def _draw_graph(axis: Axes) -> None:
    _blank(axis, 1.95, 1.65)
    for state, centre in enumerate(CENTRES):
        _node(axis, centre, RADIUS, f"${state}$", COLOURS[state], "white")
        for following in np.flatnonzero(TRANSITIONS[state]):
            probability = f"{TRANSITIONS[state, following]:g}"
            if following == state:
                _draw_loop(axis, centre, probability)
            else:
                _draw_edge(axis, centre, CENTRES[following], probability)
    axis.set_title("transition probabilities $P(s' | s)$", fontsize=11)


def _draw_edge(axis: Axes, start: np.ndarray, end: np.ndarray, label: str) -> None:
    """A bent arrow, so that the two directions between a pair do not cover each other."""
    bend, along = -0.18, (end - start) / np.linalg.norm(end - start)
    side = np.array([along[1], -along[0]])
    begin, stop = start + RADIUS * _turned(along, 0.3), end - RADIUS * _turned(along, -0.3)
    _arrow(axis, begin, stop, bend)
    # On the quadratic curve that matplotlib draws; off the middle, where diagonals cross.
    share = 0.5 if np.any(start == end) else 0.24
    control = (begin + stop) / 2 + bend * np.linalg.norm(stop - begin) * side
    place = (1 - share) ** 2 * begin + 2 * share * (1 - share) * control + share**2 * stop
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
    axis.text(place[0], place[1], label, ha="center", va="center", fontsize=10, color=INK, bbox=box, zorder=3)


def _turned(vector: np.ndarray, angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ vector


def _draw_loop(axis: Axes, centre: np.ndarray, label: str) -> None:
    outwards = centre / np.linalg.norm(centre)
    points = [centre + size * _turned(outwards, angle) for size, angle in zip(
        (RADIUS, 0.78, 0.78, RADIUS + 0.02), (0.6, 0.6, -0.6, -0.6), strict=True)]  # fmt: skip
    path = Path(np.stack(points), [Path.MOVETO, Path.CURVE4, Path.CURVE4, Path.CURVE4])
    axis.add_patch(FancyArrowPatch(path=path, arrowstyle="-|>", mutation_scale=13, linewidth=1.3, color=INK, zorder=1))
    place = centre + 0.76 * outwards
    axis.text(place[0], place[1], label, ha="center", va="center", fontsize=10, color=INK)


def _draw_curves(axis: Axes, seed: int, num_chains: int, steps: int) -> None:
    initial = np.eye(4)[0]
    exact = chain_distributions(TRANSITIONS, initial, steps)
    states = np.asarray(simulate_chain(TRANSITIONS, initial, jax.random.key(seed), num_chains, steps))
    limit, time = stationary_distribution(TRANSITIONS), np.arange(steps + 1)
    for state, colour in enumerate(COLOURS):
        axis.axhline(limit[state], color=colour, linestyle=(0, (4, 3)), linewidth=1, alpha=0.7)
        axis.plot(time, exact[:, state], color=colour, linewidth=1.8, label=f"state {state}")
        axis.plot(time, (states == state).mean(0), "o", color=colour, markersize=4.5, markeredgecolor="white")
    axis.set(xlabel="time $t$", ylabel="probability of the state", xlim=(-0.3, steps + 0.3), ylim=(-0.02, 1.02))
    axis.set_title(f"$d_t = d_0 P^t$ (lines), {num_chains} simulated chains (dots), $d = dP$ (dashes)", fontsize=11)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, ncols=2, loc="upper right")
