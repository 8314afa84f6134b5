"""Drawings of the toy environments, whose states are numbers of squares: FrozenLake, CliffWalking, Taxi."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from ..core import State
from .canvas import BLUE, GREEN, INK, MIST, PAPER, SKY, STONE, VERMILION, YELLOW, Canvas, Colour

ICE: Colour = (222, 239, 250)
Square = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class Walk:
    """Who walks over a board of letters: `S` start, `F` free, `H` hole, `C` cliff, `G` goal. A state is the number of a square."""

    board: tuple[str, ...]
    ground: Colour = PAPER

    def __call__(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """The board, the way so far, and where it led."""
        columns = len(self.board[0])
        sheet = _squares(len(self.board), columns, self.ground)
        for row, letters in enumerate(self.board):
            for column, letter in enumerate(letters):
                middle = _middle((row, column), len(self.board))
                if letter == "H":
                    sheet.disc(middle, 0.38, INK)
                elif letter == "C":
                    _fill(sheet, middle, VERMILION)
                elif letter == "G":
                    sheet.disc(middle, 0.42, GREEN, 0.3, self.ground)
        way = [_middle(divmod(int(s), columns), len(self.board)) for s in (*earlier, state)]
        for one, other in itertools.pairwise(way):
            # Whoever falls from the cliff is back at the start at once.
            if abs(one[0] - other[0]) + abs(one[1] - other[1]) == 1:
                sheet.line([one, other], 0.07, SKY)
        sheet.disc(way[-1], 0.24, BLUE)
        return sheet.picture()


STANDS: tuple[Square, ...] = ((0, 0), (0, 4), (4, 0), (4, 3))
"""Where passengers wait and want to go to, in Gymnasium's order."""


@dataclasses.dataclass(frozen=True)
class Taxi:
    """A taxi (yellow), its passenger (a blue disc, waiting or aboard), where they want to go (a ring), and walls."""

    walls: frozenset[Square]
    """Squares with a wall on their right."""

    def __call__(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"]:
        """A state is ((row 5 + column) 5 + passenger) 4 + destination; a passenger in place 4 is aboard."""
        del earlier
        rest, destination = divmod(int(state), 4)
        place, passenger = divmod(rest, 5)
        sheet = _squares(5, 5, PAPER)
        for stand in STANDS:
            _fill(sheet, _middle(stand, 5), MIST)
        sheet.disc(_middle(STANDS[destination], 5), 0.42, GREEN, 0.3, MIST)
        for row, column in self.walls:
            sheet.line([(column + 1, 5 - row), (column + 1, 4 - row)], 0.09, INK)
        x, y = _middle(divmod(place, 5), 5)
        sheet.box((x - 0.36, y - 0.24), (x + 0.36, y + 0.24), INK)
        sheet.box((x - 0.33, y - 0.21), (x + 0.33, y + 0.21), YELLOW)
        sheet.disc((x, y) if passenger == 4 else _middle(STANDS[passenger], 5), 0.16, BLUE)
        return sheet.picture()


def _squares(rows: int, columns: int, ground: Colour) -> Canvas:
    sheet = Canvas((-0.04, -0.04), (columns + 0.04, rows + 0.04), STONE)
    for number in range(rows * columns):
        _fill(sheet, _middle(divmod(number, columns), rows), ground)
    return sheet


def _middle(square: Square, rows: int) -> tuple[float, float]:
    """Rows are counted from the top."""
    return square[1] + 0.5, rows - square[0] - 0.5


def _fill(sheet: Canvas, middle: tuple[float, float], colour: Colour) -> None:
    x, y = middle
    sheet.box((x - 0.48, y - 0.48), (x + 0.48, y + 0.48), colour)
