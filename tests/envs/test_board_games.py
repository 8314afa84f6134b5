"""Boards of bits against boards of squares, and opponents against exhaustive search."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import MASK
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

    return jax.device_get(jax.jit(jax.vmap(play))(jax.random.split(KEY, count)))


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
    results = set()
    for i in range(24):
        boards = [np.zeros((game.rows, game.columns), bool) for _ in (0, 1)]
        for t in range(game.rows * game.columns):
            state = jax.tree.map(lambda x: x[i, t], states)  # noqa: B023
            over = has_line(boards[0], length) or has_line(boards[1], length) or (boards[0] | boards[1]).all()
            assert bool(game.terminal(state)) == over
            if over:
                break
            mover, action, taken = t % 2, int(actions[i, t]), boards[0] | boards[1]
            assert int(game.player(state)) == mover
            if isinstance(game, ConnectFour):
                assert (np.asarray(game.legal(state)) == ~taken.all(0)).all()
                square = (int(taken[:, action].sum()), action)
            else:
                assert (np.asarray(game.legal(state)) == ~taken.ravel()).all()
                square = divmod(action, 3)
            seen = game.observe(state)
            assert (np.asarray(seen["board"]) == [boards[mover], boards[1 - mover]]).all()
            back = game.encode(seen)
            assert all((a == b).all() for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(state), strict=True))
            boards[mover][square] = True
            won = has_line(boards[mover], length)
            assert rewards[i, t] == (0 if not won else 1 if mover == 0 else -1)
            results.add(float(rewards[i, t]))
    assert results >= {-1.0, 0.0, 1.0}


def test_open_windows_square_by_square():
    game = ConnectFour()
    states, _, _ = random_games(game, 8)
    for i in range(8):
        for t in (3, 9, 15):
            state = jax.tree.map(lambda x: x[i, t], states)  # noqa: B023
            planes = np.asarray(game.observe(state)["board"]).astype(int)
            first = planes[0] - planes[1] if t % 2 == 0 else planes[1] - planes[0]
            total = 0
            for r in range(6):
                for c in range(7):
                    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
                        line = [(r + dr * k, c + dc * k) for k in range(4)]
                        if all(0 <= a < 6 and 0 <= b < 7 for a, b in line):
                            stones = [first[s] for s in line]
                            for side in (1, -1):
                                if -side not in stones:
                                    total += side * {2: 1, 3: 10}.get(stones.count(side), 0)
            if not bool(game.terminal(state)):
                assert float(open_windows(game, state)) == pytest.approx(total / 1000)


def alpha_beta(game: Any, state: Any, depth: int, low: float, high: float) -> float:
    """The value for who is to move, with cuts, one position after the other."""
    side = 1 if int(state.plies) % 2 == 0 else -1
    if depth == 0:
        return side * float(open_windows(game, state))
    best = -np.inf
    for action in np.flatnonzero(np.asarray(game.legal(state))):
        after = game.transition(state, jnp.asarray(action), KEY)
        gain = side * float(game.reward(state, action, after))
        later = 0.0 if bool(game.terminal(after)) else -alpha_beta(game, after, depth - 1, -(high - gain), -(low - gain))
        best = max(best, gain + later)
        low = max(low, best)
        if low >= high:
            break
    return best


def test_minimax_is_alpha_beta():
    """The values of all lines side by side, against a search with cuts, on a small board."""
    game = ConnectFour(4, 4, 3)
    states, _, _ = random_games(game, 6)
    look = jax.jit(lambda s: minimax(game, s, 3, open_windows))
    compared = 0
    with jax.disable_jit(False):
        for i in range(6):
            state = jax.tree.map(lambda x: x[i, 4], states)  # noqa: B023
            if bool(game.terminal(state)):
                continue
            value = float(look(jax.tree.map(jnp.asarray, state)).max())
            assert value == pytest.approx(alpha_beta(game, state, 3, -np.inf, np.inf), abs=1e-6)
            compared += 1
    assert compared >= 3


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
    found = results(env, RandomPolicy(rtg_spec(env)), 20)
    assert found.max() == 0
    assert found.min() == -1
    # The whole tree of the game: from the start a draw.
    state = game.start(KEY)
    deep = minimax(game, jax.tree.map(jnp.asarray, play(game, state, [0, 4, 8])), 6)
    table = PerfectOpponent()
    moves = {int(table(game, play(game, state, [0, 4, 8]), k)) for k in jax.random.split(KEY, 40)}
    assert moves == set(np.flatnonzero(np.asarray(deep) == np.asarray(deep).max()).tolist()) == {1, 3, 5, 7}


def play(game: Any, state: Any, moves: list[int]) -> Any:
    for move in moves:
        state = game.transition(state, jnp.asarray(move), KEY)
    return state


def rtg_spec(env: Any) -> Any:
    from rewardtogo.core import env_spec

    return env_spec(env)


def test_a_random_player_is_sometimes_beaten_and_the_mask_is_kept():
    env = vectorize(Versus(TicTacToe(), RandomOpponent()), 64)
    found = results(env, RandomPolicy(rtg_spec(env)), 20)
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
