"""The performance difference lemma and the surrogate, on random problems."""

import numpy as np
import pytest
from theory_problems import drifting, problems

from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import (
    advantage_values,
    discounted_occupancy,
    expected_return,
    greedy_policy,
    q_values,
    softmax_policy,
    state_distributions,
)
from rewardtogo.policy_gradient.theory import (
    argmax_step,
    discounted_visits,
    gradient_step,
    importance_performance_difference,
    performance_difference,
    surrogate_advantage,
    surrogate_gradient,
)


def gain(mdp, new, old):
    return expected_return(mdp, new) - expected_return(mdp, old)


def test_the_performance_difference_lemma(item):
    errors = [abs(performance_difference(*case) - gain(*case)) for case in problems(200)]
    with item("7.1") as check:
        check(max(errors), "<=", 1e-12, "against J' - J, 200 problems, with and without a horizon")


def test_occupancies(item):
    sums, linear, returns, series = 0.0, 0.0, 0.0, 0.0
    for seed in range(100):
        mdp, policy = random_mdp(seed, 4, 3, discount=0.8), random_policy(seed, 4, 3)
        visits = discounted_occupancy(mdp, policy)
        states = 0.2 * visits.sum(-1)
        chain = np.einsum("sa,sax->sx", policy, mdp.transitions)
        sums = max(sums, abs(states.sum() - 1), np.abs(state_distributions(mdp, policy, 9).sum(-1) - 1).max())
        linear = max(linear, np.abs(0.2 * mdp.initial @ np.linalg.inv(np.eye(4) - 0.8 * chain) - states).max())
        returns = max(returns, abs((0.2 * visits * mdp.rewards).sum() / 0.2 - expected_return(mdp, policy)))
        times = 0.8 ** np.arange(160)
        series = max(series, np.abs(0.2 * times @ state_distributions(mdp, policy, 159) - states).max())
    with item("7.2") as check:
        check(sums, "<=", 1e-12, "d_t and d^γ sum to 1")
        check(linear, "<=", 1e-12, "(1 - γ) p_0' (I - γ P_π)^-1")
        check(series, "<=", 1e-12, "(1 - γ) Σ_t γ^t d_t")
        check(returns, "<=", 1e-12, "J = E_d[r] / (1 - γ)")


def test_visits_with_and_without_a_horizon_agree():
    mdp, policy = random_mdp(3, 4, 2, num_terminal=1), random_policy(3, 4, 2)
    assert np.abs(discounted_visits(mdp, policy, 400).sum(0) - discounted_visits(mdp, policy)).max() < 1e-12
    assert discounted_visits(mdp, policy, 400)[:, mdp.terminal].max() == 0


def test_policy_gradient_is_policy_iteration(item):
    cases = problems(200)
    jumps = [performance_difference(mdp, argmax_step(mdp, old), old) for mdp, _, old in cases]
    steps, still = [], 0.0
    for mdp, _, old in cases:
        logits = np.log(old)
        steps.append(performance_difference(mdp, softmax_policy(gradient_step(mdp, logits, 1e-3)), old))
        jump = argmax_step(mdp, old)
        saturated = surrogate_gradient(mdp, np.where(jump > 0, 0.0, -np.inf), jump)
        still = max(still, np.abs(saturated).max())
    with item("7.3") as check:
        check(min(jumps), ">=", -1e-12, "Σ γ^t E_d'[A] of the argmax step, 200 problems")
        check(min(steps), ">", 0, "of a small gradient step, none of them stationary")
        check(still, "==", 0, "gradient at a deterministic policy: stationary for the softmax, if not for the argmax")


def test_the_importance_form(item):
    errors = [abs(importance_performance_difference(*case) - performance_difference(*case)) for case in problems(200)]
    mdp, new, old = drifting(0.1, 0.9)
    with item("7.4") as check:
        check(max(errors), "<=", 1e-12, "against states and actions of the new policy")
        with pytest.raises(ValueError, match="in state 0 the new policy takes action 1, to which the old one gives"):
            importance_performance_difference(mdp, new, old)
        never_there = np.array([[1.0, 0.0], [0.5, 0.5]])
        found = importance_performance_difference(mdp, never_there, old)
        check(found, "==", 0, "support is missing only where the new policy never comes")
    with pytest.raises(ValueError, match="in state 0 at time 0"):
        importance_performance_difference(mdp, new, old, 5)


def differences(value, logits, step=1e-5):
    """Central differences in every entry."""
    result = np.empty_like(logits)
    for place in np.ndindex(logits.shape):
        moved = np.zeros_like(logits)
        moved[place] = step
        result[place] = (value(logits + moved) - value(logits - moved)) / (2 * step)
    return result


def test_the_surrogate_agrees_to_first_order(item):
    values, gradients, away = 0.0, 0.0, 0.0
    for mdp, new, old in problems(24):
        logits = np.log(old)
        values = max(values, abs(surrogate_advantage(mdp, old, old)))
        exact = differences(lambda x, mdp=mdp: expected_return(mdp, softmax_policy(x)), logits)
        gradients = max(gradients, np.abs(surrogate_gradient(mdp, logits, old) - exact).max())
        far = np.log(new + 0.01)
        numeric = differences(lambda x, m=mdp, o=old: surrogate_advantage(m, softmax_policy(x), o), far)
        away = max(away, np.abs(surrogate_gradient(mdp, far, old) - numeric).max())
    with item("7.5") as check:
        check(values, "<=", 1e-12, "Ā at the old policy")
        check(away, "<=", 1e-7, "∇Ā against differences of Ā, away from the old policy")
    for name in ("7.5", "7.21"):
        with item(name) as check:
            check(gradients, "<=", 1e-7, "∇Ā at the old policy against differences of J, γ^t kept")


def test_the_mismatch_is_of_second_order(item):
    slopes = []
    sizes = np.logspace(-3, -1.5, 6)
    for seed, (mdp, _, old) in enumerate(problems(40)):
        other = random_policy(seed + 999, mdp.num_states, mdp.num_actions)
        mixed = [(1 - eps) * old + eps * other for eps in sizes]
        off = [abs(gain(mdp, new, old) - surrogate_advantage(mdp, new, old)) for new in mixed]
        slopes.append(np.polyfit(np.log(sizes), np.log(off), 1)[0])
    with item("7.6") as check:
        check(min(slopes), ">=", 1.9, "slope of log |J' - J - Ā| over log ε")
        check(max(slopes), "<=", 2.1, "slope of log |J' - J - Ā| over log ε")


def test_logits_shared_in_time_have_the_sum_of_the_gradients():
    mdp, old = random_mdp(0, 3, 2, horizon=4), random_policy(1, 3, 2)
    timed = surrogate_gradient(mdp, np.log(np.broadcast_to(old, (4, 3, 2))), old)
    assert np.array_equal(timed.sum(0), surrogate_gradient(mdp, np.log(old), old))


def test_advantages_have_mean_0_and_argmax_is_greedy_in_q():
    mdp, old = random_mdp(0, 3, 2), random_policy(1, 3, 2)
    assert np.abs((old * advantage_values(mdp, old)).sum(-1)).max() < 1e-14
    assert np.array_equal(argmax_step(mdp, old), greedy_policy(q_values(mdp, old)))


def test_impossible_things_are_refused():
    mdp = random_mdp(0, 3, 2)
    with pytest.raises(ValueError, match="give no distribution"):
        softmax_policy(np.full((3, 2), -np.inf))
    with pytest.raises(ValueError, match="step size is -1"):
        gradient_step(mdp, np.zeros((3, 2)), -1.0)
    with pytest.raises(ValueError, match="horizon is 0"):
        performance_difference(mdp, random_policy(0, 3, 2), random_policy(1, 3, 2), 0)
    assert np.array_equal(softmax_policy(np.array([[0.0, -np.inf]])), [[1, 0]])
