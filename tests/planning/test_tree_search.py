"""Monte Carlo tree search against enumeration, exact values and hand numbers (items 8.18 to 8.24)."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_games import ROOT, Endless, TreeGame, optimal_values, random_tree, stack

from rewardtogo.envs.board_games import TicTacToe
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.known import KnownModel
from rewardtogo.envs.opponents import PerfectOpponent, Versus
from rewardtogo.envs.tabular import TabularModel
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.exact import v_values
from rewardtogo.loops import begin, collect
from rewardtogo.planning.guides import Guided, Rollouts, pick
from rewardtogo.planning.tree_policies import PUCT, UCT, Edges
from rewardtogo.planning.tree_search import Numbered, SearchPolicy, TreeSearch, mcts

KEY = jax.random.key(0)


@jax.jit
def many(games: Any, keys: Any, search: TreeSearch) -> Any:
    return jax.vmap(lambda g, k: mcts(g, ROOT, k, search).value)(games, keys)


def decisions(games: list[TreeGame], search: TreeSearch) -> Any:
    """A search in each of the trees, all in one compiled program."""
    return jax.device_get(many(stack(games), jax.random.split(KEY, len(games)), search))


@pytest.mark.parametrize("players", [1, 2])
def test_it_finds_the_best_action_of_known_trees(players, item):
    games = [random_tree(seed, players=players) for seed in range(200)]
    search = TreeSearch(simulations=500, rule=UCT(0.2), guide=Rollouts(horizon=3), max_depth=3, choose="max")
    found = decisions(games, search)
    best = np.array([optimal_values(game).argmax() for game in games])
    with item("8.18") as check:
        what = f"optimal actions in 200 random trees of depth 3, {players} player(s), 500 simulations"
        check((found.action == best).mean(), ">=", 0.95, what)


def position(moves: str) -> Any:
    game, state = TicTacToe(), TicTacToe().start(KEY)
    for move in moves:
        state = game.transition(state, jnp.asarray(int(move)), KEY)
    return state


def test_tic_tac_toe_comes_to_its_minimax_value(item):
    """The squares are 012/345/678, and the moves of both sides in turn: draws and forced wins."""
    positions, table = ["04", "0182", "0184", "01", "4805"], {}

    def value(mine: int, theirs: int) -> int:
        lines = [7, 56, 448, 73, 146, 292, 273, 84]
        if any(theirs & line == line for line in lines):
            return -1
        moves = [i for i in range(9) if not (mine | theirs) >> i & 1]
        if (mine, theirs) not in table:
            table[mine, theirs] = max((-value(theirs, mine | 1 << i) for i in moves), default=0)
        return table[mine, theirs]

    states = [position(moves) for moves in positions]
    exact = [value(int(s.mine), int(s.theirs)) for s in states]
    assert {0, 1} <= set(exact)
    roots = jax.tree.map(lambda *x: jnp.stack(x), *states)
    search = TreeSearch(simulations=3000, rule=UCT(0.1), guide=Rollouts(horizon=9), max_depth=9, bounds=(-1.0, 1.0))
    game = TicTacToe()
    each = jax.jit(jax.vmap(lambda r, k: mcts(game, r, k, search).value))
    found = jax.device_get(each(roots, jax.random.split(KEY, len(states))))
    chosen = np.take_along_axis(found.q_values, found.action[:, None], 1)[:, 0]
    with item("8.18") as check:
        check(np.abs(chosen - exact).max(), "<=", 0.1, "value of the chosen move against minimax, tic-tac-toe")


@pytest.mark.slow
def test_it_never_loses_tic_tac_toe(item):
    """200 games against a player who makes no mistake; half of them begun by it."""
    env = vectorize(Versus(TicTacToe(), PerfectOpponent()), 200)
    search = TreeSearch(simulations=2000, rule=UCT(0.3), guide=Rollouts(horizon=9), max_depth=9, bounds=(-1.0, 1.0))
    policy = SearchPolicy(TicTacToe(), search)

    def play(key: Any) -> Any:
        _, rollout, _ = collect(env, policy, begin(env, policy, key), key, 5)
        t = rollout.transitions
        first = jnp.cumsum(t.terminated, 0) - t.terminated == 0  # the first episode of each lane
        return t.reward.min(where=first, initial=1.0), (t.terminated & first).sum()

    worst, games = jax.jit(play, compiler_options={"xla_backend_optimization_level": 3})(KEY)
    assert games == 200
    with item("8.18") as check:
        check(worst, ">=", 0, "least result in 200 games against a perfect player, 2,000 simulations a move")


def test_the_simulator_is_as_it_was(item):
    env = CartPole()
    state, _ = env.reset(KEY)
    model = Numbered(KnownModel(env), 2)
    before = np.asarray(state).tobytes()
    simulation = model.model.at(state)
    tree = mcts(model, simulation, KEY, TreeSearch(simulations=16, guide=Rollouts(horizon=20))).value.tree
    changed = sum(a != b for a, b in zip(before, np.asarray(simulation.state).tobytes(), strict=True))
    # Going on from any node of the tree is rolling back to it.
    gaps = []
    for node in range(int(tree.size)):
        for action in range(2):
            child = int(tree.children[node, action, 0])
            if child >= 0:
                there = jax.tree.map(lambda x: x[node], tree.states)  # noqa: B023
                after = jax.jit(model.transition)(there, jnp.asarray(action), KEY)
                gaps.append(np.abs(np.asarray(after.state) - np.asarray(tree.states.state[child])).max())
    assert len(gaps) == 16
    with item("8.19") as check:
        check(changed, "==", 0, "bytes of the simulator's state that a search changed")
        check(max(gaps), "<=", 1e-6, "a step from a node that was kept, against its child")


@pytest.mark.parametrize("given", [False, True])
def test_the_default_policy_estimates_its_own_value(given, item):
    mdp = random_mdp(0, 5, 3, discount=0.8, num_terminal=1)
    model = Numbered(TabularModel(mdp), 3)
    policy = (lambda state, legal, key: (state % 3).astype(jnp.int32)) if given else None
    table = np.eye(3)[np.arange(5) % 3] if given else np.full((5, 3), 1 / 3)
    exact = v_values(mdp, table)
    guide, n = Rollouts(policy, horizon=60), 4000
    states = np.flatnonzero(~np.asarray(mdp.terminal))
    run = jax.jit(jax.vmap(lambda s, k: guide.play(model, s, 0.8, k)[0], in_axes=(None, 0)))
    worst = 0.0
    for state in states:
        returns = np.float64(run(jnp.asarray(state, jnp.int32), jax.random.split(jax.random.key(state), n)))
        worst = max(worst, abs(returns.mean() - exact[state]) / (returns.std() / math.sqrt(n)))
    with item("8.20") as check:
        check(worst, "<=", 4, f"distance from V of the {'given' if given else 'random'} policy in standard errors")


def test_one_node_a_simulation(item):
    solution = mcts(Endless(), jnp.zeros((), jnp.int32), KEY, TreeSearch(simulations=50, guide=Rollouts(horizon=2)))
    tree = solution.value.tree
    rows = {leaf.shape[0] for leaf in jax.tree.leaves((tree.states, tree.children, tree.counts, tree.prior))}
    with item("8.21") as check:
        check(solution.stats["nodes"], "==", 51, "nodes after 50 simulations")
        check(max(rows), "==", 51, "rows of memory")
    assert solution.stats["cut"] == 51  # a game that never ends: every rollout was cut
    assert int((tree.children >= 0).sum()) == 50


def test_chance_comes_to_expectimax(item):
    """Random trees of depth 3, two actions, two outcomes: the error of the best action's value falls like n^(-1/2)."""
    games = [random_tree(seed, actions=2, outcomes=2) for seed in range(64)]
    exact = np.array([optimal_values(game) for game in games])
    errors, budgets = [], (100, 1600)
    for n in budgets:
        search = TreeSearch(
            simulations=n,
            rule=UCT(0.1),
            guide=Rollouts(horizon=3),
            max_depth=3,
            outcomes=2,
            bounds=(0.0, 3.0),
            choose="max",
        )
        found = decisions(games, search)
        value = np.nanmax(found.q_values, -1)
        errors.append(np.sqrt(np.mean((value - exact.max(-1)) ** 2)))
        regret = exact.max(-1) - np.take_along_axis(exact, found.action[:, None], 1)[:, 0]
    slope = np.polyfit(np.log(budgets), np.log(errors), 1)[0]
    with item("8.22") as check:
        check(slope, "<=", -0.4, "slope of log error in log n, n = 100 and 1600, 64 trees")
        check(errors[-1], "<=", 0.05, "error of the value at n = 1600, returns in [0, 3]")
        check(regret.mean(), "<=", 0.01, "mean regret of the choice at n = 1600")  # type: ignore[possibly-undefined]


def test_an_outcome_beyond_the_width_goes_to_a_known_one():
    """Three outcomes, room for two: no more than two children, and the search goes on."""
    game = random_tree(0, depth=2, actions=2, outcomes=3)
    search = TreeSearch(simulations=64, guide=Rollouts(horizon=2), max_depth=2, outcomes=2)
    tree = mcts(game, ROOT, KEY, search).value.tree
    assert tree.children.shape == (65, 2, 2)
    assert float(tree.counts[0].sum()) == 64
    assert int(tree.size) <= 1 + 4 + 4 * 4


# --- the traversal rule --------------------------------------------------------------------------------------------------


def edges(mean: Any, counts: Any, prior: Any = None, visits: float | None = None) -> Edges:
    mean, counts = jnp.asarray(mean, jnp.float32), jnp.asarray(counts, jnp.float32)
    prior = jnp.full(mean.shape, 1 / len(mean)) if prior is None else jnp.asarray(prior, jnp.float32)
    return Edges(mean, counts, prior, jnp.asarray(counts.sum() if visits is None else visits, jnp.float32))


def test_the_uct_score_by_hand(item):
    score = np.asarray(UCT()(edges([0.5, 0.25, 0.0], [4, 16, 0])))
    # 2 C sqrt(2 ln 20 / n), C = 1/sqrt(2): 2 sqrt(ln 20 / 4) and 2 sqrt(ln 20 / 16).
    by_hand = [0.5 + 2 * math.sqrt(math.log(20) / 4), 0.25 + 2 * math.sqrt(math.log(20) / 16)]
    greedy = np.asarray(UCT(exploration=0.0)(edges([0.5, 0.25, 0.75], [4, 16, 1])))
    as_printed = 0.5 + 2 * 0.5**0.5 * math.sqrt(2 * math.log(20)) / 4  # the root over the numerator only
    with item("8.23") as check:
        check(np.abs(score[:2] - by_hand).max(), "<=", 1e-6, "Q/N + 2 C sqrt(2 ln N / n)")
        check(score[2], "==", np.inf, "score of what was never tried")
        check(np.abs(greedy - [0.5, 0.25, 0.75]).max(), "==", 0, "C = 0 is greedy")
        check(abs(as_printed - by_hand[0]), ">", 0.1, "the square root over the numerator only is another number")


def test_poor_arms_are_tried_logarithmically_often(item):
    """UCB1 is the case of one step and 2 C = 1: an arm that is worse by D is tried at most 8 ln n / D^2 + 1 + pi^2 / 3 times."""
    rewards = jnp.asarray([[[[1.0, 0.0], [0.0, 1.0]]]])  # two arms, each pays with another outcome
    rewards = jnp.broadcast_to(rewards, (1, 4, 2, 2))
    game, n = TreeGame(rewards, jnp.asarray([0.8, 0.2])), 1000
    search = TreeSearch(
        simulations=n, rule=UCT(exploration=0.5), guide=Rollouts(horizon=1), max_depth=1, outcomes=2, bounds=(0.0, 1.0)
    )
    found = decisions([game] * 32, search)
    with item("8.23") as check:
        bound = 8 * math.log(n) / 0.6**2 + 1 + math.pi**2 / 3
        check(found.visits[:, 1].mean(), "<=", bound, "visits of the worse of two arms in 1,000, mean of 32")
        check((found.action == 0).mean(), "==", 1, "choices of the better arm")


def test_each_action_is_tried_once_first(item):
    game = random_tree(0, actions=5)
    found = decisions([game] * 16, TreeSearch(simulations=5, guide=Rollouts(horizon=3)))
    with item("8.24") as check:
        check(np.abs(found.visits - 1).max(), "==", 0, "visits after as many simulations as actions, less one")
    orders = {tuple(np.asarray(tree)) for tree in np.argsort(found.tree.children[:, 0, :, 0], -1)}
    assert len(orders) > 4  # and in an order by lot


def test_puct_by_hand():
    rule = PUCT(base=1.5, growth=100.0)
    score = np.asarray(rule(edges([0.6, 0.2, 0.0], [3, 1, 0], [0.2, 0.3, 0.5], visits=5)))
    weight = 1.5 + math.log(106 / 100)
    by_hand = [
        0.6 + weight * 0.2 * math.sqrt(5) / 4,
        0.2 + weight * 0.3 * math.sqrt(5) / 2,
        0.5 + weight * 0.5 * math.sqrt(5),  # never tried: the mean of the others, (3 * 0.6 + 0.2) / 4
    ]
    np.testing.assert_allclose(score, by_hand, rtol=1e-6)


def test_noise_at_the_root_keeps_to_what_is_allowed():
    legal = jnp.asarray([True, False, True, True])
    prior = jnp.asarray([0.5, 0.0, 0.25, 0.25])
    noisy = jax.vmap(lambda k: PUCT(noise=0.25).root_prior(prior, legal, k))(jax.random.split(KEY, 2000))
    np.testing.assert_allclose(noisy.sum(-1), 1.0, atol=1e-5)
    assert float(jnp.abs(noisy[:, 1]).max()) == 0
    np.testing.assert_allclose(noisy.mean(0), [0.375 + 1 / 12, 0, 0.1875 + 1 / 12, 0.1875 + 1 / 12], atol=0.01)


def test_a_network_guides_the_search():
    """A guide that knows the answer: its value is taken as it is, from the side of who is to move, and its prior comes first."""
    game = random_tree(3, players=2)
    know = Guided(lambda state: (jnp.asarray([0.0, 3.0, 0.0]), jnp.where(state[0] == 1, -0.5, 0.25)))
    first = mcts(game, ROOT, KEY, TreeSearch(simulations=1, rule=PUCT(), guide=know, bounds=(-1.0, 4.0))).value
    assert int(first.action) == 1
    # One simulation: the reward and what the second player thinks of where it leads, with the other sign.
    np.testing.assert_allclose(first.q_values[1], game.rewards[0, 0, 1, 0] + 0.5, rtol=1e-6)


def test_discount_along_the_path():
    """With gamma 0 only the first reward counts; with 0.5 the search comes to the discounted optimum."""
    game = random_tree(5)
    for gamma in (0.0, 0.5):
        search = TreeSearch(
            simulations=1500, rule=UCT(exploration=0.2), guide=Rollouts(horizon=3), discount=gamma, bounds=(0.0, 3.0)
        )
        found = decisions([game, game], search)
        exact = optimal_values(game, gamma)
        assert (found.action == exact.argmax()).all()
        np.testing.assert_allclose(np.nanmax(found.q_values, -1), exact.max(), atol=1e-5 if gamma == 0 else 0.03)


def test_many_roots_are_the_same_as_one_at_a_time():
    game, keys = random_tree(1, outcomes=2, actions=2), jax.random.split(KEY, 3)
    search = TreeSearch(simulations=40, guide=Rollouts(horizon=3), outcomes=2)
    together = jax.device_get(jax.jit(jax.vmap(lambda k: mcts(game, ROOT, k, search)))(keys))
    for i in range(3):
        alone = jax.device_get(mcts(game, ROOT, keys[i], search))
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-6)


def test_robust_and_max_child(item):
    """Few simulations disagree sooner or later; each choice is what its name says."""
    games = [random_tree(seed) for seed in range(64)]
    settings = {"simulations": 30, "rule": UCT(0.2), "guide": Rollouts(horizon=3)}
    robust = decisions(games, TreeSearch(choose="robust", **settings))
    best = decisions(games, TreeSearch(choose="max", **settings))
    rows = np.arange(64)
    with item("8.25") as check:
        check((robust.visits[rows, robust.action] == robust.visits.max(-1)).mean(), "==", 1, "robust: most visits")
        check((best.q_values[rows, best.action] == np.nanmax(best.q_values, -1)).mean(), "==", 1, "max: best mean")
        check((best.action != robust.action).sum(), ">", 0, "the two differ in some of 64 trees at 30 simulations")


def test_illegal_moves_are_never_tried():
    state = position("048")
    found = mcts(TicTacToe(), state, KEY, TreeSearch(simulations=100, guide=Rollouts(horizon=9))).value
    assert (np.asarray(found.visits)[[0, 4, 8]] == 0).all()
    assert np.isnan(np.asarray(found.q_values)[[0, 4, 8]]).all()
    luck = jnp.linspace(0.0, 0.999, 50)
    legal = jnp.asarray([False, True, False, True, True])
    picked = jax.vmap(lambda u: pick(legal, u))(luck)
    assert set(np.asarray(picked).tolist()) == {1, 3, 4}


# --- what cannot be ------------------------------------------------------------------------------------------------------


def test_a_new_number_compiles_nothing():
    """C, gamma and the bounds are traced, and so is every array of a guide."""
    games = [random_tree(0)]
    settings = {"simulations": 10, "guide": Rollouts(horizon=3)}
    decisions(games, TreeSearch(rule=UCT(0.5), discount=0.9, bounds=(0.0, 3.0), **settings))
    compiled = many._cache_size()
    decisions(games, TreeSearch(rule=UCT(0.1), discount=0.8, bounds=(-1.0, 4.0), **settings))
    assert many._cache_size() == compiled


def test_bad_input_is_one_sentence():
    model, state = TicTacToe(), position("")
    with pytest.raises(ValueError, match=r"simulations must be in \[1, inf\), not 0"):
        TreeSearch(simulations=0)
    with pytest.raises(ValueError, match="a game may never end: give a horizon"):
        Rollouts(horizon=0)
    with pytest.raises(ValueError, match="give it as Numbered"):
        mcts(KnownModel(CartPole()), state, KEY)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="game is over"):
        mcts(model, position("03142"), KEY)
    with pytest.raises(ValueError, match="no action is allowed"):
        mcts(Endless(allowed=False), jnp.zeros((), jnp.int32), KEY)
    with pytest.raises(ValueError, match="a lower and an upper bound"):
        TreeSearch(bounds=(1.0, -1.0))
    with pytest.raises(ValueError, match="at least one action"):
        Numbered(KnownModel(CartPole()), 0)
    with pytest.raises(ValueError, match="exploration must be in"):
        UCT(exploration=-1.0)
