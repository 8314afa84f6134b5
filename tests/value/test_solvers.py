"""Dynamic programming against brute force and against itself: policy, value, modified, Gauss-Seidel and asynchronous iteration."""

import itertools
import math
from typing import Any

import numpy as np
import pytest

from rewardtogo.envs.sparse import SparseMDP, sparse_of
from rewardtogo.envs.tabular import MDP
from rewardtogo.envs.tabular_problems import pacman, random_mdp, random_policy
from rewardtogo.envs.toy_text import gymnasium_table, table_mdp
from rewardtogo.exact import expected_return, optimal_policy, optimal_q_values, v_values
from rewardtogo.value.dynamic_programming import (
    backward_induction,
    gauss_seidel,
    modified_policy_iteration,
    policy_evaluation,
    policy_iteration,
    value_iteration,
)
from rewardtogo.value.gpi import generalised_policy_iteration
from rewardtogo.value.operators import (
    bellman_backup,
    deterministic_backup,
    evaluation_backup,
    greedy_actions,
    q_backup,
)
from rewardtogo.value.sweeping import prioritised_sweeping

SOLVERS: dict[str, Any] = {
    "value_iteration": value_iteration,
    "by the norm": lambda m, **k: value_iteration(m, stop="norm", **k),
    "modified": modified_policy_iteration,
    "modified, by the norm": lambda m, **k: modified_policy_iteration(m, stop="norm", **k),
    "gauss_seidel": gauss_seidel,
    "gauss_seidel, blocks of 4": lambda m, **k: gauss_seidel(m, block=4, **k),
    "prioritised_sweeping": prioritised_sweeping,
}
S, A = 6, 3
"""One shape for most problems, so that little is compiled."""


def problems() -> list[tuple[str, MDP | SparseMDP]]:
    """With and without an end, in matrices and in lists."""
    plain = random_mdp(0, S, A, discount=0.95, concentration=0.3)
    ending = random_mdp(1, S, A, discount=0.95, num_terminal=2)
    undiscounted = random_mdp(2, S, A, discount=1.0, num_terminal=1)
    undiscounted = MDP(
        undiscounted.transitions, -np.abs(undiscounted.rewards), undiscounted.initial, 1.0, undiscounted.terminal
    )
    dense = [("plain", plain), ("ending", ending), ("undiscounted", undiscounted)]
    return [*dense, *((f"{name}, lists", sparse_of(m)) for name, m in dense)]


def pi_star(problem: MDP | SparseMDP) -> np.ndarray:
    dense = problem.to_dense() if isinstance(problem, SparseMDP) else problem
    return optimal_q_values(dense).max(-1)[: problem.num_states]


@pytest.mark.parametrize("name", SOLVERS)
def test_all_find_the_same_fixed_point(name, item):
    worst = bound = 0.0
    for _, problem in problems():
        found = SOLVERS[name](problem, tolerance=1e-12)
        error = np.abs(found.value.values - pi_star(problem)).max()
        worst = max(worst, error)
        assert found.converged and np.all(found.value.q_values.max(-1) == found.value.values)
        if problem.discount < 1:
            bound = max(bound, error - float(found.stats["error_bound"]))
    with item("5.7" if name in ("value_iteration", "by the norm") else "5.8") as check:
        check(worst, "<=", 1e-10, f"{name}: V against exact policy iteration, 6 problems, dense and sparse")
        check(bound, "<=", 1e-12, f"{name}: error beyond the bound that the solution gives")


def test_policy_iteration_is_brute_force(item):
    worst = most = 0.0
    for seed in range(200):
        states, actions = 2 + seed % 2, 2 + seed % 3 // 2
        mdp = random_mdp(seed, states, actions, discount=0.9, num_terminal=seed % 2)
        found = policy_iteration(mdp)
        every = itertools.product(range(actions), repeat=states)
        best = np.max([v_values(mdp, np.eye(actions)[list(choice)]) for choice in every], axis=0)
        worst = max(worst, np.abs(found.value.values - best).max())
        most = max(most, float(found.stats["sweeps"]) / actions**states)
        assert np.all(np.diff(found.stats["path"], axis=0) >= -1e-12)
    with item("5.6") as check:
        check(worst, "<=", 1e-12, "values against the best of all policies in every state, 200 MDPs")
        check(most, "<=", 1, "E5.2: rounds over |A|^|S|")


def test_toy_environments(item):
    lake = table_mdp(gymnasium_table("FrozenLake-v1"))
    exact = 14 / 17
    found = policy_iteration(lake)
    with item("5.6") as check:
        check(
            abs(lake.initial @ found.value.values - exact),
            "<=",
            1e-12,
            "FrozenLake: probability of success, .82353 = 14/17",
        )
        limited = float(backward_induction(lake, 100).value.values @ lake.initial)
        check(abs(limited - 0.7441902878), "<=", 1e-9, "the same in at most 100 steps")
        policy = np.eye(4)[found.value.actions]
        check(
            expected_return(lake.to_dense(), policy, 100),
            "<=",
            limited + 1e-12,
            "the undiscounted policy within 100 steps",
        )
        cliff, taxi = (table_mdp(gymnasium_table(name)) for name in ("CliffWalking-v1", "Taxi-v4"))
        check(cliff.initial @ policy_iteration(cliff).value.values, "==", -13, "CliffWalking")
        check(abs(taxi.initial @ policy_iteration(taxi).value.values - 7.93), "<=", 1e-12, "Taxi, mean over 300 starts")
    with item("5.7") as check:
        swept = value_iteration(lake, tolerance=1e-13)
        check(
            abs(lake.initial @ swept.value.values - exact), "<=", 1e-10, "FrozenLake by value iteration, undiscounted"
        )


def test_evaluation_by_sweeps_and_by_solving(item):
    errors, over = [], []
    for _, problem in problems():
        policy = random_policy(3, S, A)
        solved = policy_evaluation(problem, policy).value.values
        swept = policy_evaluation(problem, policy, method="sweeps", tolerance=1e-13)
        errors.append(np.abs(swept.value.values - solved).max())
        start = np.random.default_rng(4).normal(size=S) * ~problem.terminal
        value, gap, gamma = start, np.abs(start - solved).max(), float(problem.discount)
        for k in range(1, 30):
            value = evaluation_backup(problem, policy, value)
            over.append(np.abs(value - solved).max() - gamma**k * gap)
    with item("5.4") as check:
        check(max(errors), "<=", 1e-10, "sweeps against the linear solve, 6 problems")
        check(max(over), "<=", 1e-12, "error after k sweeps beyond γ^k times the first")


def test_the_backup_of_a_deterministic_policy(item):
    different = 0
    for seed, (_, problem) in enumerate(problems()):
        rng = np.random.default_rng(seed)
        actions, value = rng.integers(0, A, S), rng.normal(size=S)
        short = deterministic_backup(problem, actions, value)
        different += int((short != evaluation_backup(problem, np.eye(A)[actions], value)).sum())
        assert np.allclose(
            policy_evaluation(problem, np.eye(A)[actions]).value.values if problem.discount < 1 else 0,
            policy_evaluation(problem, actions).value.values if problem.discount < 1 else 0,
        )
    with item("5.5") as check:
        check(different, "==", 0, "entries that are not the same bits as with a one-hot policy")


def test_value_iteration_stops_when_its_policy_is_good_enough(item):
    with item("5.7") as check:
        for stop in ("norm", "bounds"):
            loss, fewest = 0.0, []
            for seed in range(20):
                mdp = random_mdp(seed, S, A, discount=0.97, concentration=0.3)
                best = optimal_q_values(mdp).max(-1)
                found = value_iteration(mdp, tolerance=0.01, stop=stop)
                policy = np.eye(A)[found.value.actions]
                loss = max(loss, (best - v_values(mdp, policy)).max())
                fewest.append(float(found.stats["sweeps"]))
                last = found.stats["residuals"][-2:]
                assert last[1] < 0.01 * 0.03 / (2 * 0.97) <= last[0]
            check(loss, "<=", 0.01, f"loss of the greedy policy at ε = 0.01, by {stop}, {np.mean(fewest):.0f} sweeps")


def test_gauss_seidel_needs_fewer_sweeps(item):
    with item("5.8") as check:
        for seed in range(5):
            mdp = random_mdp(seed, S, A, discount=0.95, concentration=0.3)
            jacobi = float(value_iteration(mdp, stop="norm", tolerance=1e-6).stats["sweeps"])
            in_place = float(gauss_seidel(mdp, tolerance=1e-6).stats["sweeps"])
            check(in_place, "<=", jacobi, f"sweeps of Gauss-Seidel, Jacobi's {jacobi:.0f}")
        maze = sparse_of(pacman(discount=0.95))
        whole, modified = value_iteration(maze, stop="norm"), modified_policy_iteration(maze, stop="norm")
        check(
            float(modified.stats["sweeps"]),
            "<=",
            float(whole.stats["sweeps"]),
            "improvements of modified policy iteration",
        )
        picky = prioritised_sweeping(maze)
        check(
            float(picky.stats["sweeps"]), "<", float(whole.stats["sweeps"]), "prioritised backups over states, a maze"
        )


def test_ties_and_policies_that_never_end():
    """With discount 1 and a goal that pays whenever it is reached, going in circles is greedy; the policy given goes there."""
    lake = table_mdp(gymnasium_table("FrozenLake-v1", is_slippery=False))
    dense = lake.to_dense()
    for found in (value_iteration(lake), policy_iteration(lake), gauss_seidel(lake)):
        assert expected_return(dense, np.eye(4)[found.value.actions]) == pytest.approx(1.0)
    assert set(found.value.q_values[0] == 1) == {True}
    mdp = random_mdp(0, 4, 3)
    q = optimal_q_values(mdp)
    np.testing.assert_array_equal(greedy_actions(mdp, q), optimal_policy(mdp).argmax(-1))


def test_general_policy_iteration(item):
    """Evaluate and improve as hooks: solving makes it Algorithm 6, one backup Algorithm 7; greedy improvement never loses."""
    fell, gaps, swept_gaps, first = [], [], [], []
    for seed in range(20):
        mdp = random_mdp(seed, S, A, discount=0.9)
        exact = policy_iteration(mdp).value.values

        def greedy(value: np.ndarray, mdp: MDP = mdp) -> np.ndarray:
            return np.eye(A)[greedy_actions(mdp, q_backup(mdp, value))]

        path = generalised_policy_iteration(
            lambda pi, _, mdp=mdp: v_values(mdp, pi), greedy, random_policy(seed, S, A), np.zeros(S)
        )
        fell.append(-np.diff(path.stats["values"], axis=0).min(initial=0.0))
        gaps.append(np.abs(path.value[1] - exact).max())
        swept = generalised_policy_iteration(
            lambda pi, v, mdp=mdp: evaluation_backup(mdp, pi, v),
            greedy,
            greedy(np.zeros(S)),
            np.zeros(S),
            until="values",
        )
        swept_gaps.append(np.abs(swept.value[1] - exact).max())
        value = np.zeros(S)
        for k in range(5):
            value = bellman_backup(mdp, value)
            first.append(np.abs(swept.stats["values"][k] - value).max())
    with item("5.3") as check:
        check(max(fell), "<=", 1e-12, "how far a value ever fell, 20 MDPs")
        check(max(gaps), "<=", 1e-12, "with solving for an evaluation: Algorithm 6")
        check(max(swept_gaps), "<=", 1e-9, "with one backup for an evaluation: V*")
        check(max(first), "==", 0, "with one backup: the values of Algorithm 7, sweep by sweep")


def test_the_curse_of_dimensionality(item):
    from rewardtogo.value.theory import table_and_network_sizes

    sizes = [table_and_network_sizes(d, 10, 4, (64, 64)) for d in range(1, 7)]
    growth = [b[0] / a[0] for a, b in itertools.pairwise(sizes)]
    with item("5.9") as check:
        check(max(abs(g - 10) for g in growth), "<=", 1e-12, "a table grows tenfold with every dimension of ten values")
        check(sizes[-1][0], "==", 4e6, "its entries in 6 dimensions, 4 actions")
        check(
            sizes[-1][1] - sizes[0][1], "==", 5 * 64, "parameters that a 64 x 64 network gains from 1 to 6 dimensions"
        )


@pytest.mark.slow
def test_a_million_states(item):
    """A torus of 1000 x 1000 squares with noise: four successors for each of four actions."""
    import time

    side = 1000
    row, column = np.divmod(np.arange(side**2), side)
    moves = np.stack(
        [((row + dr) % side) * side + (column + dc) % side for dr, dc in ((-1, 0), (0, 1), (1, 0), (0, -1))]
    )
    successors = np.broadcast_to(moves.T[:, None, :], (side**2, 4, 4))
    probabilities = np.broadcast_to(0.1 + 0.6 * np.eye(4)[None], successors.shape)
    rewards = np.repeat(np.random.default_rng(0).normal(size=(side**2, 1)), 4, 1)
    began = time.perf_counter()
    mdp = SparseMDP(successors, probabilities, rewards, discount=0.95)
    made = time.perf_counter()
    found = modified_policy_iteration(mdp, tolerance=1e-3)
    seconds = time.perf_counter() - made
    with item("5.8") as check:
        check(float(found.stats["error_bound"]), "<=", 1e-3, f"error of a million values, made in {made - began:.0f} s")
        check(seconds, "<=", 300, "seconds to solve a million states")


# --- bad input -------------------------------------------------------------------------------------------------------

SUCCESSORS = [[[0, 1], [1, 1]], [[1, 1], [0, 0]]]
HALVES = [[[0.5, 0.5], [0.5, 0.5]]] * 2
ONES = [[1.0, 1.0], [1.0, 1.0]]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SparseMDP(SUCCESSORS, [[[0.5, 0.4], [0.5, 0.5]]] * 2, ONES), "probabilities[0, 0, :] 0.9 sum to 1"),
        (
            lambda: SparseMDP(SUCCESSORS, [[[1.5, -0.5], [0.5, 0.5]]] * 2, ONES),
            "probabilities[0, 0, 1] -0.5 probability",
        ),
        (lambda: SparseMDP([[[0, 2], [1, 1]], [[1, 1], [0, 0]]], HALVES, ONES), "successors[0, 0, 1] is 2 from 0 to 1"),
        (lambda: SparseMDP([[0, 1]], HALVES, ONES), "successors (1, 2) [S, A, K]"),
        (lambda: SparseMDP(SUCCESSORS, HALVES, ONES, discount=1.0), "discount 1 state 0 terminal"),
        (lambda: SparseMDP(SUCCESSORS, HALVES, ONES, discount=1.1), "discount 1.1 [0, 1]"),
        (lambda: SparseMDP(SUCCESSORS, HALVES, [1.0, 2.0], discount=0.9), "rewards (2,) [2, 2]"),
        (lambda: SparseMDP(SUCCESSORS, HALVES, [[1.0, math.nan]] * 2, discount=0.9), "rewards finite"),
        (lambda: SparseMDP(SUCCESSORS, HALVES, ONES, 0, 0.9, terminal=[True, False]), "terminal state 0 start"),
        (lambda: SparseMDP(SUCCESSORS, HALVES, ONES, 0, 0.9, ends=[True]), "ends (1,) [2, 2, 2]"),
        (lambda: value_iteration(random_mdp(0, 3, 2, horizon=5)), "ends after 5 backward_induction"),
        (lambda: value_iteration(random_mdp(0, 3, 2), tolerance=0.0), "tolerance 0.0 1e-8"),
        (lambda: value_iteration(random_mdp(0, 3, 2), stop="span"), "'span' bounds norm"),
        (lambda: value_iteration(random_mdp(0, 3, 2), initial=np.zeros(2)), "(2,) 3 finite"),
        (lambda: gauss_seidel(random_mdp(0, 3, 2), block=4), "block of 4 1 to 3"),
        (lambda: modified_policy_iteration(random_mdp(0, 3, 2), evaluations=-1), "-1 0"),
        (lambda: policy_evaluation(random_mdp(0, 3, 2), np.ones((2, 2)) / 2), "(2, 2) [3, 2]"),
        (lambda: policy_evaluation(random_mdp(0, 3, 2), np.zeros(3, int), method="guess"), "'guess' solve sweeps"),
        (lambda: policy_iteration(sparse_of(problems()[2][1]), evaluation="sweeps"), "discount 1 solve"),
        (lambda: backward_induction(random_mdp(0, 3, 2)), "no horizon horizon=100"),
        (lambda: backward_induction(random_mdp(0, 3, 2), 0), "horizon is 0 at least 1"),
        (lambda: sparse_of(random_mdp(0, 3, 2, horizon=2)), "horizon of 2"),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(ValueError) as refused:
        make()
    assert all(word in str(refused.value) for word in words.split()), str(refused.value)


def test_matrices_that_do_not_fit_are_refused_and_sweeps_offered():
    states = 30_000
    around = (np.arange(states) + 1) % states
    mdp = SparseMDP(around[:, None, None], np.ones((states, 1, 1)), np.ones((states, 1)), discount=0.5)
    with pytest.raises(ValueError, match=r"30,000 states .* 7 GB: keep the lists"):
        policy_iteration(mdp)
    found = policy_iteration(mdp, evaluation="sweeps")
    assert found.converged and np.allclose(found.value.values, 2.0)


def test_lists_and_matrices_are_the_same_process():
    for _, problem in problems():
        if isinstance(problem, SparseMDP):
            dense, value = problem.to_dense(), np.random.default_rng(0).normal(size=S)
            np.testing.assert_allclose(q_backup(problem, value), q_backup(dense, value), rtol=0, atol=1e-14)
    # Outcomes that end where others go on: one more state, which is terminal.
    ends = np.zeros((2, 2, 2), bool)
    ends[0, 0, 1] = True
    mdp = SparseMDP(SUCCESSORS, HALVES, ONES, discount=0.9, ends=ends)
    dense = mdp.to_dense()
    assert dense.num_states == 3 and dense.terminal.tolist() == [False, False, True]
    np.testing.assert_allclose(policy_iteration(mdp).value.values, optimal_q_values(dense).max(-1)[:2], rtol=1e-12)
    np.testing.assert_allclose(value_iteration(mdp).value.values, optimal_q_values(dense).max(-1)[:2], atol=1e-8)
