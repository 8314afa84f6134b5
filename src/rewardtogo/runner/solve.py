"""`rtg solve`: an environment with a known table, solved by dynamic programming, and its value and policy as a picture of squares."""

import dataclasses
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Int

from ..core import Solution
from ..envs.sparse import SparseMDP
from ..envs.toy_text import gymnasium_table, table_mdp
from ..value.dynamic_programming import (
    backward_induction,
    gauss_seidel,
    modified_policy_iteration,
    policy_iteration,
    value_iteration,
)
from ..value.sweeping import prioritised_sweeping

Sweeping = Callable[..., Solution]
SWEEPING: dict[str, Sweeping] = {
    "value_iteration": value_iteration,
    "modified_policy_iteration": modified_policy_iteration,
    "gauss_seidel": gauss_seidel,
    "prioritised_sweeping": prioritised_sweeping,
}
"""The methods that take a tolerance."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """A board: which state each square is (-1: none), a letter for it where it has one, and the squares with a wall on their right."""

    title: str
    states: Int[np.ndarray, "R C"]
    letters: tuple[str, ...]
    walls: frozenset[tuple[int, int]] = frozenset()


@dataclasses.dataclass(frozen=True)
class Solved:
    """A solved environment: what was asked, what came out, and how to picture it. `symbols` are of the actions, with and without arrows."""

    env: str
    method: str
    gamma: float
    horizon: int | None
    problem: SparseMDP
    solution: Solution
    panels: tuple[Panel, ...]
    symbols: tuple[str, str]

    @property
    def expected_return(self) -> float:
        """E[V(s_0)]."""
        return float(self.problem.initial @ self.solution.value.values)

    @property
    def actions(self) -> Int[np.ndarray, "S"]:
        """What to do; with a horizon, at the first step."""
        actions = self.solution.value.actions
        return actions if actions.ndim == 1 else actions[0]

    def to_json(self) -> dict[str, Any]:
        """Plain data: what `rtg solve --json` prints."""
        stats, bound = self.solution.stats, float(self.solution.stats["error_bound"])
        return {
            "env": self.env,
            "method": self.method,
            "gamma": self.gamma,
            "horizon": self.horizon,
            "expected_return": self.expected_return,
            "sweeps": float(stats["sweeps"]),
            "bellman_residual": float(stats["bellman_residual"]),
            "error_bound": bound if np.isfinite(bound) else None,
            "converged": bool(self.solution.converged),
            "values": self.solution.value.values.tolist(),
            "policy": self.actions.tolist(),
        }


def solve_by_name(
    name: str,
    method: str = "value_iteration",
    *,
    gamma: float = 1.0,
    tolerance: float = 1e-10,
    horizon: int | None = None,
    **kwargs: Any,
) -> Solved:
    """Solve a Gymnasium environment that carries its table. Raises `ValueError` for one that has none, and for settings that cannot be."""
    if horizon is not None and method != "backward_induction":
        raise ValueError(f"{method} has no horizon: use --method backward_induction with --horizon {horizon}")
    if not (np.isfinite(gamma) and 0 <= gamma <= 1):
        raise ValueError(f"the discount must be a number in [0, 1], not {gamma:g}")
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise ValueError(f"the tolerance must be a number of more than 0, not {tolerance:g}")
    env = gymnasium_table(name, **kwargs)
    problem = table_mdp(env, gamma)
    if method == "backward_induction":
        horizon = gymnasium.spec(name).max_episode_steps if horizon is None else horizon
        if horizon is None:
            raise ValueError(f"{name} has no time limit: say how many actions an episode has, such as --horizon 100")
        solution = backward_induction(problem, horizon)
    elif method == "policy_iteration":
        solution = policy_iteration(problem)
    else:
        solution = SWEEPING[method](problem, tolerance=tolerance)
    return Solved(name, method, gamma, horizon, problem, solution, *_layout(env))


def _layout(env: Any) -> tuple[tuple[Panel, ...], tuple[str, str]]:
    """How to picture the states of the environments that are boards; nothing for others."""
    kind, count = type(env).__name__, len(env.P)
    if kind == "FrozenLakeEnv":
        letters = tuple("".join(c.decode() for c in row) for row in env.desc)
        return (Panel("", np.arange(count).reshape(env.desc.shape), letters),), ("←↓→↑", "<v>^")
    if kind == "CliffWalkingEnv":
        letters = ("            ", "            ", "            ", "SCCCCCCCCCCG")
        return (Panel("", np.arange(count).reshape(4, 12), letters),), ("↑→↓←", "^>v<")
    if kind == "TaxiEnv":
        corner = {(0, 0): "R", (0, 4): "G", (4, 0): "Y", (4, 3): "B"}
        letters = tuple("".join(corner.get((r, c), " ") for c in range(5)) for r in range(5))
        # Its drawing has a frame around it, and a column between any two.
        walls = frozenset((r, c) for r in range(5) for c in range(4) if env.desc[r + 1, 2 * c + 2] == b"|")
        states = lambda at: np.array([[env.encode(r, c, at, 1) for c in range(5)] for r in range(5)])  # noqa: E731
        waiting = Panel("the passenger waits at R and wants to G", states(0), letters, walls)
        inside = Panel("the passenger is in the taxi and wants to G", states(4), letters, walls)
        return (waiting, inside), ("↓↑→←PD", "v^><PD")
    return (), ("", "")


def report(found: Solved, arrows: bool = True) -> str:
    """A few lines about the solution, and its boards: the value and the best action of each square, the letter of a hole, cliff or goal."""
    stats = found.solution.stats
    sweeps, bound = float(stats["sweeps"]), float(stats["error_bound"])
    about = f"over {found.horizon} actions, " if found.horizon is not None else ""
    unit = "improvements" if found.method == "policy_iteration" else "sweeps"
    lines = [
        f"{found.env} by {found.method}, discount {found.gamma:g}: expected return {found.expected_return:.6g}",
        f"{about}{sweeps:.6g} {unit}, largest Bellman error {float(stats['bellman_residual']):.2g}"
        + (f", values within {bound:.2g} of the optimum" if np.isfinite(bound) else ""),
    ]
    if not found.solution.converged:
        lines.append("not settled: the tolerance is not reached")
    if found.horizon is not None and found.panels:
        lines.append("values and actions of the first step:")
    for panel in found.panels:
        lines += ["", *([panel.title] if panel.title else []), *_board(found, panel, arrows)]
    if not found.panels:
        lines += ["", "state  value        action", *_rows(found)]
    return "\n".join(lines)


def cell(found: Solved, panel: Panel, row: int, column: int, arrows: bool) -> tuple[str, str]:
    """What a square shows: its value and its action, or its letter where nothing is done there."""
    state = int(panel.states[row, column])
    letter = panel.letters[row][column]
    if found.problem.terminal[state] or letter == "C":
        return "", letter
    symbol = found.symbols[0 if arrows else 1][found.actions[state]]
    return f"{found.solution.value.values[state]:.3g}", symbol


def _board(found: Solved, panel: Panel, arrows: bool) -> list[str]:
    rows, columns = panel.states.shape
    cells = [[" ".join(c for c in cell(found, panel, r, k, arrows) if c) for k in range(columns)] for r in range(rows)]
    width = max(len(c) for row in cells for c in row)
    lines = []
    for r, row in enumerate(cells):
        between = [" |" if (r, k) in panel.walls else "  " for k in range(columns - 1)]
        lines.append("".join(c.rjust(width) + gap for c, gap in zip(row, [*between, ""], strict=True)))
    return lines


def _rows(found: Solved, most: int = 20) -> list[str]:
    values = found.solution.value.values
    shown = [f"{s:<7d}{values[s]:<13.6g}{found.actions[s]}" for s in range(min(most, len(values)))]
    rest = len(values) - most
    return shown + ([f"and {rest:,} states more: --json gives all"] if rest > 0 else [])
