import itertools

import numpy as np
import pytest
import scipy.optimize
from small_problems import aliased, finite_difference

from rewardtogo.envs.tabular import MDP, POMDP
from rewardtogo.envs.tabular_problems import aliased_corridor, random_mdp, random_policy
from rewardtogo.exact import (
    belief_update,
    best_deterministic_policy,
    enumerated_return,
    expected_return,
    initial_belief,
    memoryless_policy,
    optimal_q_values,
    v_values,
)
from rewardtogo.exact.estimators import estimator_moments
from rewardtogo.exact.gradients import policy_gradient, policy_return
from rewardtogo.exact.observed import enumerate_observed, history_mdp, joint_mdp
from rewardtogo.exact.signals import rewards_to_go, td_errors, total_returns, values_at
from rewardtogo.exact.softmax import softmax_policy


def test_pairs_of_state_and_observation(item):
    worst, chance = 0.0, 0.0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        mdp = random_mdp(seed, 3, 2, num_terminal=seed % 2, horizon=2)
        pomdp, policy = POMDP(mdp, rng.dirichlet(np.ones(2), 3)), random_policy(seed, 2, 2)
        every, log_probs = enumerate_observed(pomdp, policy)
        exact = expected_return(mdp, memoryless_policy(pomdp, policy))
        worst = max(worst, abs(np.exp(log_probs) @ np.asarray(every.returns(0.9)) - exact))
        worst = max(worst, abs(enumerated_return(mdp, memoryless_policy(pomdp, policy)) - exact))
        first = every.extras["state"][:, 0] * 2 + np.asarray(every.observations)[:, 0]
        counted = np.bincount(first, np.exp(log_probs), 6).reshape(3, 2)
        chance = max(chance, np.abs(counted - mdp.initial[:, None] * pomdp.emissions).max())
    with item("3.13") as check:
        check(worst, "<=", 1e-12, "J over observed trajectories against π(a | s) = Σ_o O π, 10 POMDPs")
        check(chance, "<=", 1e-12, "p(s_0, o_0) of the trajectories")


def test_the_policy_gradient_does_not_need_the_state(item):
    worst, exact = 0.0, 0.0
    for seed in range(20):
        pomdp, logits = aliased(seed), np.random.default_rng(seed).normal(size=(2, 2))
        gradient = policy_gradient(pomdp, logits)
        for weights in (lambda τ: total_returns(τ, 0.9), lambda τ: 0.9 ** np.arange(3) * rewards_to_go(τ, 0.9)):
            worst = max(worst, np.abs(estimator_moments(pomdp, logits, weights).mean - gradient).max())
        if seed < 5:
            moved = finite_difference(lambda t, p=pomdp: policy_return(p, t).value, logits)
            exact = max(exact, np.abs(moved - gradient).max())
    with item("3.13") as check:
        check(worst, "<=", 1e-12, "REINFORCE on observations against ∇J, by enumeration, 20 aliased MDPs")
        check(exact, "<=", 1e-8, "∇J against differences of J")


def climb(problem, shape, horizon):
    start = 0.1 * np.random.default_rng(0).normal(size=shape)
    found = scipy.optimize.minimize(
        lambda t: -policy_return(problem, t.reshape(shape), horizon).value,
        start.ravel(),
        jac=lambda t: -policy_gradient(problem, t.reshape(shape), horizon).ravel(),
        method="L-BFGS-B",
        bounds=[(-20, 20)] * start.size,
    )
    return -found.fun


def test_memory_reaches_more(item):
    """In the corridor of look-alikes the best memoryless policy is random; one that remembers needs 3 steps."""
    corridor = aliased_corridor(horizon=5)
    p = np.linspace(0, 1, 2001)[1:-1]
    tried = [expected_return(corridor.mdp, memoryless_policy(corridor, np.array([[1 - x, x]]))) for x in p]
    histories = history_mdp(corridor)
    listed = best_deterministic_policy(corridor, 5, time_varying=True)[1]
    memoryless = climb(corridor, (1, 2), 5)
    remembering = climb(histories.mdp, (histories.mdp.num_states, 2), 5)
    with item("3.13") as check:
        check(abs(memoryless - max(tried)), "<=", 1e-5, "gradient ascent on π(a | o) reaches the best of a grid")
        check(abs(listed + 3), "<=", 1e-12, "the best of all that remember the time takes 3 steps")
        check(abs(remembering - listed), "<=", 1e-4, "gradient ascent on π(a | history) reaches it")
        check(remembering - memoryless, ">", 0.1, "which is more than without a memory")


def by_alpha_vectors(pomdp, steps):
    """The value of the belief MDP: all conditional plans, each as its value in every state."""
    mdp, emissions = pomdp.mdp, np.asarray(pomdp.emissions)
    vectors = np.zeros((1, mdp.num_states))
    for _ in range(steps):
        plans = []
        for action in range(mdp.num_actions):
            after = np.einsum("sx,xz,kx->zks", mdp.continuation[:, action], emissions, vectors) * mdp.discount
            for choice in itertools.product(range(len(vectors)), repeat=emissions.shape[1]):
                plans.append(mdp.rewards[:, action] + sum(after[z, k] for z, k in enumerate(choice)))
        vectors = np.unique(np.round(plans, 13), axis=0)
        best = np.argmax(np.stack([np.linspace(0, 1, 4001), np.linspace(1, 0, 4001)], 1) @ vectors.T, 1)
        vectors = vectors[np.unique(best)]
    return sum(
        (vectors @ (mdp.initial * emissions[:, o])).max() for o in range(emissions.shape[1])
    )  # Σ_o p(o) max_α α · b_o, with p(o) left in the belief


def test_histories_are_as_good_as_beliefs(item):
    worst = 0.0
    for seed in range(8):
        pomdp = POMDP(random_mdp(seed, 2, 2, horizon=4), np.random.default_rng(seed).dirichlet(np.ones(2), 2))
        histories = history_mdp(pomdp)
        value = histories.mdp.initial @ optimal_q_values(histories.mdp)[0].max(-1)
        worst = max(worst, abs(value - by_alpha_vectors(pomdp, 4)))
    with item("3.14") as check:
        check(worst, "<=", 1e-6, "optimal value against the belief MDP's, by alpha vectors, 8 two-state POMDPs")


def test_histories_hold_their_beliefs(item):
    pomdp = POMDP(random_mdp(3, 3, 2, num_terminal=1, horizon=4), np.random.default_rng(0).dirichlet(np.ones(2), 3))
    histories, worst = history_mdp(pomdp), 0.0
    for h, before in enumerate(histories.parent):
        seen = int(histories.observation[h])
        if before < 0:
            expected = initial_belief(pomdp, seen)
        else:
            expected = belief_update(pomdp, histories.beliefs[before], int(histories.action[h]), seen)
        worst = max(worst, np.abs(histories.beliefs[h] - expected).max())
    policy = random_policy(0, 2, 2)
    table = np.concatenate([policy[histories.observation], np.full((1, 2), 0.5)])
    memoryless = expected_return(pomdp.mdp, memoryless_policy(pomdp, policy))
    with item("3.14") as check:
        check(len(histories.parent), "==", 2 * (1 + 4 + 16 + 64), "Z Σ_t (A Z)^t histories")
        check(worst, "<=", 1e-12, "beliefs of the histories against the filter's")
        check(abs(expected_return(histories.mdp, table) - memoryless), "<=", 1e-12, "J of a policy that forgets")
    with pytest.raises(ValueError, match="too many for one MDP"):
        history_mdp(pomdp, 8)
    with pytest.raises(ValueError, match="the horizon is None"):
        history_mdp(POMDP(random_mdp(0, 2, 2), np.eye(2)))


def test_bootstrapping_on_observations_is_biased(item):
    """V(o) as a baseline costs nothing, r + γ V(o') in the place of the reward to go does (erratum E3.14)."""
    biased, unbiased, sharp = [], 0.0, 0.0
    for seed in range(10):
        pomdp, logits = aliased(seed), np.random.default_rng(seed).normal(size=(2, 2))
        every, log_probs = enumerate_observed(pomdp, softmax_policy(logits))
        seen, chance, ahead = np.asarray(every.observations)[:, :3], np.exp(log_probs), rewards_to_go(every, 0.9)
        # The best V_t(o) there is: the mean reward to go from o at t.
        v = [[chance[seen[:, t] == o] @ ahead[seen[:, t] == o, t] / chance[seen[:, t] == o].sum() for o in range(2)]
             for t in range(3)]  # fmt: skip
        v = np.array(v)
        gradient = policy_gradient(pomdp, logits, discounting="option_1")
        bootstrapped = estimator_moments(pomdp, logits, lambda τ, v=v: td_errors(τ, v, 0.9)).mean
        carlo = estimator_moments(pomdp, logits, lambda τ, v=v: rewards_to_go(τ, 0.9) - values_at(τ, v)).mean
        biased.append(np.abs(bootstrapped - gradient).max())
        unbiased = max(unbiased, np.abs(carlo - gradient).max())
        full = POMDP(pomdp.mdp, np.eye(4))
        logits = np.random.default_rng(seed).normal(size=(4, 2))
        v = v_values(full.mdp, softmax_policy(logits))
        found = estimator_moments(full, logits, lambda τ, v=v: td_errors(τ, v, 0.9)).mean
        sharp = max(sharp, np.abs(found - policy_gradient(full, logits, discounting="option_1")).max())
    with item("3.15") as check:
        check(biased[0], ">", 0.01, "r + γ V(o') - V(o): bias, the aliased MDP of seed 0")
        check(min(biased), ">", 1e-3, "the same, least of 10 aliased MDPs")
        check(np.median(biased), ">", 0.01, "the same, median of 10 aliased MDPs")
        check(unbiased, "<", 1e-10, "reward to go - V(o): bias, greatest")
        check(sharp, "<", 1e-10, "r + γ V(s') - V(s) with the state in view: bias, greatest")


def test_rewards_may_depend_on_the_outcome():
    base = random_mdp(0, 2, 2, horizon=2)
    mdp = MDP(base.transitions, np.random.default_rng(0).normal(size=(2, 2, 2)), base.initial, 0.9, horizon=2)
    pomdp, policy = POMDP(mdp, np.random.default_rng(1).dirichlet(np.ones(2), 2)), random_policy(0, 2, 2)
    every, log_probs = enumerate_observed(pomdp, policy)
    exact = expected_return(mdp, memoryless_policy(pomdp, policy))
    assert np.exp(log_probs) @ np.asarray(every.returns(0.9)) == pytest.approx(exact, abs=1e-12)
    assert joint_mdp(pomdp).outcome_rewards is not None
