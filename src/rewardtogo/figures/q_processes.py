r"""Figure 6.2: Q-learning in general, as three processes whose rates are read from algorithms put together as usual.

Above, the parts and what flows between them. Below, a timeline for each of Algorithms 9 to 13: environment steps, regressions and moves
of the target, one mark each, so that what is in the inner loop of what can be seen.

Source: notes, section 6.2, figures 6.1 and 6.2 (items 6.2 and 6.9).
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from ..envs.cartpole import CartPole
from ..envs.time_limit import TimeLimit
from ..envs.vectorize import vectorize
from ..loops.off_policy import OffPolicy
from ..value.dqn import DQN
from ..value.general import (
    Rates,
    deep_q_learning,
    fitted_q_iteration,
    online_q_learning,
    replay_q_learning,
    target_q_learning,
)

INK, GREY = "#333333", "#888888"
COLOURS = ("#0072b2", "#d55e00", "#009e73")
PROCESSES = ("1: collect", "2: move the target", "3: regress")


def algorithms() -> dict[str, OffPolicy]:
    """The algorithms drawn, small enough for their marks to be counted."""
    env, learner = vectorize(TimeLimit(CartPole(), 500), 1), DQN(epsilon=0.1)
    sizes: dict[str, Any] = {"capacity": 64, "batch_size": 8, "warm_up": 8}
    return {
        "9: fitted Q-iteration": fitted_q_iteration(
            env, learner, data=12, iterations=3, gradient_steps=4, batch_size=8
        ),
        "10: online Q-learning": online_q_learning(env, learner),
        "11: with a replay": replay_q_learning(env, learner, collect=4, updates=4, **sizes),
        "12: and a target network": target_q_learning(env, learner, visits=2, collect=2, updates=3, **sizes),
        "13: DQN": deep_q_learning(env, learner, period=12, **sizes),
    }


def events(rates: Rates, length: int) -> tuple[list[int], list[int], list[int]]:
    """When each process does something, of `length` events in the order in which the loop takes them."""
    order = [0] * rates.collect + [2] * rates.updates
    times: tuple[list[int], list[int], list[int]] = ([], [], [])
    clock = updates = 0
    while clock < length:
        for process in order:
            times[process].append(clock)
            clock += 1
            if process == 2:
                updates += 1
                if updates % rates.move == 0:
                    times[1].append(clock - 1)
    return times


def draw(seed: int = 0, shown: dict[str, OffPolicy] | None = None) -> Figure:
    """The figure. `shown` are other algorithms by name, in place of Algorithms 9 to 13."""
    del seed
    made = algorithms() if shown is None else shown
    figure = Figure(figsize=(10, 3.2 + 0.95 * len(made)), layout="constrained")
    diagram, *lines = figure.subplots(1 + len(made), 1, height_ratios=[3.2, *[0.95] * len(made)])
    _draw_parts(diagram)
    for axis, (name, algorithm) in zip(lines, made.items(), strict=True):
        _draw_times(axis, name, Rates.of(algorithm))
    lines[-1].set_xlabel("time, an environment step or an update each")
    return figure


def _draw_parts(axis: Axes) -> None:
    boxes = {
        "environment": (0.9, 0.5),
        "replay\nkeeps the last steps": (3.7, 0.5),
        "Q network $\\phi$": (6.6, 0.5),
        "target $\\phi'$": (9.2, 0.5),
    }
    for text, (x, y) in boxes.items():
        axis.add_patch(
            FancyBboxPatch((x - 0.85, y - 0.16), 1.7, 0.32, "round,pad=0.04", facecolor="white", edgecolor=INK)
        )
        axis.text(x, y, text, ha="center", va="center", fontsize=11, color=INK)
    arrows = [
        ((1.85, 0.5), (2.75, 0.5), 0, 0.0, "$(s, a, r, s')$"),
        ((4.65, 0.5), (5.65, 0.5), 2, 0.0, "batches"),
        ((7.3, 0.72), (8.5, 0.72), 1, -0.4, "$\\phi' \\leftarrow (1 - \\tau) \\phi' + \\tau \\phi$"),
        ((8.5, 0.28), (7.3, 0.28), 2, -0.4, "$y = r + \\gamma \\max_a Q_{\\phi'}(s', a)$"),
        ((5.9, 0.28), (1.1, 0.28), 0, -0.18, "acts $\\epsilon$-greedily"),
        ((3.7, 0.72), (4.6, 0.98), 0, -0.3, "evicts the oldest"),
    ]
    for start, end, process, bend, text in arrows:
        style = {"arrowstyle": "-|>", "color": COLOURS[process], "linewidth": 1.8}
        axis.annotate("", end, start, arrowprops={**style, "connectionstyle": f"arc3,rad={bend}"})
        middle = np.add(start, end) / 2
        rise = 0.14 if bend == 0 else (0.3 if start[1] > 0.5 else -0.42 if process == 0 else -0.3)
        axis.text(middle[0], middle[1] + rise, text, ha="center", va="center", fontsize=9, color=COLOURS[process])
    for i, (name, colour) in enumerate(zip(PROCESSES, COLOURS, strict=True)):
        axis.text(0.1 + 2.6 * i, 1.25, name, fontsize=11, color=colour, weight="bold")
    axis.set(xlim=(0, 10.2), ylim=(-0.35, 1.35))
    axis.axis("off")


def _draw_times(axis: Axes, name: str, rates: Rates) -> None:
    length = 48
    for row, (times, colour) in enumerate(zip(events(rates, length), COLOURS, strict=True)):
        axis.plot(
            [t for t in times if t < length],
            [-row] * sum(t < length for t in times),
            "|",
            color=colour,
            markersize=9,
            markeredgewidth=2,
        )
    axis.set(xlim=(-1, length), ylim=(-2.6, 0.6), yticks=[], xticks=[])
    axis.set_title(
        f"{name}:  collect {rates.collect}, keep {rates.keep}, {rates.updates} updates of {rates.batch}, move every {rates.move}",
        fontsize=9, loc="left", color=INK,
    )  # fmt: skip
    axis.spines[["top", "right", "left"]].set_visible(False)
    axis.spines["bottom"].set_color(GREY)
