import itertools

import numpy as np
import pytest
from small_problems import offset, small

from rewardtogo.envs.tabular import MDP
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.exact import q_values, v_values
from rewardtogo.exact.estimators import (
    batch_moments,
    estimator_moments,
    optimal_baselines,
    subtract_batch_mean,
    subtract_others_mean,
)
from rewardtogo.exact.gradients import policy_gradient, policy_return
from rewardtogo.exact.observed import enumerate_observed
from rewardtogo.exact.signals import action_values_at, rewards_to_go, total_returns, values_at
from rewardtogo.exact.softmax import gradient_samples, softmax_policy

SMALL = small()
GRADIENT = policy_gradient(SMALL.mdp, SMALL.logits)


def ratio(found, gradient):
    """How far `found` is along `gradient`, and how far off that line."""
    along = (found * gradient).sum() / (gradient**2).sum()
    return along, np.abs(found - along * gradient).max()


def test_the_average_of_the_same_batch_shrinks_the_gradient(item):
    """As printed the average-reward baseline is "still unbiased"; its mean is (1 - 1/N) ∇J (erratum E3.5)."""
    gradient = policy_gradient(SMALL.mdp, SMALL.logits, 2)
    printed = batch_moments(SMALL.mdp, SMALL.logits, total_returns, 3, 2)
    others = batch_moments(SMALL.mdp, SMALL.logits, total_returns, 3, 2, compare=subtract_others_mean)
    with item("3.20") as check:
        along, off = ratio(printed.mean, gradient)
        check(abs(along - 2 / 3), "<=", 1e-12, "ratio to ∇J is 1 - 1/N, N = 3")
        check(off, "<=", 1e-12, "and nothing but a ratio")
        check(np.abs(printed.mean - gradient).max(), ">", 0.01, "so that it is biased")
    with item("3.21") as check:
        check(abs(ratio(others.mean, gradient)[0] - 1), "<=", 1e-12, "leave one out: ratio to ∇J, N = 3")
        check(np.abs(others.mean - gradient).max(), "<=", 1e-12, "unbiased in every parameter")


def test_a_bandit_by_hand(item):
    """Two arms that pay 1 and 3, three draws, all eight batches written out."""
    p, pays = np.array([0.3, 0.7]), np.array([1.0, 3.0])
    bandit, logits = MDP(np.ones((1, 2, 1)), pays[None], horizon=1), np.log(p)[None]
    means, others = np.zeros(2), np.zeros(2)
    for batch in itertools.product(range(2), repeat=3):
        r, score = pays[list(batch)], np.eye(2)[list(batch)] - p
        means += p[list(batch)].prod() * (score * (r - r.mean())[:, None]).mean(0)
        others += p[list(batch)].prod() * (score * (r - (r.sum() - r) / 2)[:, None]).mean(0)
    found = [
        batch_moments(bandit, logits, total_returns, 3, compare=c) for c in (subtract_batch_mean, subtract_others_mean)
    ]
    with item("3.20") as check:
        check(np.abs(found[0].mean[0] - means).max(), "<=", 1e-15, "batch mean against the sum written out")
    with item("3.21") as check:
        check(np.abs(found[1].mean[0] - others).max(), "<=", 1e-15, "leave one out against the sum written out")


def test_leaving_one_out_lowers_the_variance(item):
    """Where rewards are far from 0; elsewhere what the baseline adds of its own can be more than it takes away."""
    ratios = {k: [] for k in (0.0, 3.0)}
    for seed, k in itertools.product(range(10), ratios):
        mdp = offset(random_mdp(seed, 2, 2, horizon=2, discount=1.0), k)
        logits = np.random.default_rng(seed).normal(size=(2, 2))
        plain = batch_moments(mdp, logits, total_returns, 3, 2, compare=lambda x: x)
        others = batch_moments(mdp, logits, total_returns, 3, 2, compare=subtract_others_mean)
        ratios[k].append(others.total_variance / plain.total_variance)
        single = estimator_moments(mdp, logits, total_returns)
        assert plain.total_variance == pytest.approx(single.total_variance / 3, rel=1e-9)
    with item("3.21") as check:
        check(max(ratios[3.0]), "<=", 1, "variance in proportion to no baseline, at worst of 10 MDPs, rewards N(3, 1)")
        check(max(ratios[0.0]), ">", 1, "the same with rewards N(0, 1): it is no law")


def test_baselines_of_the_state_do_not_bias(item):
    rng, worst, constant, discounted = np.random.default_rng(0), 0.0, 0.0, 0.0
    for seed in range(30):
        mdp, logits = random_mdp(seed, 2, 2, horizon=3, num_terminal=seed % 2), rng.normal(size=(2, 2))
        b, c = rng.normal(size=2), rng.normal(size=(3, 2))
        worst = max(worst, np.abs(estimator_moments(mdp, logits, lambda τ, b=b: values_at(τ, b)).mean).max())
        worst = max(worst, np.abs(estimator_moments(mdp, logits, lambda τ, c=c: values_at(τ, c)).mean).max())
        found = estimator_moments(mdp, logits, lambda τ: total_returns(τ, 0.9), baseline=b[0])
        constant = max(constant, np.abs(found.mean - policy_gradient(mdp, logits)).max())
        found = estimator_moments(mdp, logits, lambda τ, c=c: rewards_to_go(τ, 0.9) - values_at(τ, c))
        discounted = max(discounted, np.abs(found.mean - policy_gradient(mdp, logits, discounting="option_1")).max())
    with item("3.22") as check:
        check(worst, "<=", 1e-12, "E[Σ_t ∇ log π b_t(s_t)], random b, 30 MDPs")
        check(constant, "<=", 1e-12, "a constant: from ∇J")
        check(discounted, "<=", 1e-12, "of state and time: from the gradient")


def test_a_baseline_of_the_action_does(item):
    b = np.random.default_rng(0).normal(size=(2, 2))
    with item("3.22") as check:
        found = estimator_moments(SMALL.mdp, SMALL.logits, lambda τ: action_values_at(τ, b))
        check(np.abs(found.mean).max(), ">", 0.01, "E[∇ log π b(s, a)] is not 0")


def test_optimal_baselines(item):
    each, scalar = optimal_baselines(SMALL.mdp, SMALL.logits)
    mean = policy_return(SMALL.mdp, SMALL.logits).value
    found = {
        name: estimator_moments(SMALL.mdp, SMALL.logits, total_returns, baseline=b)
        for name, b in {"none": 0.0, "mean": mean, "scalar": scalar, "each": each}.items()
    }
    every, log_probs = enumerate_observed(SMALL.mdp, softmax_policy(SMALL.logits))
    score, total = gradient_samples(SMALL.logits, every), np.asarray(every.returns())[:, None, None]
    moved = [
        (np.tensordot(np.exp(log_probs), (score * (total - each - d)) ** 2, 1) - GRADIENT**2) - found["each"].variance
        for d in np.linspace(-1, 1, 41)
    ]
    grid = [
        estimator_moments(SMALL.mdp, SMALL.logits, total_returns, baseline=scalar + d).total_variance
        for d in np.linspace(-1, 1, 21)
    ]
    with item("3.24") as check:
        check(np.min(moved), ">=", -1e-14, "one for each parameter: least on a grid around each")
        check(np.argmin(grid), "==", 10, "one number: least of a grid is its middle")
        order = [found[name].total_variance for name in ("none", "mean", "scalar", "each")]
        expected = [1.13508, 0.98381, 0.97333, 0.97093]
        check(np.abs(np.subtract(order, expected)).max(), "<=", 1e-5, "none 1.135, mean .984, scalar .973, each .971")
        check(np.diff(order).max(), "<", 0, "none > mean > scalar > per parameter (E3.6)")
        check(max(np.abs(m.mean - GRADIENT).max() for m in found.values()), "<=", 1e-12, "all unbiased")
    with pytest.raises(ValueError, match="such as total_returns"):
        optimal_baselines(SMALL.mdp, SMALL.logits, weights=rewards_to_go)


def test_an_average_for_each_time(item):
    mdp = offset(SMALL.mdp, 2.0)
    q = q_values(mdp, softmax_policy(SMALL.logits), 2)
    weights = lambda τ: action_values_at(τ, q)  # noqa: E731
    gradient = policy_gradient(mdp, SMALL.logits, 2)
    plain = batch_moments(mdp, SMALL.logits, weights, 3, 2, compare=lambda x: x)
    averaged = batch_moments(mdp, SMALL.logits, weights, 3, 2)
    with item("4.2") as check:
        along, off = ratio(averaged.mean, gradient)
        check(abs(along - 2 / 3), "<=", 1e-12, "b_t of the same batch: ratio to ∇J is 1 - 1/N, N = 3")
        check(off, "<=", 1e-12, "and nothing but a ratio")
        # Scaled back to the mean that it should have.
        check(2.25 * averaged.total_variance, "<", plain.total_variance, "variance against none, rewards + 2, rescaled")


def test_values_as_a_baseline(item):
    lower, bias, gains = 0, 0.0, []
    for seed in range(60):
        base, logits = random_mdp(seed, 2, 2, horizon=3), np.random.default_rng(seed).normal(size=(2, 2))
        for k in (0.0, 10.0):
            mdp = offset(base, k)
            policy = softmax_policy(logits)
            q, v = q_values(mdp, policy), v_values(mdp, policy)
            with_v = estimator_moments(mdp, logits, lambda τ, q=q, v=v: action_values_at(τ, q) - values_at(τ, v))
            without = estimator_moments(mdp, logits, lambda τ, q=q: action_values_at(τ, q))
            option_1 = policy_gradient(mdp, logits, discounting="option_1")
            bias = max(bias, np.abs(with_v.mean - option_1).max())
            if k:
                gains.append(without.total_variance / with_v.total_variance)
            else:
                lower += with_v.total_variance < without.total_variance
    with item("4.3") as check:
        check(bias, "<=", 1e-10, "unbiased, 60 MDPs with and without an offset")
        check(min(gains), ">=", 10, "times lower variance with rewards + 10, at least")
        check(lower, "<", 60, "of 60 MDPs without an offset have a lower variance: not all (E4.13)")
        check(lower, ">", 30, "of 60 MDPs without an offset have a lower variance: most")


def test_too_many_batches_are_refused():
    with pytest.raises(ValueError, match=r"128\^4 batches"):
        batch_moments(SMALL.mdp, SMALL.logits, total_returns, 4)
    with pytest.raises(ValueError, match="no others"):
        batch_moments(SMALL.mdp, SMALL.logits, total_returns, 1, compare=subtract_others_mean)
