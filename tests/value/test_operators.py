"""Bellman operators: against loops, contractions, projections, and what projecting does to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.envs.sparse import sparse_of
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import expected_return, optimal_q_values, q_values, v_values
from rewardtogo.value.divergence import w_2w
from rewardtogo.value.dynamic_programming import policy_iteration
from rewardtogo.value.exploration import greedy_probabilities
from rewardtogo.value.operators import (
    bellman_backup,
    bellman_residual,
    contraction_ratio,
    evaluation_backup,
    projected_backup,
    projected_q_backup,
    projection,
    q_backup,
    stepwise,
    sup_norm,
    weighted_norm,
)
from rewardtogo.value.theory import sweeps_needed

S, A, GAMMA = 5, 3, 0.9


def by_loops(mdp, value):
    """B V, one number at a time."""
    return [
        max(
            mdp.rewards[s, a]
            + mdp.discount * sum(mdp.transitions[s, a, t] * value[t] * (not mdp.terminal[t]) for t in range(S))
            for a in range(A)
        )
        for s in range(S)
    ]


def printed_backup(mdp, value):
    """With T_{a,i,j} = p(s' = i | s = j, a), as the notes print it (erratum E5.8)."""
    return np.max([mdp.rewards[:, a] + mdp.discount * mdp.transitions[:, a].T @ value for a in range(A)], axis=0)


def test_the_optimality_operator(item):
    gap, printed, factor = 0.0, np.inf, 0.0
    for seed in range(20):
        mdp, value = random_mdp(seed, S, A, num_terminal=seed % 2), np.random.default_rng(seed).normal(size=S)
        for problem in (mdp, sparse_of(mdp)):
            gap = max(gap, np.abs(bellman_backup(problem, value) - by_loops(mdp, value)).max())
        printed = min(printed, np.abs(printed_backup(mdp, value) - by_loops(mdp, value)).max())
        if not seed % 2:
            other = np.ones(S)
            factor = max(factor, contraction_ratio(lambda v, m=mdp: printed_backup(m, v), value, value + other))
    # Where many states lead to one, the printed index gathers them all there.
    crowd = random_mdp(3, S, A, concentration=0.05)
    value = np.zeros(S)
    for _ in range(200):
        value = printed_backup(crowd, value)
    with item("5.21") as check:
        check(gap, "<=", 1e-12, "B V against loops, matrices and lists, 20 MDPs")
        check(printed, ">", 0.01, "E5.8: with the printed index, distance of B V from the loops")
        check(factor, ">", 1, "E5.8: with the printed index, largest sup-norm factor")
        check(np.abs(value).max(), ">", 1e3, "E5.8: values after 200 sweeps with the printed index; |V*| is below 20")
        assert np.abs(optimal_q_values(crowd)).max() < 20


def test_the_fixed_point(item):
    residual = gap = 0.0
    for seed in range(10):
        mdp = random_mdp(seed, S, A, num_terminal=seed % 3)
        best = optimal_q_values(mdp).max(-1)
        residual = max(residual, bellman_residual(mdp, best))
        gap = max(gap, np.abs(policy_iteration(mdp).value.values - best).max())
        for k in range(5):
            assert np.all(v_values(mdp, random_policy(k, S, A)) <= best + 1e-12)
        # Unique: a fixed point is reached from anywhere.
        value = np.random.default_rng(seed).normal(scale=100, size=S) * ~mdp.terminal
        ahead = stepwise(mdp)
        for _ in range(400):
            value = ahead.best(value)
        gap = max(gap, np.abs(value - best).max())
    with item("5.22") as check:
        check(residual, "<=", 1e-12, "residual of V*, 10 MDPs")
        check(gap, "<=", 1e-12, "policy iteration, and 400 backups from values of size 100, against V*")


def test_it_contracts_by_gamma_and_exactly_so_for_a_shift(item):
    rng, largest, shifted, printed = np.random.default_rng(0), 0.0, 0.0, 0.0
    for seed in range(50):
        mdp = random_mdp(seed, S, A, discount=GAMMA, concentration=0.3)
        backup = stepwise(mdp).best
        for _ in range(200):
            one, other = rng.normal(size=S), rng.normal(size=S)
            largest = max(largest, contraction_ratio(backup, one, other))
        shifted = max(shifted, abs(contraction_ratio(backup, one, one + 3.0) - GAMMA))
    # Without a discount there may be no fixed point: a loop that pays for ever.
    loop = lambda v: v + 1.0  # noqa: E731
    printed = contraction_ratio(loop, np.zeros(1), np.ones(1))
    with item("5.23") as check:
        check(largest, "<=", GAMMA + 1e-12, "largest ratio of 10^4 pairs, γ = 0.9")
        check(shifted, "<=", 1e-12, "ratio for V' = V + c, from γ")
        check(printed, "<=", 1, "E5.9: ||BV - BV'|| <= ||V - V'||, as printed, holds of V -> V + 1 ...")
        check(sup_norm(loop(np.zeros(1))), ">", 0, "... which has no fixed point")


def test_the_geometric_rate(item):
    violation, late = -np.inf, 0
    for seed in range(1000):
        gamma = (0.5, 0.8)[seed % 2]
        ahead, value = stepwise(random_mdp(seed, 4, 2, discount=gamma, concentration=0.3)), np.zeros(4)
        path = [value := ahead.best(value) for _ in range(30)]
        best, rest = path[-1], gamma**30 / (1 - gamma) * sup_norm(ahead.rewards)  # |best - V*| <= rest
        first = sup_norm(best) + rest
        errors = np.abs(np.array(path) - best).max(1)[:15]
        violation = max(violation, (errors - rest - gamma ** np.arange(1, 16) * first).max())
        enough = sweeps_needed(gamma, first, 0.1 * first)
        late += errors[enough - 1] - rest > 0.1 * first
    with item("5.24") as check:
        check(violation, "<=", 1e-12, "error after k sweeps beyond γ^k times the first, 1000 MDPs")
        check(late, "==", 0, "MDPs that need more sweeps than log(ε / error) / log γ")


def test_the_projection(item):
    rng = np.random.default_rng(0)
    idempotent = norm = nearest = 0.0
    for _ in range(50):
        features, weights = rng.normal(size=(6, 3)), rng.dirichlet(np.ones(6))
        matrix, root = projection(features, weights), np.sqrt(weights)
        idempotent = max(idempotent, np.abs(matrix @ matrix - matrix).max())
        norm = max(norm, abs(np.linalg.norm(root[:, None] * matrix / root[None], 2) - 1))
        value = rng.normal(size=6)
        ours = weighted_norm(value - matrix @ value, weights)
        others = [weighted_norm(value - features @ rng.normal(size=3), weights) for _ in range(20)]
        nearest = max(nearest, ours - min(others))
    example = projection(w_2w().features)
    with item("5.25") as check:
        check(idempotent, "<=", 1e-12, "Π Π - Π")
        check(norm, "<=", 1e-10, "E5.10: ||Π||_D from 1: a non-expansion, no contraction")
        check(abs(np.linalg.norm(example, np.inf) - 1.2), "<=", 1e-12, "features (1, 2): sup norm, from 1.2")
        check(abs(np.linalg.norm(example, 2) - 1), "<=", 1e-12, "features (1, 2): L2 norm, from 1")
        check(nearest, "<=", 0, "nothing that the features can say is nearer")
    with pytest.raises(ValueError, match="not all 0"):
        projection(np.ones((2, 1)), np.zeros(2))


def test_projected_q_backups(item):
    """Fitted Q-iteration, Q <- Π B Q: at rate γ with Π = I; w, 2w lifted to two actions grows by 6γ/5."""
    from rewardtogo.envs.tabular import MDP

    mdp = random_mdp(0, S, A, discount=GAMMA)
    step, q, best = projected_q_backup(mdp, np.eye(S * A)), np.zeros((S, A)), optimal_q_values(mdp)
    over = -np.inf
    for k in range(1, 100):
        q = step(q)
        over = max(over, sup_norm(q - best) - GAMMA**k * sup_norm(best))
    both = np.zeros((2, 2, 2))
    both[:, :, 1] = 1.0
    with item("5.30") as check:
        check(over, "<=", 1e-12, "tabular: error beyond γ^k")
        for gamma in (0.8, 0.9):
            lifted = projected_q_backup(MDP(both, np.zeros((2, 2)), discount=gamma), np.array([[1.0], [1], [2], [2]]))
            q, factors = np.array([[1.0, 1.0], [2.0, 2.0]]), []
            for _ in range(100):
                factors.append(sup_norm(lifted(q)) / sup_norm(q))
                q = lifted(q)
            check(np.abs(np.array(factors) - 6 * gamma / 5).max(), "<=", 1e-12, f"w, 2w: factor from 6γ/5, γ = {gamma}")
            check(sup_norm(q), "<" if gamma < 5 / 6 else ">", 1, f"|Q| after 100 fits, γ = {gamma}")


def test_projecting_a_contraction_may_make_none(item):
    from rewardtogo.envs.tabular import MDP

    to_second = np.array([[[0.0, 1.0]], [[0.0, 1.0]]])
    with item("5.27") as check:
        for gamma, grows in ((0.8, False), (0.9, True)):
            chain = w_2w(gamma)
            step = projected_backup(MDP(to_second, np.zeros((2, 1)), discount=gamma), chain.features)
            value = chain.features[:, 0]
            check(abs(step(value)[0] - 6 * gamma / 5), "<=", 1e-12, f"factor of one fit, from 6γ/5, γ = {gamma}")
            for _ in range(100):
                value = step(value)
            check(value[0], ">" if grows else "<", 1, f"w after 100 fits, γ = {gamma}: diverges above 5/6")
            if grows:
                check(abs(value[0] / 1.08**100 - 1), "<=", 1e-10, "w_100 = 1.08^100 = 2200")


def test_the_implicit_policy_is_at_least_as_good(item):
    """1000 random MDPs and policies; ties either way; A and Q choose the same (E5.3: what §5.2.2 calls A is Q)."""
    loss = different = 0.0
    for seed in range(1000):
        states, actions = 2 + seed % 3, 2 + seed % 2
        mdp, policy = random_mdp(seed, states, actions, discount=0.8), random_policy(seed, states, actions)
        q = np.round(q_values(mdp, policy), 1) if seed % 4 == 0 else q_values(mdp, policy)
        if seed % 4:
            one_hot = np.eye(actions)[q.argmax(-1)]
            loss = max(loss, (v_values(mdp, policy) - v_values(mdp, one_hot)).max())
        advantage = q - (policy * q).sum(-1, keepdims=True)
        different += int((advantage.argmax(-1) != q.argmax(-1)).sum() if seed % 4 else 0)
    tied = jnp.asarray([0.5, 2.0, 2.0])
    shared = np.asarray(greedy_probabilities(tied, ties="uniform"))
    with item("5.1") as check:
        check(loss, "<=", 1e-12, "how much a state loses by the greedy policy, 750 MDPs")
        check(np.abs(np.asarray(greedy_probabilities(tied)) - [0, 1, 0]).max(), "==", 0, "a tie goes to the first")
        check(np.abs(shared - [0, 0.5, 0.5]).max(), "==", 0, "or is shared")
        check((tied == tied.max()).astype(float).sum(), "==", 2, "E5.1: as printed, probabilities of a tie sum to 2")
    with item("5.2") as check:
        check(different, "==", 0, "states in which argmax A is not argmax Q, 750 tables")
        rng, apart = np.random.default_rng(0), 0
        q, v = rng.integers(0, 3, (1000, 3)), rng.integers(-2, 3, (1000, 1))  # whole numbers: ties are exact
        for ties in ("first", "uniform"):
            choose = jax.vmap(lambda row, ties=ties: greedy_probabilities(row, ties=ties))
            by_q, by_a = (np.asarray(choose(jnp.asarray(x, jnp.float32))) for x in (q, q - v))
            apart += int((by_q != by_a).any(-1).sum())
        check(apart, "==", 0, "rows with ties in which they choose differently, 1000 rows, ties either way")


def test_backups_of_policies_have_their_values_as_fixed_points():
    mdp, policy = random_mdp(0, S, A), random_policy(1, S, A)
    value = v_values(mdp, policy)
    np.testing.assert_allclose(evaluation_backup(mdp, policy, value), value, atol=1e-12)
    np.testing.assert_allclose(q_backup(mdp, value), q_values(mdp, policy), atol=1e-12)
    assert expected_return(mdp, policy) == pytest.approx(mdp.initial @ value)
    with pytest.raises(ValueError, match="the same"):
        contraction_ratio(lambda v: v, value, value)
