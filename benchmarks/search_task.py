"""What is searched in the `mcts` group, by this library and by mctx: the same positions, the same rules, the same network."""

from typing import Any

import gymnasium.spaces as spaces
import jax

from rewardtogo.core import EnvSpec, from_space
from rewardtogo.envs.board_games import ConnectFour
from rewardtogo.envs.opponents import one_of
from rewardtogo.nn import MLP
from rewardtogo.nn.actor_critic import ActorCritic
from rewardtogo.planning.self_play import PolicyValue

ROOTS, SIMULATIONS, PLIES = 64, 64, 6
GAME = ConnectFour()


def network(key: jax.Array) -> PolicyValue:
    """Two layers of 128, freshly drawn."""
    spec = EnvSpec(from_space(GAME.observation_space), from_space(spaces.Discrete(GAME.num_actions)))
    return PolicyValue(ActorCritic.of(MLP(128, 128, activation="relu"), spec, key, shared=True))


def roots(key: jax.Array) -> Any:
    """Positions after a few random moves, nobody having won."""

    def play(key: jax.Array) -> Any:
        step = lambda s, k: (GAME.transition(s, one_of(GAME.legal(s), k), k), None)  # noqa: E731
        return jax.lax.scan(step, GAME.start(key), jax.random.split(key, PLIES))[0]

    return jax.vmap(play)(jax.random.split(key, ROOTS))
