r"""Figure 5.1, a Bellman backup and a projection, drawn to scale: the values of two states are the plane, what features can say a line.

The backup B brings every V nearer to V* in the sup norm, whose balls are squares: BV lies within γ of the distance. The projection Π onto
the line Ω brings nothing further apart in the L2 norm, whose balls are circles. One after the other they are a contraction in neither: in
the example V' = ΠBV is further from V* than V was, in both norms. Both states lead to the second one, the features are 1 and 2, γ = 0.9;
repeated, the values move out along Ω for ever, by 6γ/5 = 1.08 (item 5.27). At γ = 0.8 they settle, though not at V*.

Source: notes, section 5.4 and figure 5.1 (item 5.26). The numbers are our own; the notes' picture is a sketch.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..envs.tabular import MDP
from ..value.dynamic_programming import policy_iteration
from ..value.operators import bellman_backup, projection, sup_norm

FEATURES = np.array([[1.0], [2.0]])
OPTIMUM = np.array([0.5, 0.2])
"""V*, the same for every γ: rewards are chosen so."""
INK, GREEN, BLUE, ORANGE = "#333333", "#009e73", "#0072b2", "#d55e00"


class Step(NamedTuple):
    """What the left panel shows."""

    value: Float[np.ndarray, "2"]
    backed_up: Float[np.ndarray, "2"]
    projected: Float[np.ndarray, "2"]
    optimum: Float[np.ndarray, "2"]


def example(gamma: float) -> MDP:
    """Both states go to the second; a second action wastes a reward of 1, so that there is something to maximise over."""
    transitions = np.zeros((2, 2, 2))
    transitions[:, :, 1] = 1.0
    best = OPTIMUM - gamma * OPTIMUM[1]
    return MDP(transitions, np.stack([best, best - 1.0], 1), discount=gamma)


def one_step(gamma: float = 0.9) -> Step:
    """V = (1, 2), BV, ΠBV and V*."""
    mdp, value = example(gamma), FEATURES[:, 0]
    backed_up = bellman_backup(mdp, value)
    return Step(value, backed_up, projection(FEATURES) @ backed_up, policy_iteration(mdp).value.values)


def path(gamma: float, rounds: int, fitted: bool) -> Float[np.ndarray, "K 2"]:
    """Values after each backup, projected or not, from (1, 2)."""
    mdp, matrix, values = example(gamma), projection(FEATURES) if fitted else np.eye(2), [FEATURES[:, 0]]
    for _ in range(rounds):
        values.append(matrix @ bellman_backup(mdp, values[-1]))
    return np.stack(values)


def draw(seed: int) -> Figure:
    """The two panels; nothing in them is random."""
    del seed
    figure = Figure(figsize=(10.6, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_step(left, one_step())
    _draw_paths(right)
    return figure


def _draw_step(axes: Axes, step: Step) -> None:
    ends = np.array([-0.15, 1.45])
    axes.plot(ends, 2 * ends, color=INK, lw=1.2, label="Ω: what the features can say")
    radius = sup_norm(step.value - step.optimum)
    for share, style in ((1.0, ":"), (0.9, "--")):
        corner, side = step.optimum - share * radius, 2 * share * radius
        axes.add_patch(Rectangle((corner[0], corner[1]), side, side, fill=False, ec=GREEN, ls=style, lw=1.0))
    axes.plot([], [], color=GREEN, ls=":", label="as far from V* as V, in the sup norm")
    axes.plot([], [], color=GREEN, ls="--", label="γ times as far: where BV has to be")
    for begin, end, colour in ((step.value, step.backed_up, BLUE), (step.backed_up, step.projected, ORANGE)):
        axes.annotate(
            "",
            tuple(end),
            tuple(begin),
            arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8, "shrinkA": 4, "shrinkB": 4},
        )
    names = (("V", step.value, INK, (-16, -4)), ("BV", step.backed_up, BLUE, (8, -6)))
    names += (("V' = ΠBV", step.projected, ORANGE, (-62, 4)), ("V*", step.optimum, GREEN, (8, -12)))
    for text, point, colour, offset in names:
        axes.plot(*point, "o", color=colour, ms=6, zorder=5)
        axes.annotate(text, tuple(point), xytext=offset, textcoords="offset points", color=colour, fontsize=11)
    axes.set(xlabel="value of the first state", ylabel="value of the second state", aspect="equal")
    axes.set(xlim=(-1.45, 2.75), ylim=(-1.75, 2.75))
    axes.set_title("one backup and its projection, γ = 0.9", fontsize=11)
    axes.legend(frameon=False, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.13))


def _draw_paths(axes: Axes) -> None:
    for gamma, fitted, colour, text in (
        (0.9, True, ORANGE, "ΠB repeated, γ = 0.9"),
        (0.8, True, BLUE, "ΠB repeated, γ = 0.8"),
        (0.9, False, GREEN, "B repeated, γ = 0.9"),
    ):
        errors = np.abs(path(gamma, 60, fitted) - OPTIMUM).max(1)
        axes.plot(errors, color=colour, lw=1.8, label=text)
    axes.set(xlabel="backups", ylabel="largest error of a value", yscale="log", xlim=(0, 60))
    axes.set_title("and many of them", fontsize=11)
    axes.grid(alpha=0.25, lw=0.6)
    axes.legend(frameon=False, fontsize=9)
