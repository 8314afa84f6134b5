"""Opponents, and a game against one as an environment: the other player is part of the world (item 8.18).

    RandomOpponent    any allowed move
    Minimax           looks a few moves ahead and chooses the best for itself, as alpha-beta search does
    PerfectOpponent   tic-tac-toe by a table of all positions

`Versus` is the environment.
"""

import functools
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from ..core import Action, Drawn, Game, Observation, Observed, PRNGKey, State, Timestep
from .board_games import TIC_TAC_TOE_LINES, Board, LineGame


class Opponent(eqx.Module):
    """Somebody to play against."""

    @abstractmethod
    def __call__(self, game: Game, state: State, key: PRNGKey) -> Action:
        """A move of whoever is to move."""


class RandomOpponent(Opponent):
    """All allowed moves are equally likely."""

    def __call__(self, game: Game, state: State, key: PRNGKey) -> Action:
        return one_of(game.legal(state), key)


class Minimax(Opponent):
    """The best move if both sides look `depth` moves ahead, the end of which `heuristic` judges; ties by lot.

    - `heuristic`: (game, state) -> a number, as the first player counts, in units of the game's rewards.
    - `discount`: a little less than 1 prefers a win soon to one later.
    """

    depth: int = eqx.field(static=True)
    heuristic: Callable[[Any, Any], Array] = eqx.field(default=lambda game, state: jnp.zeros(()), static=True)
    discount: float = eqx.field(default=0.99, static=True)

    def __check_init__(self) -> None:
        if self.depth < 1:
            raise ValueError(f"looking {self.depth} moves ahead sees nothing: give at least 1")

    def __call__(self, game: Game, state: State, key: PRNGKey) -> Action:
        values = minimax(game, state, self.depth, self.heuristic, self.discount)
        return one_of(values >= values.max() - 1e-6, key)


def minimax(
    game: Game,
    state: State,
    depth: int,
    heuristic: Callable[[Any, Any], Array] = lambda game, state: jnp.zeros(()),
    discount: float = 1.0,
) -> Float[Array, "A"]:
    """What each move is worth to who makes it if both sides play their best for `depth` moves; -inf for moves that are not allowed.

    All A^depth lines are looked at side by side, which in a compiled program is quicker than the cuts that alpha-beta makes one after the
    other; the values are the same. For games without chance.
    """
    key, side = jax.random.key(0), 1.0 - 2.0 * game.player(state)

    def after(action: Action) -> Float[Array, ""]:
        following = game.transition(state, action, key)
        over = game.terminal(following)
        if depth == 1:
            later = heuristic(game, following)
        else:
            # The best for the other side, counted by the first player.
            best = minimax(game, following, depth - 1, heuristic, discount).max()
            later = (1.0 - 2.0 * game.player(following)) * best
        return game.reward(state, action, following) + discount * jnp.where(over, 0.0, later)

    values = side * jax.vmap(after)(jnp.arange(game.num_actions, dtype=jnp.int32))
    return jnp.where(game.legal(state), values, -jnp.inf)


class PerfectOpponent(Opponent):
    """Tic-tac-toe without a mistake: any of the moves of the greatest minimax value."""

    table: Int[Array, "P"]

    def __init__(self) -> None:
        self.table = jnp.asarray(perfect_moves())

    def __call__(self, game: Game, state: Board, key: PRNGKey) -> Action:
        del game
        best = self.table[position(state.mine, state.theirs)]
        return one_of((best >> jnp.arange(9)) & 1 == 1, key)


def position(mine: Int[Array, ""], theirs: Int[Array, ""]) -> Int[Array, ""]:
    """The number of a position of tic-tac-toe, less than 3^9."""
    digits = ((mine >> jnp.arange(9)) & 1) + 2 * ((theirs >> jnp.arange(9)) & 1)
    return (digits * jnp.asarray(3 ** np.arange(9), jnp.int32)).sum(dtype=jnp.int32)


@functools.cache
def perfect_moves() -> Int[np.ndarray, "P"]:
    """The best moves in each position of tic-tac-toe as nine bits, by exhaustive search; 0 where no game comes to or none is left."""
    found = np.zeros(3**9, np.int32)
    weights = [3**i for i in range(9)]

    @functools.cache
    def value(mine: int, theirs: int) -> int:
        if any(theirs & line == line for line in TIC_TAC_TOE_LINES):
            return -1
        moves = [i for i in range(9) if not (mine | theirs) >> i & 1]
        if not moves:
            return 0
        values = {i: -value(theirs, mine | 1 << i) for i in moves}
        best = max(values.values())
        code = sum(w * ((mine >> i & 1) + 2 * (theirs >> i & 1)) for i, w in enumerate(weights))
        found[code] = sum(1 << i for i, v in values.items() if v == best)
        return best

    value(0, 0)
    return found


def one_of(allowed: Bool[Array, "A"], key: PRNGKey) -> Action:
    """Any of the actions that are allowed."""
    return jnp.where(allowed, jax.random.uniform(key, allowed.shape), -1.0).argmax().astype(jnp.int32)


class VersusState(eqx.Module):
    """The game, and which player the agent is: 0 the first, 1 the second."""

    game: State
    side: Int[Array, ""]


class Versus(Observed, Drawn):
    """`game` against `opponent`, who begins in half of the episodes. Reward: the game's, from the agent's side.

    A move that is not allowed loses at once.
    """

    game: Game
    opponent: Opponent

    @property
    def observation_space(self) -> spaces.Space:
        return self.game.observation_space

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(self.game.num_actions)

    def reset(self, key: PRNGKey) -> tuple[VersusState, Observation]:
        side_key, start_key, reply_key = jax.random.split(key, 3)
        side = jax.random.randint(side_key, (), 0, 2)
        state = self.game.start(start_key)
        replied, _ = self._reply(state, reply_key)
        state = jax.tree.map(lambda first, second: jnp.where(side == 0, first, second), state, replied)
        return VersusState(state, side), self.game.observe(state)

    def step(self, state: VersusState, action: Action, key: PRNGKey) -> tuple[VersusState, Timestep]:
        move_key, reply_key = jax.random.split(key)
        allowed = self.game.legal(state.game)[action]
        moved = self.game.transition(state.game, action, move_key)
        replied, answer = self._reply(moved, reply_key)
        over = self.game.terminal(moved)
        following = jax.tree.map(lambda own, other: jnp.where(over, own, other), moved, replied)
        gain = self.game.reward(state.game, action, moved) + jnp.where(over, 0.0, answer)
        reward = jnp.where(allowed, jnp.where(state.side == 0, gain, -gain), -1.0)
        observation = self.game.observe(following)
        terminated = ~allowed | self.game.terminal(following)
        timestep = Timestep(observation, reward, terminated, jnp.zeros((), bool), observation, {})
        return VersusState(following, state.side), timestep

    def render(self, state: VersusState, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"] | None:
        """The board, the agent's stones blue; None for a game without one."""
        del earlier
        if not isinstance(self.game, LineGame):
            return None
        board = jax.tree.map(jnp.asarray, state.game)
        moves = int(self.game.player(board)) == int(state.side)
        own, other = (board.mine, board.theirs) if moves else (board.theirs, board.mine)
        return self.game.draw(np.asarray(self.game.unpack(own)), np.asarray(self.game.unpack(other)))

    def state_of(self, observation: Observation) -> VersusState:
        state = self.game.encode(observation)
        return VersusState(state, self.game.player(state))

    def _reply(self, state: State, key: PRNGKey) -> tuple[State, Float[Array, ""]]:
        choice_key, move_key = jax.random.split(key)
        action = self.opponent(self.game, state, choice_key)
        following = self.game.transition(state, action, move_key)
        return following, self.game.reward(state, action, following)
