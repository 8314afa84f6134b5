"""Games so small that everything about them can be worked out by enumeration."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rewardtogo.core import Choices


class TreeGame(Choices):
    """A complete tree of random rewards: `rewards` `[depth, A^depth * K^depth, A, K]`, outcomes with `chances` `[K]`.

    The state is (depth, number of the node among those of its depth). With `players` 2 they take turns.
    """

    rewards: jax.Array
    chances: jax.Array
    players: int = eqx.field(static=True, default=1)

    @property
    def depth(self) -> int:
        return self.rewards.shape[0]

    @property
    def num_actions(self) -> int:
        return self.rewards.shape[2]

    def encode(self, observation: Any) -> Any:
        return observation

    def observe(self, state: Any) -> Any:
        return state

    def transition(self, state: Any, action: Any, key: Any) -> Any:
        outcome = jax.random.categorical(key, jnp.log(self.chances))
        fan = self.rewards.shape[2] * self.rewards.shape[3]
        child = state[1] * fan + action * self.rewards.shape[3] + outcome
        return jnp.stack([state[0] + 1, child])

    def reward(self, state: Any, action: Any, next_state: Any) -> Any:
        return self.rewards[state[0], state[1], action, next_state[1] % self.rewards.shape[3]]

    def terminal(self, state: Any) -> Any:
        return state[0] >= self.depth

    def legal(self, state: Any) -> Any:
        return jnp.ones(self.num_actions, bool)

    def player(self, state: Any) -> Any:
        return state[0] % self.players


ROOT = jnp.zeros(2, jnp.int32)


def random_tree(seed: int, depth: int = 3, actions: int = 3, outcomes: int = 1, players: int = 1) -> TreeGame:
    """Rewards uniform in [0, 1]."""
    rng = np.random.default_rng(seed)
    rewards = rng.random((depth, (actions * outcomes) ** depth, actions, outcomes)).astype(np.float32)
    chances = rng.dirichlet(np.full(outcomes, 3.0)).astype(np.float32)
    return TreeGame(jnp.asarray(rewards), jnp.asarray(chances), players)


def stack(games: list[TreeGame]) -> TreeGame:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *games)


def optimal_values(game: TreeGame, discount: float = 1.0) -> np.ndarray:
    """Q of the root's actions as the first player counts, by expectimax over the whole tree."""
    rewards, chances = np.float64(game.rewards), np.float64(game.chances)
    depth, _, actions, outcomes = rewards.shape
    value = np.zeros((actions * outcomes) ** depth)
    for level in reversed(range(depth)):
        nodes = (actions * outcomes) ** level
        ahead = value.reshape(nodes, actions, outcomes)
        q = ((rewards[level, :nodes] + discount * ahead) * chances).sum(-1)
        value = q.max(-1) if game.players == 1 or level % 2 == 0 else q.min(-1)
    return q[0]  # type: ignore[possibly-undefined]


class Endless(Choices):
    """Walks along the whole numbers, for ever; every step is worth 1."""

    allowed: bool = eqx.field(static=True, default=True)

    @property
    def num_actions(self) -> int:
        return 2

    def encode(self, observation: Any) -> Any:
        return observation

    def observe(self, state: Any) -> Any:
        return state

    def transition(self, state: Any, action: Any, key: Any) -> Any:
        return 2 * state + action + 1

    def reward(self, state: Any, action: Any, next_state: Any) -> Any:
        return jnp.ones(())

    def terminal(self, state: Any) -> Any:
        return jnp.zeros((), bool)

    def legal(self, state: Any) -> Any:
        return jnp.full(self.num_actions, self.allowed)

    def player(self, state: Any) -> Any:
        return jnp.zeros((), jnp.int32)
