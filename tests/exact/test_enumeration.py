import numpy as np
import pytest

from rewardtogo.envs.tabular import MDP
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import (
    best_deterministic_policy,
    enumerate_trajectories,
    enumerated_return,
    expected_return,
    optimal_policy,
    optimal_q_values,
    q_values,
    trajectory_log_prob,
)

TINY = [(seed, 2 + seed % 3, 1 + seed % 2, 1 + seed % 4) for seed in range(40)]


def test_probabilities_of_all_trajectories_sum_to_one(item):
    kept, dropped, each = 0.0, 0.0, 0.0
    for seed, states, actions, horizon in TINY:
        mdp = random_mdp(seed, states, actions, num_terminal=seed % 2)
        policy = random_policy(seed + 1, states, actions, horizon)
        every, log_probs = enumerate_trajectories(mdp, policy, horizon)
        kept = max(kept, abs(np.exp(log_probs).sum() - 1))
        again = trajectory_log_prob(mdp, policy, every.observations, every.actions)
        each = max(each, np.abs(again - log_probs).max())
        short = np.unique(np.concatenate([every.observations[:, :-1], every.actions], 1), axis=0)
        density = trajectory_log_prob(mdp, policy, short[:, :horizon], short[:, horizon:])
        dropped = max(dropped, abs(np.exp(density).sum() - 1))
    for name in ("1.14", "8.1"):
        with item(name) as check:
            check(kept, "<=", 1e-12, "from sum 1, T transitions and s_T kept (E1.1), 40 MDPs")
            check(dropped, "<=", 1e-12, "from sum 1, T - 1 transitions, ending in a_{T-1} (E1.1)")
            check(each, "<=", 1e-12, "log density of each trajectory")


def test_the_density_as_printed_is_not_normalised(item):
    """T transitions for a trajectory that ends at its last action: a density over one more variable (erratum E1.1)."""
    mdp, policy = random_mdp(0, 2, 2), random_policy(1, 2, 2)
    every, log_probs = enumerate_trajectories(mdp, policy, 3)
    seen = np.concatenate([every.observations[:, :-1], every.actions], 1)
    first = np.unique(seen, axis=0, return_index=True)[1]
    with item("1.14") as check:
        check(np.exp(log_probs[first]).sum(), "<", 0.9, "sum over (s_0, a_0, ..., a_{T-1}) with one s_T for each")


def test_impossible_trajectories_have_probability_zero():
    mdp = MDP([[[0.0, 1.0]], [[0.0, 1.0]]], [[1.0], [1.0]], 0, 0.9)
    assert trajectory_log_prob(mdp, np.ones((2, 1)), np.array([[0, 0]]), np.array([[0]]))[0] == -np.inf
    with pytest.raises(ValueError, match="2 actions go with 3 states"):
        trajectory_log_prob(mdp, np.ones((2, 1)), np.zeros((1, 4), int), np.zeros((1, 2), int))


def test_enumerated_return_is_that_of_dynamic_programming(item):
    worst = 0.0
    for seed, states, actions, horizon in TINY:
        mdp = random_mdp(seed, states, actions, num_terminal=seed % 2, horizon=horizon)
        for policy in (random_policy(seed, states, actions), random_policy(seed, states, actions, horizon)):
            worst = max(worst, abs(enumerated_return(mdp, policy) - expected_return(mdp, policy)))
    outcome = MDP(random_mdp(1, 3, 2).transitions, np.random.default_rng(0).normal(size=(3, 2, 3)), 0, 0.9)
    policy = random_policy(3, 3, 2)
    with item("1.15") as check:
        check(worst, "<=", 1e-12, "Σ_τ p(τ) R(τ) against Σ_s p0 V_0")
        error = abs(enumerated_return(outcome, policy, 4) - expected_return(outcome, policy, 4))
        check(error, "<=", 1e-12, "with r(s, a, s')")


def test_early_ends_are_padded():
    mdp = MDP([[[0.5, 0.5]], [[0.0, 1.0]]], [[1.0], [7.0]], terminal=[False, True], horizon=3)
    every, log_probs = enumerate_trajectories(mdp, np.ones((2, 1)))
    order = np.argsort(every.lengths)
    assert every.lengths[order].tolist() == [1, 2, 3, 3]
    assert sorted(every.returns().tolist()) == [1, 2, 3, 3]
    assert np.exp(log_probs[order]) == pytest.approx([0.5, 0.25, 0.125, 0.125])
    assert every.terminated.all() and not every.truncated.any()


def test_best_of_all_policies_is_optimal(item):
    discounted, finite, undiscounted = 0.0, 0.0, 0.0
    for seed in range(30):
        mdp = random_mdp(seed, 3, 2, num_terminal=seed % 2)
        policy, value = best_deterministic_policy(mdp)
        optimum = mdp.initial @ optimal_q_values(mdp).max(-1)
        discounted = max(discounted, abs(value - optimum), abs(expected_return(mdp, policy) - optimum))
        discounted = max(discounted, abs(expected_return(mdp, optimal_policy(mdp)) - optimum))
        policy, value = best_deterministic_policy(mdp, 3, time_varying=True)
        optimum = mdp.initial @ optimal_q_values(mdp, 3)[0].max(-1)
        finite = max(finite, abs(value - optimum), abs(expected_return(mdp, policy, 3) - optimum))
        mdp = random_mdp(seed, 4, 3, num_terminal=1, discount=1.0)
        value = best_deterministic_policy(mdp)[1]
        undiscounted = max(undiscounted, abs(value / (mdp.initial @ optimal_q_values(mdp).max(-1)) - 1))
    with item("1.17") as check:
        check(discounted, "<=", 1e-11, "|A|^|S| policies against policy iteration, discounted")
        check(finite, "<=", 1e-12, "|A|^(|S|T) policies against backward induction")
        check(undiscounted, "<=", 1e-9, "undiscounted with a terminal state, relative")


def test_finite_horizons_want_policies_that_vary_with_time(item):
    """Work now for 1, or in the last step cash in for 2: a stationary policy cannot do both (erratum E1.2)."""
    transitions = np.zeros((2, 2, 2))
    transitions[0, 0, 0] = transitions[0, 1, 1] = transitions[1, :, 1] = 1
    mdp = MDP(transitions, [[1.0, 2.0], [0.0, 0.0]], horizon=3)
    with item("1.17") as check:
        check(best_deterministic_policy(mdp, time_varying=True)[1], "==", 4)
        check(best_deterministic_policy(mdp)[1], "==", 3)
        check(q_values(mdp, optimal_policy(mdp))[0, 0].max(), "==", 4)


def test_too_much_is_refused():
    mdp = random_mdp(0, 5, 3)
    with pytest.raises(ValueError, match="too many trajectories"):
        enumerate_trajectories(mdp, random_policy(0, 5, 3), 8)
    with pytest.raises(ValueError, match="give a horizon"):
        enumerate_trajectories(mdp, random_policy(0, 5, 3))
    with pytest.raises(ValueError, match=r"3\^20 deterministic policies"):
        best_deterministic_policy(mdp, 4, time_varying=True)
