r"""AlphaZero: a network that guides a search, and learns from what the search made of it (Silver et al. 2018; item 8.25).

Whole games are played by the search against itself. Each position teaches

    loss(theta) = -sum_a pi(a) log p_theta(a | s) + c_v (v_theta(s) - z)^2,

with pi the share of the root's visits that each move got and z = sum_t gamma^t r_t how the game went on, from the side of who was to
move. The search is PUCT with (p_theta, v_theta) in place of rollouts, noise at the root, and moves drawn by visits in the opening.

Deviations: no symmetries of the board, no residual network, values that are not squashed, one player with the newest parameters, and no
decay of weights.
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ..core import (
    Algorithm,
    Batch,
    Choices,
    Configured,
    EnvSpec,
    Episodes,
    Game,
    Learner,
    Number,
    Observation,
    PRNGKey,
    State,
    Transition,
    VectorEnv,
    env_spec,
    fix_horizon,
    number,
    part,
    require_action,
    setting,
)
from ..data.replay import Replay, ReplayState, UniformReplay
from ..nn import MLP, Network, as_network
from ..nn.actor_critic import ActorCritic, ActorCriticPolicy
from ..nn.optimise import Optimiser, global_norm
from ..ops.distributions import Categorical
from .guides import Guided, is_over, sign
from .tree_policies import PUCT
from .tree_search import TreeSearch, mcts

VISITS, OUTCOME, PLAYED = "visits", "outcome", "played"
"""Names in `Transition.extras`: the root's shares of visits, how the game went on, and whether the position came up at all."""


class PolicyValue(eqx.Module):
    """Logits of the moves, and a value for who is to move: what a `Guided` search asks."""

    network: ActorCritic

    def __call__(self, observation: Observation) -> tuple[Float[Array, "A"], Float[Array, ""]]:
        memory = self.network.init()
        _, distribution = self.network.act(memory[0], observation)
        if not isinstance(distribution, Categorical):
            raise ValueError("a tree search needs a network that chooses one of several numbered actions")
        return distribution.logits, self.network.value(memory, observation)


class AlphaZeroState(eqx.Module):
    """Network, optimiser, and the number of updates done."""

    network: ActorCritic
    optimiser: optax.OptState
    updates: Int[Array, ""]


class AlphaZero(Learner):
    """Fits moves to shares of visits and values to outcomes. Acts, outside of a search, by the network's moves alone."""

    network: Network = part(MLP(128, 128, activation="relu"), "recipe of the network", converter=as_network)
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    value_cost: Number = number(1.0, "c_v: weight of the values' error", at_least=0)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)

    @property
    def batch(self) -> Literal["transitions"]:
        return "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete",)

    def init(self, spec: EnvSpec, key: PRNGKey) -> AlphaZeroState:
        require_action("AlphaZero", spec, self.action_kinds)
        if self.network.has_memory:
            raise ValueError(
                "a search starts from positions and has no past: give AlphaZero a network without a memory"
            )
        network = ActorCritic.of(self.network, spec, key, shared=True)
        zero = jnp.zeros((), jnp.int32)
        return AlphaZeroState(network, self.at(zero)._optimiser().init(network), zero)

    def policy(self, state: AlphaZeroState, explore: bool) -> ActorCriticPolicy:
        return ActorCriticPolicy(state.network, None, explore)

    def guide(self, state: AlphaZeroState) -> Guided:
        """What the search asks."""
        return Guided(PolicyValue(state.network))

    def update(
        self, state: AlphaZeroState, batch: Batch, key: PRNGKey
    ) -> tuple[AlphaZeroState, dict[str, Array], tuple[()]]:
        del key
        t, now = batch.transitions, self.at(state.updates)
        weights = batch.weights * t.extras[PLAYED]
        weights = weights / jnp.maximum(weights.sum(), 1.0)

        def loss(network: ActorCritic) -> tuple[Array, tuple[Array, Array]]:
            logits, values = jax.vmap(PolicyValue(network))(t.observation)
            visits = t.extras[VISITS]
            # Moves that are not allowed have no visits and hugely negative logits.
            cross_entropy = -jnp.where(visits > 0, visits * jax.nn.log_softmax(logits), 0.0).sum(-1)
            policy_loss = (weights * cross_entropy).sum()
            value_loss = (weights * jnp.square(values - t.extras[OUTCOME])).sum()
            return policy_loss + now.value_cost * value_loss, (policy_loss, value_loss)

        (_, (policy_loss, value_loss)), gradient = jax.value_and_grad(loss, has_aux=True)(state.network)
        network, optimiser = now._optimiser().step(state.network, gradient, state.optimiser)
        metrics = {"policy_loss": policy_loss, "value_loss": value_loss, "grad_norm": global_norm(gradient)}
        return AlphaZeroState(network, optimiser, state.updates + 1), metrics, ()

    def _optimiser(self) -> Optimiser:
        return Optimiser(self.learning_rate, self.max_grad_norm)


class SelfPlayState(eqx.Module):
    """The learner and the positions of the last games."""

    learner: AlphaZeroState
    replay: ReplayState


class SelfPlay(Algorithm, Configured):
    """Each iteration plays a game in each of B places, `model` against itself, and learns from `updates` batches of all positions so far.

    `env` says what the network will play against when it is evaluated, how many games there are side by side, and nothing else. A step
    is a move. Raises `ValueError` for a model that cannot be started, and for a learner other than `AlphaZero`.
    """

    env: VectorEnv
    learner: Learner
    model: Choices
    replay: Replay = part(UniformReplay(20_000), "the memory of positions")
    simulations: int = setting(50, "simulations for each move", at_least=1)
    max_plies: int = setting(42, "moves after which a game is cut, as it stands", at_least=1)
    opening: int = setting(
        6, "first moves, which are drawn by their visits; the others are the most visited ones", at_least=0
    )
    noise: Number = number(0.25, "share of Dirichlet noise in the root's prior", at_least=0, at_most=1)
    concentration: Number = number(1.0, "alpha of the noise; about 10 over the number of moves", above=0)
    discount: Number = number(1.0, "gamma of outcomes and of the search", at_least=0, at_most=1)
    updates: int = setting(16, "batches learnt from in each iteration", at_least=1)
    batch_size: int = setting(128, "positions in a batch", at_least=1)

    def __check_init__(self) -> None:
        if not isinstance(self.model, Game):
            raise ValueError(
                f"self-play needs a game that it can start, and {type(self.model).__name__} is none: use TicTacToe"
            )
        if not isinstance(self.learner, AlphaZero):
            raise ValueError(
                f"self-play teaches AlphaZero, and {type(self.learner).__name__} learns from something else"
            )
        if self.spec.action.counts != (self.model.num_actions,):
            raise ValueError(
                f"the game has {self.model.num_actions} moves and the environment {self.spec.action.counts} actions: "
                "give the environment of this game"
            )

    @staticmethod
    def default_num_envs() -> int:
        """Games side by side where nobody says how many."""
        return 32

    @property
    def spec(self) -> EnvSpec:
        return env_spec(self.env)

    @property
    def steps_per_iteration(self) -> int:
        return self.max_plies * self.env.num_envs

    @property
    def initial_steps(self) -> int:
        return 0

    def with_horizon(self, iterations: int) -> "SelfPlay":
        horizon = iterations * self.updates
        learner, replay = fix_horizon(self.learner, horizon), fix_horizon(self.replay, horizon)
        return dataclasses.replace(self, learner=learner, replay=replay)

    def search(self, learner: AlphaZeroState) -> TreeSearch:
        """The player: PUCT with the network as it is."""
        rule = PUCT(noise=self.noise, concentration=self.concentration)
        guide = self._learner.guide(learner)
        return TreeSearch(
            simulations=self.simulations, rule=rule, guide=guide, discount=self.discount, bounds=(-1.0, 1.0)
        )

    def init(self, key: PRNGKey) -> SelfPlayState:
        learner = self._learner.init(self.spec, key)
        example = jax.eval_shape(lambda l, k: self.play(l, k)[0], learner, key)
        return SelfPlayState(learner, self.replay.init(example, self.max_plies))

    def step(self, state: SelfPlayState, key: PRNGKey) -> tuple[SelfPlayState, tuple[dict[str, Array], Episodes]]:
        play_key, learn_key = jax.random.split(key)
        games, episodes = self.play(state.learner, play_key)
        replay = self.replay.add(state.replay, games)

        def update(learner: State, keys: Array) -> tuple[State, dict[str, Array]]:
            batch = self.replay.sample(replay, keys[0], self.batch_size)
            learner, metrics, _ = self._learner.update(learner, batch, keys[1])
            return learner, metrics

        learner, metrics = jax.lax.scan(update, state.learner, jax.random.split(learn_key, (self.updates, 2)))
        return SelfPlayState(learner, replay), (jax.tree.map(jnp.mean, metrics), episodes)

    def play(self, learner: AlphaZeroState, key: PRNGKey) -> tuple[Transition, Episodes]:
        """B games `[max_plies, B]`, each position with what the search made of it; returns are the first player's."""
        start_key, loop_key = jax.random.split(key)
        search, game, number = self.search(learner), self._game, self.env.num_envs
        positions = jax.vmap(game.start)(jax.random.split(start_key, number))

        def ply(positions: State, now: tuple[Array, Array]) -> tuple[State, Transition]:
            moves = jax.vmap(lambda s, k: self._move(search, s, now[0], k))
            return moves(positions, now[1])

        keys = jax.random.split(loop_key, (self.max_plies, number))
        _, games = jax.lax.scan(ply, positions, (jnp.arange(self.max_plies), keys))

        def back(later: Array, reward: Array) -> tuple[Array, Array]:
            now = reward + self.discount * later
            return now, now

        _, returns = jax.lax.scan(back, jnp.zeros(number), games.reward, reverse=True)
        outcome = games.extras[OUTCOME] * returns
        lengths = games.extras[PLAYED].sum()
        episodes = Episodes(games.reward.sum(), lengths, jnp.asarray(number, jnp.float32))
        return dataclasses.replace(games, extras={**games.extras, OUTCOME: outcome}), episodes

    def _move(self, search: TreeSearch, state: State, ply: Array, key: PRNGKey) -> tuple[State, Transition]:
        """One move of one game, which stands still after its end. `OUTCOME` is, for now, the side that is to move."""
        game, (search_key, draw_key, move_key) = self._game, jax.random.split(key, 3)
        found = mcts(game, state, search_key, search).value
        drawn = jax.random.categorical(draw_key, jnp.log(found.probabilities)).astype(jnp.int32)
        action = jnp.where(ply < self.opening, drawn, found.action)
        over = is_over(game, state)
        after = game.transition(state, action, move_key)
        reward = jnp.where(over, 0.0, game.reward(state, action, after))
        after = jax.tree.map(lambda old, new: jnp.where(over, old, new), state, after)
        ended = ~over & is_over(game, after)
        cut = ~is_over(game, after) & (ply == self.max_plies - 1)
        seen = game.observe(state)
        extras = {VISITS: found.probabilities, OUTCOME: sign(game, state), PLAYED: (~over).astype(jnp.float32)}
        return after, Transition(seen, action, reward, ended, cut, game.observe(after), extras)

    @property
    def _learner(self) -> AlphaZero:
        if not isinstance(self.learner, AlphaZero):
            raise ValueError("self-play teaches AlphaZero")
        return self.learner

    @property
    def _game(self) -> Game:
        if not isinstance(self.model, Game):
            raise ValueError("self-play needs a game")
        return self.model

    def learned(self, state: SelfPlayState) -> State:
        return state.learner

    def policy(self, state: SelfPlayState, explore: bool = False) -> ActorCriticPolicy:
        return self._learner.policy(state.learner, explore)
