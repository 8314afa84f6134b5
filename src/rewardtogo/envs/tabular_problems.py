"""Small problems with known answers: random MDPs for property tests, a Pacman-like board, a tightrope, an aliased corridor, a walk.

Source: notes, section 1.1 (the Pacman reward, observations); Sutton and Barto (2018), examples 7.1 (the walk) and 13.1 (the corridor);
Singh, Jaakkola and Jordan (1994) on why a memoryless policy may have to be stochastic there.
"""

import itertools

import numpy as np
from jaxtyping import Float

from .tabular import MDP, POMDP

MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
"""The four actions of a board: up, right, down, left."""

PACMAN_BOARD = (
    "P  . ",
    "  #  ",
    ".#G  ",
    "   # ",
    "  .  ",
)
"""A 5x5 board: `P` the start, `.` a dot, `G` a ghost, `#` a wall."""


def random_mdp(
    seed: int,
    num_states: int,
    num_actions: int,
    *,
    discount: float = 0.9,
    horizon: int | None = None,
    num_terminal: int = 0,
    concentration: float = 1.0,
) -> MDP:
    """A random MDP: Dirichlet transitions and starts, normal rewards; the last `num_terminal` states are terminal.

    A small `concentration` makes the transitions nearly deterministic. Raises `ValueError` where no state would be
    left to act in.
    """
    if not 0 <= num_terminal < num_states:
        raise ValueError(
            f"{num_terminal} of {num_states} states cannot be terminal: "
            f"give a number from 0 to {num_states - 1}, so that one is left to start in"
        )
    rng = np.random.default_rng(seed)
    transitions = _dirichlet(rng, concentration, (num_states, num_actions, num_states))
    rewards = rng.normal(size=(num_states, num_actions))
    live = num_states - num_terminal
    initial = np.concatenate([_dirichlet(rng, 1.0, (live,)), np.zeros(num_terminal)])
    return MDP(transitions, rewards, initial, discount, np.arange(num_states) >= live, horizon)


def random_policy(
    seed: int, num_states: int, num_actions: int, horizon: int | None = None
) -> Float[np.ndarray, "... S A"]:
    """A random table of action probabilities `[S, A]`, or `[T, S, A]` for a `horizon`; every action is possible."""
    lead = () if horizon is None else (horizon,)
    return _dirichlet(np.random.default_rng(seed), 1.0, (*lead, num_states, num_actions))


ROPE, GROUND = 0, 1
"""States of `tightrope`."""
TIGHTROPE_EXPERT = np.array([0, 1])
"""What its expert does in each state: step along the rope, climb back up."""


def tightrope(horizon: int = 50, *, recovers: bool = True) -> MDP:
    """The worst problem for a copy (notes 2.4): `ROPE` and `GROUND`, actions 0 step and 1 climb, reward 1 where a step ends on the rope.

    Stepping on the rope keeps one there, any other action on it falls; on the ground, climbing leads back to the rope, or, unless it
    `recovers`, nothing does. The expert (`TIGHTROPE_EXPERT`) never falls, so that its data does not say what to do on the ground, and a
    copy that steps there too makes a mistake in every step after its first one.
    """
    transitions = np.zeros((2, 2, 2))
    transitions[[ROPE, ROPE, GROUND], [0, 1, 0], [ROPE, GROUND, GROUND]] = 1
    transitions[GROUND, 1, ROPE if recovers else GROUND] = 1
    return MDP(transitions, transitions[..., ROPE], ROPE, 1.0, horizon=horizon)


def _dirichlet(rng: np.random.Generator, concentration: float, shape: tuple[int, ...]) -> np.ndarray:
    # The floor keeps a row of very small gamma variates (a small concentration underflows) from dividing 0 by 0.
    gamma = np.maximum(rng.gamma(concentration, size=shape), 1e-12)
    return gamma / gamma.sum(-1, keepdims=True)


def pacman(board: tuple[str, ...] = PACMAN_BOARD, *, discount: float = 0.95, slip: float = 0.0) -> MDP:
    """The notes' example of a hand-made reward, +1 for a dot and -100 for the ghost, on a small board (item 1.11).

    - State: the square, and which dots are eaten: `dots_eaten * squares + square`, squares counted along the rows,
      dots as bits in that order. The episode ends on a ghost or with the last dot.
    - Actions: `MOVES`. Walls and edges stop a move. With probability `slip` a uniformly random move is made instead.

    Raises `ValueError` for a board that is not a rectangle with one `P` and at least one dot.
    """
    squares = [square for row in board for square in row]
    if (
        len({len(row) for row in board}) != 1
        or squares.count("P") != 1
        or "." not in squares
        or set(squares) - set("P.G# ")
    ):
        raise ValueError(
            f"the board {board!r} is not a rectangle of 'P', '.', 'G', '#' and ' ' with one 'P' and at least one '.'"
        )
    if not 0 <= slip <= 1:
        raise ValueError(f"slip is {slip} and must be a probability in [0, 1]")
    count, dots = len(squares), [i for i, square in enumerate(squares) if square == "."]
    states = count * 2 ** len(dots)
    outcomes = np.zeros((states, 4, states))
    gains = np.zeros((states, 4, states))
    terminal = np.zeros(states, bool)
    for eaten, square, action in itertools.product(range(2 ** len(dots)), range(count), range(4)):
        state, landing = eaten * count + square, _move(board, square, action)
        dot = 1 << dots.index(landing) if landing in dots else 0
        following = (eaten | dot) * count + landing
        outcomes[state, action, following] = 1
        gains[state, :, following] = -100 if squares[landing] == "G" else float(dot and not eaten & dot)
        terminal[state] = squares[square] == "G" or eaten == 2 ** len(dots) - 1
    transitions = (1 - slip) * outcomes + slip * outcomes.mean(1, keepdims=True)
    return MDP(transitions, gains, squares.index("P"), discount, terminal)


def _move(board: tuple[str, ...], square: int, action: int) -> int:
    """Where a move from a square ends: the same square at an edge or before a wall."""
    width = len(board[0])
    row, column = square // width + MOVES[action][0], square % width + MOVES[action][1]
    inside = 0 <= row < len(board) and 0 <= column < width
    return row * width + column if inside and board[row][column] != "#" else square


def aliased_corridor(*, discount: float = 1.0, horizon: int | None = None) -> POMDP:
    """Three squares and a goal that all look the same, and in the second of them left and right are swapped (item 1.6).

    Every step costs 1. With the state in view the goal is 3 steps away; a memoryless policy that goes right with
    probability p needs 2 (2 - p) / (p (1 - p)) steps, least at p = 2 - √2, where it is 6 + 4 √2 = 11.66, and for ever
    if it is deterministic.
    """
    left, right = 0, 1
    transitions = np.zeros((4, 2, 4))
    for state, (to_left, to_right) in enumerate([(0, 1), (2, 0), (1, 3)]):
        transitions[state, left, to_left] = transitions[state, right, to_right] = 1
    transitions[3, :, 3] = 1
    goal = np.arange(4) == 3
    return POMDP(MDP(transitions, -np.ones((4, 2)), 0, discount, goal, horizon), np.ones((4, 1)))


def random_walk(num_states: int = 19) -> MDP:
    """States 1 to `num_states` in a row, a terminal one at either end: reward -1 for the left one, +1 for the right one.

    Actions are a step left (0) and right (1), the start is in the middle. Under the uniform policy
    V(s) = 2 s / (num_states + 1) - 1, and an episode from the middle of 19 takes 100 steps in the mean. Raises
    `ValueError` without a state to start in.
    """
    if num_states < 1:
        raise ValueError(f"a walk over {num_states} states has nowhere to start: give at least 1")
    last = num_states + 1
    transitions, rewards = np.zeros((last + 1, 2, last + 1)), np.zeros((last + 1, 2))
    for state in range(1, last):
        transitions[state, 0, state - 1] = transitions[state, 1, state + 1] = 1
    transitions[[0, last], :, [0, last]] = 1
    rewards[1, 0], rewards[num_states, 1] = -1, 1
    return MDP(transitions, rewards, last // 2, 1.0, np.isin(np.arange(last + 1), (0, last)))
