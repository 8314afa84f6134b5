"""Board games of two players in turn: who first has a line of stones wins (notes, section 8.2.3; item 8.18).

    TicTacToe      3 x 3, three in a row; perfect play is a draw
    ConnectFour    6 x 7, stones fall to the lowest free row of a column, four in a row; or another size and length

A board is bits, so that thousands of games side by side are a few vector instructions a move: a number of nine bits for tic-tac-toe, a byte
for each column for Connect Four. The stones of whoever is to move come first, and the sides are swapped after each move.
"""

from abc import abstractmethod

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, UInt8

from ..core import MASK, Action, Game, Observation, PRNGKey, State
from .canvas import BLUE, ORANGE, PAPER, STONE, Canvas

Bits = Array
"""The squares that somebody's stones are on, as the game packs them."""


class Board(eqx.Module):
    """A position: the stones of who is to move, the other's, how many there are, and whether the other has just won."""

    mine: Bits
    theirs: Bits
    plies: Int[Array, ""]
    lost: Bool[Array, ""]


class LineGame(Game):
    """A game that a line of stones wins: +1 for the first player, -1 for the second, 0 for a full board.

    The observation shows the board to who is to move, `board` `[2, rows, columns]`, own stones and the other's, and which moves are
    allowed. Others are no moves of the game: what follows one is undefined.
    """

    rows: eqx.AbstractVar[int]
    columns: eqx.AbstractVar[int]

    @abstractmethod
    def empty(self) -> Bits:
        """No stone at all."""

    @abstractmethod
    def place(self, mine: Bits, theirs: Bits, action: Action) -> Bits:
        """Own stones with one more."""

    @abstractmethod
    def has_line(self, stones: Bits) -> Bool[Array, ""]:
        """Whether there is a winning line among the stones."""

    @abstractmethod
    def unpack(self, stones: Bits) -> Int8[Array, "H W"]:
        """The squares as 0 and 1."""

    @abstractmethod
    def pack(self, squares: Int8[Array, "H W"]) -> Bits:
        """The inverse of `unpack`."""

    @abstractmethod
    def draw(self, own: Int8[np.ndarray, "H W"], other: Int8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "X Y 3"]:
        """A picture of two players' stones, the first one's blue."""

    @property
    def observation_space(self) -> spaces.Space:
        board = spaces.Box(0, 1, (2, self.rows, self.columns), np.int8)
        return spaces.Dict({"board": board, MASK: spaces.MultiBinary(self.num_actions)})

    def start(self, key: PRNGKey) -> Board:
        del key
        return Board(self.empty(), self.empty(), jnp.zeros((), jnp.int32), jnp.zeros((), bool))

    def transition(self, state: Board, action: Action, key: PRNGKey) -> Board:
        del key
        mine = self.place(state.mine, state.theirs, action)
        return Board(state.theirs, mine, state.plies + 1, self.has_line(mine))

    def reward(self, state: Board, action: Action, next_state: Board) -> Float[Array, ""]:
        del action
        winner = jnp.where(next_state.plies % 2 == 1, 1.0, -1.0)
        return jnp.where(next_state.lost & ~state.lost, winner, 0.0)

    def terminal(self, state: Board) -> Bool[Array, ""]:
        return state.lost | (state.plies >= self.rows * self.columns)

    def player(self, state: Board) -> Int[Array, ""]:
        return state.plies % 2

    def observe(self, state: Board) -> Observation:
        board = jnp.stack([self.unpack(state.mine), self.unpack(state.theirs)])
        # After the end nothing is allowed, and a mask without a choice is none that a policy could read.
        return {"board": board, MASK: (self.legal(state) | self.terminal(state)).astype(jnp.int8)}

    def encode(self, observation: Observation) -> Board:
        mine, theirs = (self.pack(jnp.asarray(observation["board"])[i]) for i in (0, 1))
        plies = jnp.asarray(observation["board"]).sum(dtype=jnp.int32)
        return Board(mine, theirs, plies, self.has_line(theirs))


TIC_TAC_TOE_LINES = (0b111, 0b111000, 0b111000000, 0b1001001, 0b10010010, 0b100100100, 0b100010001, 0b1010100)
"""The eight lines of tic-tac-toe; bit 3 r + c is the square in row r, column c."""


class TicTacToe(LineGame):
    """Three in a row. Actions: 3 r + c, a square."""

    rows: int = eqx.field(default=3, init=False, static=True)
    columns: int = eqx.field(default=3, init=False, static=True)

    @property
    def num_actions(self) -> int:
        return 9

    def empty(self) -> Bits:
        return jnp.zeros((), jnp.int32)

    def legal(self, state: State) -> Bool[Array, "A"]:
        return ((state.mine | state.theirs) >> jnp.arange(9)) & 1 == 0

    def place(self, mine: Bits, theirs: Bits, action: Action) -> Bits:
        del theirs
        return mine | (jnp.ones((), jnp.int32) << action)

    def has_line(self, stones: Bits) -> Bool[Array, ""]:
        lines = jnp.asarray(TIC_TAC_TOE_LINES, jnp.int32)
        return ((stones & lines) == lines).any()

    def unpack(self, stones: Bits) -> Int8[Array, "H W"]:
        return ((stones >> jnp.arange(9)) & 1).astype(jnp.int8).reshape(3, 3)

    def pack(self, squares: Int8[Array, "H W"]) -> Bits:
        return (squares.reshape(-1).astype(jnp.int32) << jnp.arange(9)).sum(dtype=jnp.int32)

    def draw(self, own: Int8[np.ndarray, "H W"], other: Int8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "X Y 3"]:
        """Crosses are `own`, rings the other's; row 0 is the highest."""
        sheet = Canvas((-0.1, -0.1), (3.1, 3.1))
        for edge in (1, 2):
            sheet.line([(edge, 0), (edge, 3)], 0.05, STONE)
            sheet.line([(0, edge), (3, edge)], 0.05, STONE)
        for row, column in np.argwhere(own):
            x, y = column + 0.5, 2.5 - row
            sheet.line([(x - 0.27, y - 0.27), (x + 0.27, y + 0.27)], 0.14, BLUE)
            sheet.line([(x - 0.27, y + 0.27), (x + 0.27, y - 0.27)], 0.14, BLUE)
        for row, column in np.argwhere(other):
            sheet.disc((column + 0.5, 2.5 - row), 0.35, ORANGE, 0.21)
        return sheet.picture()


class ConnectFour(LineGame):
    """Stones fall. Actions: a column. Row 0 is the lowest. A column is a byte, so that there are at most 7 rows and a spare bit."""

    rows: int = eqx.field(default=6, static=True)
    columns: int = eqx.field(default=7, static=True)
    length: int = eqx.field(default=4, static=True)

    def __check_init__(self) -> None:
        if not (1 <= self.rows <= 7 and 1 <= self.columns and 2 <= self.length):
            raise ValueError(
                f"a board has 1 to 7 rows, at least 1 column, and lines of at least 2, not {self.rows}, {self.columns} and {self.length}"
            )
        if self.length > min(self.rows, self.columns):
            raise ValueError(f"{self.length} in a row do not fit on a board of {self.rows} by {self.columns}")

    @property
    def num_actions(self) -> int:
        return self.columns

    def empty(self) -> Bits:
        return jnp.zeros(self.columns, jnp.uint8)

    def legal(self, state: State) -> Bool[Array, "A"]:
        return (state.mine | state.theirs) < 2**self.rows - 1

    def place(self, mine: Bits, theirs: Bits, action: Action) -> Bits:
        # A column filled to height h is 2^h - 1, so that one more is the bit of its next free square.
        return mine | jnp.where(jnp.arange(self.columns) == action, (mine | theirs) + jnp.uint8(1), jnp.uint8(0))

    def has_line(self, stones: Bits) -> Bool[Array, ""]:
        found = [jax.lax.reduce_and(line, (0,)).any() for line in self.windows(stones)]
        return found[0] | found[1] | found[2] | found[3]

    def windows(self, stones: Bits) -> list[UInt8[Array, "L C"]]:
        """All places for a line, in the four directions: the squares of each, one below the other, a bit for each row it may begin in."""
        steps, span = range(self.length), self.columns - self.length + 1
        ahead = [stones[k : k + span] for k in steps]
        return [
            jnp.stack([stones >> k for k in steps]),
            jnp.stack(ahead),
            jnp.stack([ahead[k] >> k for k in steps]),
            jnp.stack([ahead[k] << k for k in steps]),
        ]

    def unpack(self, stones: Bits) -> Int8[Array, "H W"]:
        return ((stones[None, :] >> jnp.arange(self.rows, dtype=jnp.uint8)[:, None]) & 1).astype(jnp.int8)

    def pack(self, squares: Int8[Array, "H W"]) -> Bits:
        weights = jnp.uint8(1) << jnp.arange(self.rows, dtype=jnp.uint8)
        return (squares.astype(jnp.uint8) * weights[:, None]).sum(0, dtype=jnp.uint8)

    def draw(self, own: Int8[np.ndarray, "H W"], other: Int8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "X Y 3"]:
        """Full discs are `own`, those with a hole the other's."""
        sheet = Canvas((0, 0), (self.columns, self.rows), STONE)
        for row, column in np.ndindex(self.rows, self.columns):
            middle = (column + 0.5, row + 0.5)
            sheet.disc(middle, 0.42, BLUE if own[row, column] else ORANGE if other[row, column] else PAPER)
            if other[row, column]:
                sheet.disc(middle, 0.18, PAPER)
        return sheet.picture()


def open_windows(game: ConnectFour, state: Board) -> Float[Array, ""]:
    """How promising a position is for the first player: places for a line in which only one side has stones, two less than a line for 1 and
    one less for 10, in units of which a win is worth 1,000.
    """
    everywhere = jnp.full(game.columns, 2**game.rows - 1, jnp.uint8)
    total = jnp.zeros(())
    for mine, theirs, board in zip(
        game.windows(state.mine), game.windows(state.theirs), game.windows(everywhere), strict=True
    ):
        inside = jax.lax.reduce_and(board, (0,))
        for stones, other, side in ((mine, theirs, 1.0), (theirs, mine, -1.0)):
            free = inside & ~jax.lax.reduce_or(other, (0,))
            for missing, worth in ((2, 1.0), (1, 10.0)):
                places = exactly(stones, game.length - missing) & free
                total = total + side * worth * jax.lax.population_count(places).sum(dtype=jnp.int32)
    return jnp.where(state.plies % 2 == 0, total, -total) / 1000.0


def exactly(rows: UInt8[Array, "L C"], count: int) -> UInt8[Array, "C"]:
    """The bits that are set in exactly `count` of the rows."""
    none = jnp.zeros_like(rows[0])
    # at_least[k]: set in at least k of the rows so far.
    at_least = [~none] + [none] * (count + 1)
    for row in rows:
        at_least = [at_least[0]] + [at_least[k] | (at_least[k - 1] & row) for k in range(1, count + 2)]
    return at_least[count] & ~at_least[count + 1]
