"""UCT against alpha-beta in Connect Four: 200 games, sides alternating, two random opening plies. Slow."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.envs.board_games import ConnectFour, open_windows
from rewardtogo.envs.opponents import Minimax, one_of
from rewardtogo.planning.guides import Rollouts
from rewardtogo.planning.tree_policies import UCT
from rewardtogo.planning.tree_search import TreeSearch, mcts

GAME = ConnectFour()
FAST = {"xla_backend_optimization_level": 3}


def match(search: TreeSearch, opponent: Minimax, games: int, seed: int = 0) -> np.ndarray:
    """Results of the search, 1 won, 0 drawn, -1 lost: it moves first in the first half of the games, second in the others."""
    half, key = games // 2, jax.random.key(seed)
    thinks = jax.jit(jax.vmap(lambda s, k: mcts(GAME, s, k, search).value.action), compiler_options=FAST)
    answers = jax.jit(jax.vmap(lambda s, k: opponent(GAME, s, k)), compiler_options=FAST)
    opens = jax.jit(jax.vmap(lambda s, k: one_of(GAME.legal(s), k)))

    @jax.jit
    @jax.vmap
    def move(state: Any, action: Any) -> Any:
        following = GAME.transition(state, action, key)
        over = GAME.terminal(state)
        reward = jnp.where(over, 0.0, GAME.reward(state, action, following))
        following = jax.tree.map(lambda old, new: jnp.where(over, old, new), state, following)
        return following, reward, GAME.terminal(following)

    start = jax.tree.map(lambda x: jnp.broadcast_to(x, (half, *x.shape)), GAME.start(key))
    states, results = [start, start], [np.zeros(half), np.zeros(half)]
    for ply in range(GAME.rows * GAME.columns):
        over = []
        for side in (0, 1):  # which player the search is
            keys = jax.random.split(jax.random.fold_in(key, 2 * ply + side), half)
            choose = opens if ply < 2 else thinks if ply % 2 == side else answers
            states[side], reward, ended = move(states[side], choose(states[side], keys))
            results[side] += np.asarray(reward) * (1 if side == 0 else -1)
            over.append(bool(ended.all()))
        if all(over):
            break
    return np.concatenate(results)


@pytest.mark.slow
def test_uct_beats_alpha_beta(item):
    search = TreeSearch(
        simulations=2000, rule=UCT(exploration=0.2), guide=Rollouts(horizon=42), max_depth=42, bounds=(-1.0, 1.0)
    )
    results = match(search, Minimax(4, open_windows), 200)
    with item("8.18") as check:
        share = (results == 1).mean()
        check(share, ">=", 0.65, "games won of 200 in Connect Four, UCT with 2,000 simulations against depth 4")
