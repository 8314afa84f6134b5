"""The figure of bias and variance: exact moments against enumeration, and a sweep over n and λ."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.envs.tabular import MDP
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import enumerate_trajectories, q_values
from rewardtogo.exact.targets import n_step_return_moments
from rewardtogo.figures import bias_variance
from rewardtogo.figures.bias_variance import LAMBDAS, SAMPLES, STEPS, critic, lambda_return_moments, spreads, sweep


@pytest.fixture(scope="module")
def figure():
    drawn = bias_variance.draw(seed=1, runs=20)
    FigureCanvasAgg(drawn).draw()
    return drawn


def three_layers():
    """A problem that ends after three steps: two states in each layer and an end that can come early, too."""
    rng, ends = np.random.default_rng(0), np.arange(7) == 6
    transitions = np.zeros((7, 2, 7))
    for layer, state in np.ndindex(3, 2):
        to = (2 * layer + 2, 2 * layer + 3, 6) if layer < 2 else (6,)
        transitions[2 * layer + state][:, to] = rng.dirichlet(np.ones(len(to)), 2)
    transitions[6, :, 6] = 1
    return MDP(transitions, rng.normal(size=(7, 2, 7)), 0, 0.9, ends)


def test_moments_of_lambda_returns(item):
    mdp, policy, values, worst = three_layers(), random_policy(0, 7, 2), np.arange(7.0) - 2, 0.0
    every, log_probs = enumerate_trajectories(mdp, policy, 3)
    after = np.where(np.arange(3) == every.lengths[:, None] - 1, 0.0, values[every.observations[:, 1:]])
    for lambda_ in (0.0, 0.5, 0.9, 1.0):
        sums = np.zeros(len(log_probs))
        for t in (2, 1, 0):
            live = t < every.lengths
            going = live & (t < every.lengths - 1)
            ahead = np.where(going, (1 - lambda_) * after[:, t] + lambda_ * sums, 0.0)
            sums = np.where(live, every.rewards[:, t] + 0.9 * ahead, 0.0)
        found = lambda_return_moments(mdp, policy, values, lambda_)
        for a in range(2):
            p = np.exp(log_probs) * (every.actions[:, 0] == a)
            mean = p @ sums / p.sum()
            variance = p @ (sums - mean) ** 2 / p.sum()
            worst = max(worst, abs(found.mean[0, a] - mean), abs(found.variance[0, a] - variance))
    endless, table, noisy = critic()
    one, all_steps = (lambda_return_moments(endless, table, noisy, x) for x in (0.0, 1.0))
    n_step = {n: n_step_return_moments(endless, table, noisy, n) for n in (*range(1, 151), 800)}
    mixed = sum(0.2 * 0.8 ** (n - 1) * m.mean for n, m in n_step.items())
    with item("4.31") as check:
        check(worst, "<=", 1e-12, "mean and variance of λ-returns against enumeration, λ = 0, .5, .9, 1")
        for name, found, n in (("0", one, 1), ("1", all_steps, 800)):
            apart = max(np.abs(found.mean - n_step[n].mean).max(), np.abs(found.variance - n_step[n].variance).max())
            check(apart, "<=", 1e-10, f"λ = {name} against {n} steps")
        error = np.abs(lambda_return_moments(endless, table, noisy, 0.8).mean - mixed).max()
        check(error, "<=", 1e-10, "mean for λ = .8 against the mixture of n-step means")
        check(np.abs(all_steps.mean - q_values(endless, table)).max(), "<=", 1e-10, "λ = 1 has no bias")


def test_bias_falls_and_variance_rises(item, figure):
    found = spreads(1)
    mdp, policy, noisy = critic(1)
    by_hand = n_step_return_moments(mdp, policy, noisy, 3)
    bias = ((by_hand.mean - q_values(mdp, policy)) ** 2).mean()
    drawn = [line.get_ydata() for line in figure.axes[0].get_lines()[:3]]
    with item("4.31") as check:
        check(np.diff(found.n_step[1]).min(), ">=", 0, "drawn: variance of n + 1 steps less that of n")
        check(found.n_step[0, -1], "<", found.n_step[0, 0], "drawn: bias² of 16 steps, of 1")
        error = np.abs(found.n_step[:, 2] - [bias, by_hand.variance.mean() / SAMPLES]).max()
        check(error, "==", 0, "drawn at n = 3 against the moments")
        for line, curve in zip(drawn, (*found.n_step, found.n_step.sum(0)), strict=True):
            check(np.abs(line - curve).max(), "==", 0, "the lines are these numbers")


def test_a_few_steps_are_best_in_the_random_walk(item, figure):
    n_step, lambdas = sweep(0, 20)
    best, best_lambda = STEPS[n_step.min(1).argmin()], LAMBDAS[lambdas.min(1).argmin()]
    drawn = [line.get_ydata() for line in figure.axes[2].get_lines()[:1]]
    with item("4.32") as check:
        check(best, ">=", 2, "drawn: best n")
        check(best, "<=", 16, "drawn: best n")
        check(np.abs(n_step[0] - lambdas[0])[np.isfinite(n_step[0])].max(), "<=", 1e-12, "n = 1 and λ = 0 are one")
        check(drawn[0][0] - drawn[0].min(), ">", 0, "left end of the U above its bottom")
        check(drawn[0][-1] - drawn[0].min(), ">", 0, "right end of the U above its bottom")
    with item("4.35") as check:
        check(lambdas.min(1)[[0, -1]].min() - lambdas.min(), ">", 0, "RMSE of λ = 0 and of λ = 1 above the best")
        check(best_lambda * (1 - best_lambda), ">", 0, "best λ is inside (0, 1)")


def test_rewards_of_the_next_state_count():
    """r(s, a, s') and r(s, a) of equal mean: the same mean, more variance."""
    plain = random_mdp(1, 3, 2)
    spread = plain.rewards[..., None] + np.array([1.0, -1.0, 0.0])
    spread = spread - (plain.transitions * (spread - plain.rewards[..., None])).sum(-1, keepdims=True)
    policy, values = random_policy(1, 3, 2), np.zeros(3)
    mdp = MDP(plain.transitions, spread, plain.initial, plain.discount)
    one, other = (lambda_return_moments(x, policy, values, 0.5) for x in (plain, mdp))
    assert np.allclose(one.mean, other.mean, atol=1e-12) and other.variance.mean() > one.variance.mean()
