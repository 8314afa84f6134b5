"""The smallest examples in which fitted values diverge, and the methods that converge all the same."""

import numpy as np
import pytest

from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import induced_chain, stationary_distribution
from rewardtogo.value.bellman_errors import (
    bellman_error,
    double_sample_error,
    greedy_support,
    squared_td_error,
    target_variance,
)
from rewardtogo.value.divergence import (
    Chain,
    averager,
    baird,
    fit_on,
    follow,
    lstd,
    projected_norm,
    residual_gradient,
    sampled_residual_gradient,
    semi_gradient,
    w_2w,
)
from rewardtogo.value.operators import projection, stepwise, sup_norm


def on_policy_chain(seed: int, states: int = 6, features: int = 3, gamma: float = 0.95) -> Chain:
    """A random ergodic chain with random features, weighed by its own stationary distribution."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(seed, states, 2, discount=gamma, concentration=0.3)
    transitions, rewards = induced_chain(mdp, random_policy(seed, states, 2))
    return Chain(
        transitions,
        rewards,
        rng.normal(size=(states, features)),
        stationary_distribution(transitions),
        gamma,
        np.zeros(features),
    )


def test_bairds_counterexample(item):
    chain = baird(0.99)
    path = follow(chain, 0.1, 10_000)
    tabular = Chain(chain.transitions, chain.rewards, np.eye(7), chain.weights, 0.99, chain.features @ chain.start)
    with item("5.28") as check:
        check(np.linalg.norm(path[-1]), ">", 1e3, "||w|| after 10^4 expected semi-gradient sweeps, γ = 0.99")
        assert np.all(chain.features @ np.zeros(8) == 0)  # V* can be said exactly
        values = follow(tabular, 7.0, 5000)[-1]
        check(sup_norm(values), "<=", 1e-12, "the same updates of a table, |V - V*|")
        fitted = fit_on(chain, 2000)
        check(sup_norm(fitted[-1]), "<=", 1e-6, "fitted evaluation, whose least squares can say V* (uniform d)")


def powers(chain: Chain, step: float, method: str, second: float, doublings: int) -> np.ndarray:
    """The path of `follow` after 2^doublings sweeps: its update is linear, so that a matrix can be squared."""
    size = len(chain.start)
    matrix, covariance = chain.key_matrix, chain.covariance
    corrected = chain.gamma * (chain.transitions @ chain.features).T @ (chain.weights[:, None] * chain.features)
    top = [np.eye(size), step * matrix.T] if method == "gtd2" else [np.eye(size) - step * matrix, -step * corrected]
    update = np.block([top, [-second * matrix, np.eye(size) - second * covariance]])
    start = np.concatenate([chain.start, np.zeros(size)])
    few = np.linalg.matrix_power(update, 50) @ start
    np.testing.assert_allclose(few[:size], follow(chain, step, 50, method, second)[-1], rtol=1e-9, atol=1e-12)
    for _ in range(doublings):
        update = update @ update
    return (update @ start)[:size]


def test_two_time_scales_converge_where_semi_gradients_do_not(item):
    chain = baird(0.99)
    with item("5.32") as check:
        for method in ("gtd2", "tdc"):
            w = powers(chain, 0.2, method, 1.0, 23)
            check(np.linalg.norm(chain.features @ w), "<", 1e-2, f"{method} on Baird's: ||V|| after 2^23 sweeps")
        rng, worst, rise = np.random.default_rng(0), 0.0, -np.inf
        for seed in range(20):
            mdp = random_mdp(seed, 6, 2, discount=0.9)
            mean = averager(rng.dirichlet(np.ones(3), 6))
            one, other = rng.normal(size=6), rng.normal(size=6)
            step = lambda v, ahead=stepwise(mdp), mean=mean: mean @ ahead.best(v)  # noqa: E731
            worst = max(worst, sup_norm(step(one) - step(other)) / sup_norm(one - other))
            values = [one]
            for _ in range(200):
                values.append(step(values[-1]))
            gaps = [sup_norm(v - values[-1]) for v in values[:100]]
            rise = max(rise, float(np.diff(gaps).max()))
        check(worst, "<=", 0.9 + 1e-12, "averagers: sup-norm factor of a fit of a backup, γ = 0.9")
        check(rise, "<=", 1e-12, "averagers: how much the distance to the fixed point ever rises")
    with pytest.raises(ValueError, match="must be in a group"):
        averager(np.array([[1.0, 0.0], [0.0, 0.0]]))


def test_on_policy_it_is_a_contraction(item):
    chains = [on_policy_chain(seed) for seed in range(1000)]
    over = max(projected_norm(c) - c.gamma for c in chains)
    off = max(
        np.abs(np.linalg.eigvals(c.gamma * fit_matrix(c, np.random.default_rng(i).dirichlet(0.1 * np.ones(6))))).max()
        for i, c in enumerate(chains[:200])
    )
    chain = chains[0]
    with item("5.29") as check:
        check(over, "<=", 1e-12, "||γ Π P||_d - γ, 1000 chains with their own stationary d")
        check(off, ">", 1, "E5.10: the largest spectral radius of γ Π P with another d")
        expected = follow(chain, 0.1, 20_000)[-1]
        check(np.abs(expected - lstd(chain)).max(), "<=", 1e-8, "expected semi-gradient TD against LSTD")
        mild = on_policy_chain(0, gamma=0.8)
        check(np.abs(sampled_td(mild, 200_000) - lstd(mild)).max(), "<=", 1e-2, "sampled TD(0), averaged, against LSTD")


def fit_matrix(chain: Chain, weights: np.ndarray) -> np.ndarray:
    return projection(chain.features, weights + 1e-9) @ chain.transitions


def sampled_td(chain: Chain, steps: int) -> np.ndarray:
    """TD(0) along one path of the chain, the mean of the last half of the parameters (Polyak and Juditsky 1992)."""
    rng = np.random.default_rng(0)
    cumulative, w, mean, state = chain.transitions.cumsum(1), np.zeros(len(chain.start)), np.zeros(len(chain.start)), 0
    for t, uniform in enumerate(rng.random(steps)):
        after = int(np.searchsorted(cumulative[state], uniform * cumulative[state, -1], side="right"))
        x = chain.features[state]
        w = w + 0.02 * (chain.rewards[state] + chain.gamma * chain.features[after] @ w - x @ w) * x
        if t >= steps // 2:
            mean += w / (steps - steps // 2)
        state = after
    return mean


def test_semi_gradients_are_no_gradients(item):
    """Jacobians by finite differences: that of a gradient is symmetric. On-policy, too (E5.11)."""
    chain = on_policy_chain(3)
    w, step = np.random.default_rng(0).normal(size=3), 1e-5
    jacobians = [
        np.stack([(f(chain, w + step * e) - f(chain, w - step * e)) / (2 * step) for e in np.eye(3)], 1)
        for f in (semi_gradient, residual_gradient, sampled_residual_gradient)
    ]
    skew = [np.abs(j - j.T).max() for j in jacobians]
    fixed = lstd(chain)
    naive = follow(chain, 0.1, 20_000, "sampled_residual_gradient")[-1]
    true = follow(chain, 0.1, 50_000, "residual_gradient")[-1]
    with item("5.31") as check:
        check(skew[0], ">", 1e-2, "E5.11: asymmetry of the Jacobian of semi-gradient TD, on-policy")
        check(max(skew[1:]), "<=", 1e-8, "asymmetry of residual gradients")
        check(np.abs(sampled_residual_gradient(chain, naive)).max(), "<=", 1e-8, "the residual gradient converges")
        check(np.abs(chain.features @ (naive - fixed)).max(), ">", 1e-2, "to values other than TD's")
        check(np.abs(residual_gradient(chain, true)).max(), "<=", 1e-6, "with two samples it converges as well")
        table = Chain(chain.transitions, chain.rewards, np.eye(6), chain.weights, 0.95, np.zeros(6))
        wrong = np.linalg.lstsq(*normal(table), rcond=None)[0]
        check(np.abs(wrong - lstd(table)).max(), ">", 1e-2, "a table by one-sample residual gradients, from V")


def normal(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """The linear system of the one-sample residual gradient: where it is 0."""
    zero = np.zeros(len(chain.start))
    offset = sampled_residual_gradient(chain, zero)
    return -np.stack([sampled_residual_gradient(chain, e) - offset for e in np.eye(len(zero))], 1), offset


def test_w_2w_by_fits_and_by_steps(item):
    with item("5.27") as check:
        for gamma in (0.8, 0.9):
            factor = fit_on(w_2w(gamma), 1)[1, 0]
            check(abs(factor - 1.2 * gamma), "<=", 1e-12, f"factor of a fit, from 6γ/5, γ = {gamma}")
        small = follow(w_2w(0.9), 0.1, 2000)[-1, 0]
        check(small, ">", 1e3, "small semi-gradient steps diverge as well, γ = 0.9")


# --- the Bellman error -----------------------------------------------------------------------------------------------


def test_three_errors_at_the_optimum(item):
    """E5.7: at Q* the Bellman error is 0, the mean squared TD error is not, and two samples make it 0 again."""
    from rewardtogo.exact import optimal_q_values

    mdp = random_mdp(0, 5, 3, discount=0.9)
    beta, q = np.full((5, 3), 1 / 15), optimal_q_values(mdp)
    value = q.max(-1)
    rng, n = np.random.default_rng(0), 200_000
    s, a = rng.integers(0, 5, n), rng.integers(0, 3, n)
    cumulative = mdp.transitions.cumsum(-1)
    first, second = ((rng.random((n, 1)) > cumulative[s, a]).sum(-1).clip(0, 4) for _ in range(2))
    error = q[s, a] - mdp.rewards[s, a] - 0.9 * value[first]
    variance = ((mdp.transitions @ value**2) - (mdp.transitions @ value) ** 2).mean()
    products = double_sample_error(q[s, a], mdp.rewards[s, a], np.full(n, 0.9), q[first], q[second])
    off = np.random.default_rng(1).normal(size=(5, 3))
    off_products = double_sample_error(off[s, a], mdp.rewards[s, a], np.full(n, 0.9), off[first], off[second])
    with item("5.16") as check:
        check(bellman_error(mdp, q, beta), "<=", 1e-20, "Bellman error of Q*")
        closed = 0.5 * 0.81 * variance
        check(abs(squared_td_error(mdp, q, beta) - closed), "<=", 1e-10, "squared TD error of Q* from ½ γ² Var")
        check(closed, ">", 0.05, "which is not 0")
        z = abs(0.5 * np.mean(error**2) - closed) / (0.5 * np.std(error**2) / np.sqrt(n))
        check(z, "<=", 4, "the same from samples, standard errors")
        check(abs(products.mean()) / (products.std() / np.sqrt(n)), "<=", 4, "two next states: standard errors from 0")
        z = abs(off_products.mean() - bellman_error(mdp, off, beta)) / (off_products.std() / np.sqrt(n))
        check(z, "<=", 4, "two next states, another Q: standard errors from its Bellman error")
        assert target_variance(mdp, q, beta) == pytest.approx(closed)


def test_no_error_is_optimal_only_where_it_is_measured(item):
    """A state with a bad action that pays now and a good one that pays later; β leaves the good one out."""
    from rewardtogo.envs.tabular import MDP

    transitions = np.zeros((3, 2, 3))
    transitions[0, 0, 2] = transitions[0, 1, 1] = transitions[1, :, 2] = 1.0
    mdp = MDP(transitions, np.array([[1.0, 0], [5, 5], [0, 0]]), 0, 0.9, [False, False, True])
    wrong = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    partial = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    full = np.full((3, 2), 1 / 6)
    from rewardtogo.exact import expected_return, optimal_policy, optimal_q_values

    best = expected_return(mdp, optimal_policy(mdp))
    got = expected_return(mdp, np.eye(2)[wrong.argmax(-1)])
    right = optimal_q_values(mdp)
    with item("5.17") as check:
        check(bellman_error(mdp, wrong, partial), "==", 0, "error where β looks")
        check(best - got, ">", 3, "what its greedy policy loses")
        check(bellman_error(mdp, wrong, full), ">", 0.1, "error with full support")
        check(bellman_error(mdp, right, full), "<=", 1e-20, "error of Q* with full support")
        loss = best - expected_return(mdp, np.eye(2)[right.argmax(-1)])
        check(abs(loss), "<=", 1e-12, "and the loss of its greedy policy")
        met = greedy_support(mdp, right.argmax(-1), mdp.initial)
        check((met & ~(partial > 0)).sum(), ">", 0, "pairs that the optimal policy meets and β leaves out")
