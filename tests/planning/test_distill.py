"""Distillation of a search into a network (item 8.25), what it refuses, and the command."""

import dataclasses
import json
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.cli.main import main
from rewardtogo.core import MASK
from rewardtogo.data.noise import EXPERT
from rewardtogo.envs.board_games import ConnectFour, TicTacToe
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.known import KnownModel
from rewardtogo.envs.opponents import PerfectOpponent, RandomOpponent, Versus
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.loops import begin, collect
from rewardtogo.planning import AlphaZero, Distill, Numbered, SearchPolicy, SelfPlay
from rewardtogo.runner.plan import search_model

KEY = jax.random.key(0)
FAST = {"xla_backend_optimization_level": 3}


def played(env: Any, policy: Any, key: Any, steps: int) -> Any:
    """The first episode of each lane: returns, whether it ended."""
    _, rollout, _ = collect(env, policy, begin(env, policy, key), key, steps)
    t = rollout.transitions
    first = jnp.cumsum(t.done, 0) - t.done == 0
    return (t.reward * first).sum(0), (t.done & first).any(0)


def seconds(call: Any) -> float:
    """Of the fastest of a few calls, after one that compiles."""
    jax.block_until_ready(call())
    times = []
    for _ in range(5):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return min(times)


@pytest.mark.slow
def test_the_student_plays_like_the_search(item):
    """Connect Four on 5 x 5 against random moves: the student's return beside the search's, and what a decision takes."""
    game = ConnectFour(5, 5)
    env = rtg.vectorize(Versus(game, RandomOpponent()), 32)
    learner = rtg.BC(network=rtg.MLP(128, 128, activation="relu"))
    loop = Distill(env, learner, game, simulations=200, horizon=25, unroll=4, updates=32, batch_size=128)
    train = jax.jit(
        lambda s, k: jax.lax.scan(lambda s, k: loop.step(s, k), s, jax.random.split(k, 40))[0], compiler_options=FAST
    )
    state = jax.jit(loop.init)(KEY)
    for i in range(4):
        state = train(state, jax.random.fold_in(KEY, i))
    arena = rtg.vectorize(Versus(game, RandomOpponent()), 400)
    play = jax.jit(lambda policy, key: played(arena, policy, key, 13), compiler_options=FAST)
    scores = {}
    for name, policy in (("student", loop.policy(state)), ("search", loop.teacher())):
        returns, ended = jax.device_get(play(policy, jax.random.key(7)))
        assert ended.all()
        scores[name] = returns.mean()
    observation = jax.jit(lambda k: arena.reset(jax.random.split(k, 400))[1])(KEY)
    keys = jax.random.split(KEY, 400)
    decide = jax.jit(jax.vmap(lambda p, o, k: p((), o, k)[1], in_axes=(None, 0, 0)), compiler_options=FAST)
    student, search = (seconds(lambda p=p: decide(p, observation, keys)) for p in (loop.policy(state), loop.teacher()))
    with item("8.25") as check:
        check(scores["student"] / scores["search"], ">=", 0.9, "return of the student as a share of the search's")
        check(student / search, "<=", 0.01, "time of a decision of the student as a share of the search's, 400 at once")


def small_loop(**options: Any) -> Distill:
    env = rtg.vectorize(Versus(TicTacToe(), RandomOpponent()), 4)
    options = {"simulations": 60, "horizon": 9, "unroll": 2, "updates": 2, "batch_size": 8} | options
    return Distill(
        env, options.pop("learner", rtg.BC(network=rtg.MLP(8))), options.pop("model", TicTacToe()), **options
    )


def test_answers_are_those_of_the_search_and_allowed():
    loop = small_loop()
    state = jax.jit(loop.init)(KEY)
    after, (metrics, _) = jax.jit(loop.step)(state, KEY)
    stored = jax.device_get(after.replay.storage)
    filled = int(after.replay.filled)
    mask, answers = stored.observation[MASK][:filled], stored.extras[EXPERT][:filled]
    assert filled == 2
    assert np.take_along_axis(mask, answers[..., None], -1).all()
    assert 0 <= float(metrics["agreement"]) <= 1
    # A win in one move is what a search of 60 simulations finds.
    board = np.zeros((2, 3, 3), np.int8)
    board[0, 0, :2] = board[1, 1, :2] = 1
    observation = {"board": jnp.asarray(board), MASK: jnp.asarray(1 - board.sum(0).ravel(), jnp.int8)}
    _, action, _ = loop.teacher()((), observation, KEY)
    assert int(action) == 2
    thoughts = loop.teacher().inspect((), observation)
    assert float(thoughts["probabilities"].sum()) == pytest.approx(1)
    assert float(np.nanmax(thoughts["q_values"])) == pytest.approx(1)


def test_what_cannot_be_is_said():
    with pytest.raises(ValueError, match="answers for single states"):
        small_loop(learner=rtg.BC(network=rtg.GRU(4)))
    with pytest.raises(ValueError, match="the model has 7 actions and the environment 9"):
        small_loop(model=ConnectFour())
    with pytest.raises(ValueError, match=r"simulations must be in \[1, inf\), not 0"):
        small_loop(simulations=0)
    with pytest.raises(ValueError, match="looks ahead in a compiled model"):
        search_model(rtg.make("CartPole-v1", backend="gymnasium"), "mcts_distill")
    with pytest.raises(ValueError, match="does not tell its state"):
        search_model(rtg.make("Catch"), "mcts_distill")


def test_an_environment_is_its_own_model():
    model = search_model(rtg.make("CartPole-v1"))
    assert isinstance(model, Numbered)
    assert isinstance(model.model, KnownModel)
    assert model.num_actions == 2
    assert isinstance(search_model(rtg.make("TicTacToe")), TicTacToe)


def self_play(**options: Any) -> SelfPlay:
    env = rtg.vectorize(Versus(TicTacToe(), RandomOpponent()), 8)
    learner, model = options.pop("learner", AlphaZero(network=rtg.MLP(16))), options.pop("model", TicTacToe())
    return SelfPlay(env, learner, model, **{"simulations": 8, "max_plies": 9, "updates": 2, "batch_size": 16} | options)


def test_games_against_itself_teach_how_they_went_on():
    loop = self_play(discount=0.5)
    state = jax.jit(loop.init)(KEY)
    games, episodes = jax.device_get(jax.jit(loop.play)(state.learner, KEY))
    played, outcome = games.extras["played"], games.extras["outcome"]
    boards = games.observation["board"]
    assert (boards.sum((2, 3, 4)) == np.arange(9)[:, None])[played > 0].all()  # one stone more in every ply
    assert float(episodes.length_sum) == played.sum()
    np.testing.assert_allclose(games.extras["visits"][played > 0].sum(-1), 1, atol=1e-6)
    assert (games.extras["visits"] * (1 - games.observation[MASK]) == 0)[played > 0].all()
    for b in range(8):
        last = int(played[:, b].sum()) - 1
        gain = games.reward[last, b]  # the first player's; whoever moved last has won, or it is a draw
        for t in range(last + 1):
            side = 1 if t % 2 == 0 else -1
            assert outcome[t, b] == pytest.approx(side * gain * 0.5 ** (last - t))
    with pytest.raises(ValueError, match="teaches AlphaZero"):
        self_play(learner=rtg.BC(network=rtg.MLP(4)))
    with pytest.raises(ValueError, match="needs a game"):
        self_play(model=Numbered(KnownModel(CartPole()), 9))
    with pytest.raises(ValueError, match="has 7 moves"):
        self_play(model=ConnectFour())


@pytest.mark.slow
def test_alphazero_learns_tic_tac_toe(item):
    """After 200 rounds of 32 games the network with 50 simulations loses no more than 2 of 200 games against a perfect player."""
    game = TicTacToe()
    env = rtg.vectorize(Versus(game, RandomOpponent()), 32)
    loop = SelfPlay(env, AlphaZero(), game, simulations=32, max_plies=9, opening=4, updates=32)
    train = jax.jit(
        lambda s, k: jax.lax.scan(lambda s, k: loop.step(s, k), s, jax.random.split(k, 50))[0], compiler_options=FAST
    )
    state = jax.jit(loop.init)(KEY)
    for i in range(4):
        state = train(state, jax.random.fold_in(KEY, i))
    arena = rtg.vectorize(Versus(game, PerfectOpponent()), 200)
    quiet = dataclasses.replace(loop, noise=0.0, simulations=50)
    policy = SearchPolicy(game, quiet.search(state.learner))
    returns, ended = jax.device_get(jax.jit(lambda k: played(arena, policy, k, 5), compiler_options=FAST)(KEY))
    assert ended.all()
    with item("8.25") as check:
        check((returns < 0).mean(), "<=", 0.01, "games lost of 200 against a perfect player, AlphaZero, 50 simulations")


@pytest.mark.slow
def test_cartpole_with_the_true_model(item):
    """UCT balances the pole for 500 steps, whatever the start."""
    env = rtg.vectorize(TimeLimit(CartPole(), 500), 20)
    model = Numbered(KnownModel(CartPole()), 2)
    search = rtg.planning.TreeSearch(simulations=200, guide=rtg.planning.Rollouts(horizon=100))
    play = jax.jit(lambda key: played(env, SearchPolicy(model, search), key, 500), compiler_options=FAST)
    returns, ended = jax.device_get(play(KEY))
    assert ended.all()
    with item("8.18") as check:
        check(returns.min(), ">=", 500, "least return of 20 episodes in CartPole, UCT with 200 simulations")


def test_the_command(tmp_path, capsys):
    words = ["train", "mcts_distill", "TicTacToe", "--steps", "32", "--num-envs", "4", "--out", str(tmp_path / "run")]
    words += ["--loop.simulations", "10", "--loop.horizon", "9", "--loop.updates", "1", "--loop.unroll", "4"]
    words += ["--learner.network.sizes", "8", "--quiet", "--json"]
    assert main(words) == 0
    printed = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert -1 <= printed["return_mean"] <= 1
    policy = rtg.load(tmp_path / "run")
    board = np.zeros((2, 3, 3), np.int8)
    mask = np.zeros(9, np.int8)
    mask[4] = 1
    assert policy({"board": board, MASK: mask}) == 4
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["loop"]["simulations"] == 10
    resumed = rtg.resume(tmp_path / "run", steps=48, quiet=True)
    assert resumed.metrics["env_steps"][-1] == 48
