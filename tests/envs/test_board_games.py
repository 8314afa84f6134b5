"""Boards of bits against boards of squares, and opponents against exhaustive search."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import MASK, env_spec
from rewardtogo.envs.board_games import ConnectFour, TicTacToe, open_windows
from rewardtogo.envs.opponents import (
    Minimax,
    PerfectOpponent,
    RandomOpponent,
    Versus,
    minimax,
    one_of,
)
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.loops import RandomPolicy, begin, collect

KEY = jax.random.key(0)
GAMES = {"tic-tac-toe": TicTacToe(), "connect four": ConnectFour(), "five by five": ConnectFour(5, 5, 4)}


def random_games(game: Any, count: int) -> Any:
    """States `[T + 1, N]` and actions `[T, N]` of random games, which stand still after their end."""

    def play(key: Any) -> Any:
        def step(state: Any, key: Any) -> Any:
            action = one_of(game.legal(state), key)
            following = game.transition(state, action, key)
            following = jax.tree.map(lambda a, b: jnp.where(game.terminal(state), a, b), state, following)
            return following, (following, action, game.reward(state, action, following))

        first = game.start(key)
        _, (states, actions, rewards) = jax.lax.scan(step, first, jax.random.split(key, game.rows * game.columns))
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, states), actions, rewards

    return jax.jit(jax.vmap(play))(jax.random.split(KEY, count))


def everywhere(function: Any, states: Any) -> Any:
    """A function of one state, of all of them `[N, T]`."""
    return jax.device_get(jax.jit(jax.vmap(jax.vmap(function)))(states))


def all_equal(a: Any, b: Any) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def has_line(squares: np.ndarray, length: int) -> bool:
    """Square by square, in the four directions."""
    rows, columns = squares.shape
    for r in range(rows):
        for c in range(columns):
            for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
                last = (r + dr * (length - 1), c + dc * (length - 1))
                inside = 0 <= last[0] < rows and 0 <= last[1] < columns
                if inside and all(squares[r + dr * k, c + dc * k] for k in range(length)):
                    return True
    return False


@pytest.mark.parametrize("name", GAMES)
def test_rules_square_by_square(name):
    game = GAMES[name]
    length = game.length if isinstance(game, ConnectFour) else 3
    states, actions, rewards = random_games(game, 24)
    look = lambda s: (game.terminal(s), game.player(s), game.legal(s), game.observe(s))  # noqa: E731
    terminal, player, legal, seen = everywhere(look, states)
    assert all_equal(everywhere(lambda s: game.encode(game.observe(s)), states), states)
    results = set()
    for i in range(24):
        boards = [np.zeros((game.rows, game.columns), bool) for _ in (0, 1)]
        for t in range(game.rows * game.columns):
            over = has_line(boards[0], length) or has_line(boards[1], length) or (boards[0] | boards[1]).all()
            assert terminal[i, t] == over
            if over:
                break
            mover, action, taken = t % 2, int(actions[i, t]), boards[0] | boards[1]
            assert player[i, t] == mover
            assert (seen["board"][i, t] == [boards[mover], boards[1 - mover]]).all()
            if isinstance(game, ConnectFour):
                assert (legal[i, t] == ~taken.all(0)).all()
                square = (int(taken[:, action].sum()), action)
            else:
                assert (legal[i, t] == ~taken.ravel()).all()
                square = divmod(action, 3)
            assert not taken[square]
            boards[mover][square] = True
            won = has_line(boards[mover], length)
            assert rewards[i, t] == (0 if not won else 1 if mover == 0 else -1)
            results.add(float(rewards[i, t]))
    assert results >= {-1.0, 0.0, 1.0}


def test_open_windows_square_by_square():
    game = ConnectFour()
    states, _, _ = random_games(game, 16)
    look = lambda s: (game.terminal(s), game.observe(s)["board"], open_windows(game, s))  # noqa: E731
    terminal, boards, scores = everywhere(look, states)
    compared = 0
    for i, t in itertools.product(range(16), (3, 9, 14, 15)):
        if terminal[i, t]:
            continue
        squares = (boards[i, t, 0].astype(int) - boards[i, t, 1]) * (1 if t % 2 == 0 else -1)
        assert scores[i, t] == pytest.approx(naive_windows(squares) / 1000)
        compared += scores[i, t] != 0
    assert compared > 20


def naive_windows(squares: np.ndarray) -> int:
    total = 0
    for r, c, (dr, dc) in itertools.product(range(6), range(7), ((0, 1), (1, 0), (1, 1), (1, -1))):
        line = [(r + dr * k, c + dc * k) for k in range(4)]
        if all(0 <= a < 6 and 0 <= b < 7 for a, b in line):
            stones = [squares[s] for s in line]
            total += sum(side * {2: 1, 3: 10}.get(stones.count(side), 0) for side in (1, -1) if -side not in stones)
    return total


def test_minimax_is_alpha_beta():
    """All lines side by side, against a search with cuts, one position after the other, on a small board."""
    game = ConnectFour(4, 4, 3)
    step = jax.jit(
        lambda s, a: (t := game.transition(s, a, KEY), game.reward(s, a, t), game.terminal(t), game.legal(t))
    )
    judge = jax.jit(lambda s: open_windows(game, s))

    def alpha_beta(state: Any, legal: Any, depth: int, low: float, high: float) -> float:
        side = 1 if int(state.plies) % 2 == 0 else -1
        if depth == 0:
            return side * float(judge(state))
        best = -np.inf
        for action in np.flatnonzero(legal):
            after, reward, over, free = step(state, jnp.asarray(action, jnp.int32))
            gain = side * float(reward)
            later = 0.0 if over else -alpha_beta(after, free, depth - 1, gain - high, gain - low)
            best = max(best, gain + later)
            low = max(low, best)
            if low >= high:
                break
        return best

    states, _, _ = random_games(game, 8)
    values = everywhere(lambda s: minimax(game, s, 3, open_windows).max(), states)
    terminal, legal = everywhere(lambda s: (game.terminal(s), game.legal(s)), states)
    places = [(i, t) for i in range(8) for t in (2, 5) if not terminal[i, t]]
    assert len(places) > 8
    for at in places:
        state = jax.tree.map(lambda x: x[at], states)  # noqa: B023
        assert values[at] == pytest.approx(alpha_beta(state, legal[at], 3, -np.inf, np.inf), abs=1e-6)


def results(env: Any, policy: Any, steps: int) -> np.ndarray:
    def play(key: Any) -> Any:
        _, rollout, _ = collect(env, policy, begin(env, policy, key), key, steps)
        return rollout.transitions.reward, rollout.transitions.terminated, rollout.transitions.observation

    reward, over, observation = jax.device_get(jax.jit(play)(KEY))
    # Who begins is drawn: an empty board, or one stone of the other's.
    starts = observation["board"][0].sum((1, 2, 3))
    assert set(starts.tolist()) == {0, 1}
    return reward[over]


def test_nobody_beats_the_perfect_player():
    game = TicTacToe()
    env = vectorize(Versus(game, PerfectOpponent()), 64)
    found = results(env, RandomPolicy(env_spec(env)), 20)
    assert found.max() == 0
    assert found.min() == -1
    # After two corners and the middle the corners lose: all lines to the end of the game say so, and so does the table.
    state = play(game, game.start(KEY), [0, 4, 8])
    values = np.asarray(jax.jit(lambda s: minimax(game, s, 6))(state))
    table = PerfectOpponent()
    moves = jax.jit(jax.vmap(lambda k: table(game, state, k)))(jax.random.split(KEY, 40))
    assert set(moves.tolist()) == set(np.flatnonzero(values == values.max()).tolist()) == {1, 3, 5, 7}


def play(game: Any, state: Any, moves: list[int]) -> Any:
    for move in moves:
        state = game.transition(state, jnp.asarray(move), KEY)
    return state


def test_a_random_player_is_sometimes_beaten_and_the_mask_is_kept():
    env = vectorize(Versus(TicTacToe(), RandomOpponent()), 64)
    found = results(env, RandomPolicy(env_spec(env)), 20)
    assert set(np.unique(found).tolist()) == {-1.0, 0.0, 1.0}
    # A board that is full or won allows nothing, and its mask everything.
    over = play(TicTacToe(), TicTacToe().start(KEY), [0, 3, 1, 4, 2])
    assert np.asarray(TicTacToe().observe(over)[MASK]).all()


def test_a_forbidden_move_loses():
    env = Versus(TicTacToe(), RandomOpponent())
    state, _ = env.reset(KEY)
    state = env.state_of(env.game.observe(play(env.game, env.game.start(KEY), [0, 1])))
    _, timestep = env.step(state, jnp.asarray(0), KEY)
    assert float(timestep.reward) == -1
    assert bool(timestep.terminated)


def test_what_cannot_be_is_said():
    with pytest.raises(ValueError, match="9 in a row do not fit"):
        ConnectFour(length=9)
    with pytest.raises(ValueError, match="1 to 7 rows"):
        ConnectFour(rows=8)
    with pytest.raises(ValueError, match="at least 1"):
        Minimax(0)
