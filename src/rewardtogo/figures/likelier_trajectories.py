r"""Figure 3.1, "more rewarding trajectories become more probable": three of them, before and after one step.

On a board, from the middle of its left edge and under the uniform policy, take three trajectories τ, and one step

$$\theta' = \theta + \frac{\alpha}{3} \sum_i \nabla_\theta \log p_\theta(\tau_i)\, r(\tau_i), \qquad
\Delta \log p(\tau_j) \approx \frac{\alpha}{3} \sum_i \nabla \log p(\tau_j) \cdot \nabla \log p(\tau_i)\, r(\tau_i).$$

They share only the square where they begin, so that the scores of all three are as long, and every pair of them at the same angle: then
log p changes in the order of the rewards, whatever these are. In general a step only raises the expected reward.

Source: notes, section 3.2 (item 3.12). The problem is our own.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..envs.tabular import MDP
from ..envs.tabular_problems import MOVES
from ..exact import Trajectories, trajectory_log_prob
from ..exact.softmax import gradient_samples, softmax_policy

ROWS, COLUMNS = 5, 7
START = 2 * COLUMNS
PATHS = ("URRURRRR", "RRRRURDR", "DRRDRRRR")
"""The trajectories that are drawn: up, right, down, left. They meet nowhere but in the first square, and are equally long."""
GOAL, COIN, PIT = COLUMNS - 1, 2 * COLUMNS + 3, ROWS * COLUMNS - 1
GAINS = {GOAL: 1.0, COIN: 0.3, PIT: -1.0}
"""What entering these squares pays; `GOAL` and `PIT` end the episode."""
RATE = 1.0
INK, COLOURS = "#333333", ("#009e73", "#0072b2", "#d55e00")


def board() -> MDP:
    """The squares as states, `MOVES` as actions; an edge stops a move."""
    squares = ROWS * COLUMNS
    transitions, gains = np.zeros((squares, 4, squares)), np.zeros(squares)
    for square in range(squares):
        for action, (down, right) in enumerate(MOVES):
            row = min(max(square // COLUMNS + down, 0), ROWS - 1)
            column = min(max(square % COLUMNS + right, 0), COLUMNS - 1)
            transitions[square, action, row * COLUMNS + column] = 1
    gains[list(GAINS)] = list(GAINS.values())
    ends = np.isin(np.arange(squares), (GOAL, PIT))
    return MDP(transitions, transitions @ gains, START, 1.0, ends, len(PATHS[0]))


def trajectories(mdp: MDP) -> Trajectories:
    """The three, as if they had been sampled."""
    actions = np.array([["URDL".index(letter) for letter in path] for path in PATHS])
    states = np.full((len(PATHS), actions.shape[1] + 1), START)
    rewards = np.zeros(actions.shape)
    for t in range(actions.shape[1]):
        states[:, t + 1] = mdp.transitions[states[:, t], actions[:, t]].argmax(-1)
        rewards[:, t] = mdp.rewards[states[:, t], actions[:, t]]
    lengths, ended = np.full(len(PATHS), actions.shape[1]), np.ones(len(PATHS), bool)
    return Trajectories(states, actions, rewards, lengths, ended, ~ended, {})


class Step(NamedTuple):
    """Returns of the three, Δ log p of each, what it is to first order, and the logits after the step; before, they were 0."""

    returns: Float[np.ndarray, "N"]
    change: Float[np.ndarray, "N"]
    slope: Float[np.ndarray, "N"]
    logits: Float[np.ndarray, "S A"]


def step(rate: float = RATE) -> Step:
    """One step of the policy gradient, estimated from the three."""
    mdp, logits = board(), np.zeros((ROWS * COLUMNS, 4))
    drawn = trajectories(mdp)
    returns, scores = np.asarray(drawn.returns()), gradient_samples(logits, drawn)
    change = rate * np.tensordot(returns, scores, 1) / len(returns)
    old, new = (
        trajectory_log_prob(mdp, softmax_policy(x), np.asarray(drawn.observations), np.asarray(drawn.actions))
        for x in (logits, logits + change)
    )
    return Step(returns, new - old, np.einsum("nsa,sa->n", scores, change), logits + change)


def draw(seed: int = 0) -> Figure:
    """The figure. Nothing in it is random."""
    del seed
    figure = Figure(figsize=(12, 4.1), layout="constrained")
    before, after, bars = figure.subplots(1, 3, width_ratios=[1.45, 1.45, 1])
    found = step()
    _draw_board(before, np.zeros(3), np.zeros_like(found.logits))
    before.set_title("before: all actions (crosses) equally probable", fontsize=11)
    _draw_board(after, found.change, found.logits)
    after.set_title("after one step of the policy gradient", fontsize=11)
    _draw_bars(bars, found)
    return figure


def _draw_board(axis: Axes, change: np.ndarray, logits: np.ndarray) -> None:
    axis.set(xlim=(-0.55, COLUMNS - 0.45), ylim=(ROWS - 0.45, -0.55), aspect="equal")
    axis.axis("off")
    mdp, policy = board(), softmax_policy(logits)
    drawn = trajectories(mdp)
    for square in range(ROWS * COLUMNS):
        row, column = divmod(square, COLUMNS)
        colour = {GOAL: "#cfeee3", COIN: "#d6e8f5", PIT: "#f8ddcc"}.get(square, "white")
        axis.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=colour, edgecolor="#dddddd", linewidth=0.8))
        if not mdp.terminal[square] and (np.asarray(drawn.observations)[:, :-1] == square).any():
            for (down, right), p in zip(MOVES, policy[square], strict=True):
                axis.plot(
                    [column, column + 0.8 * p * right], [row, row + 0.8 * p * down], color=INK, linewidth=1.2, zorder=4
                )
    axis.plot(0, 2, "o", color=INK, markersize=7, zorder=5)
    for square, gain in GAINS.items():
        row, column = divmod(square, COLUMNS)
        axis.text(
            column + 0.22, row + 0.34, f"{gain:+g}".replace("-", "−"), ha="center", va="center", fontsize=10, color=INK
        )
    labels = ((1.0, 0.55), (1.5, 1.62), (1.0, 3.5))
    for i, (states, colour) in enumerate(zip(np.asarray(drawn.observations), COLOURS, strict=True)):
        rows, columns = np.divmod(states, COLUMNS)
        axis.plot(
            columns, rows, color=colour, linewidth=3.5 * np.exp(change[i] / 2), alpha=0.85, solid_joinstyle="round"
        )
        p = 1e5 * np.exp(change[i]) / 4.0 ** len(PATHS[0])
        axis.text(
            *labels[i],
            f"$p(\\tau_{i + 1})$ = {p:.2g}$\\cdot 10^{{-5}}$",
            color=colour,
            fontsize=9,
            ha="center",
            va="center",
        )


def _draw_bars(axis: Axes, found: Step) -> None:
    returns, change, slope, _ = found
    place = np.arange(len(returns))
    axis.bar(place, change, color=COLOURS, width=0.55)
    axis.plot(place, slope, "_", color=INK, markersize=30, markeredgewidth=1.5, label="to first order in $\\alpha$")
    axis.axhline(0, color=INK, linewidth=0.8)
    axis.set_xticks(place, [f"$r(\\tau_{i + 1}) = {r:g}$" for i, r in enumerate(returns)])
    axis.set_ylabel("$\\Delta \\log p(\\tau)$")
    axis.set_title("change, in the order of the rewards", fontsize=11)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9)
