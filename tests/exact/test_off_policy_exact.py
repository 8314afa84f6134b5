import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import finite_difference, small

from rewardtogo.envs.tabular import MDP, TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import (
    TablePolicy,
    expected_return,
    one_hot_policy,
    q_values,
    simulate,
    state_distributions,
    trajectory_log_prob,
)
from rewardtogo.exact.estimators import estimator_moments, moments
from rewardtogo.exact.gradients import expected_gradient, policy_gradient, policy_return, state_visits
from rewardtogo.exact.observed import enumerate_observed
from rewardtogo.exact.off_policy import (
    marginal_ratios,
    off_policy_return,
    off_policy_returns,
    per_decision_weights,
    step_ratios,
    trajectory_ratios,
    trajectory_weights,
    weight_variances,
)
from rewardtogo.exact.signals import action_values_at, total_returns
from rewardtogo.exact.softmax import expected_scores, gradient_samples, softmax_policy
from rewardtogo.ops.importance import effective_sample_size, importance_mean, importance_weights

MDP3, LOGITS, OTHER = small()
OLD, NEW = softmax_policy(LOGITS), softmax_policy(OTHER)
GRADIENT = finite_difference(lambda t: policy_return(MDP3, t, method="enumeration").value, OTHER)


def off_policy(weights, logits=OTHER, behaviour=OLD, mdp=MDP3):
    """The mean of an estimator of the gradient at `logits` from trajectories of `behaviour`."""
    target = softmax_policy(logits)
    psi = lambda τ: weights(τ, step_ratios(τ, target, behaviour))  # noqa: E731
    return estimator_moments(mdp, logits, psi, behaviour=behaviour).mean


def test_expectations_under_another_law(item):
    every, log_q = enumerate_observed(MDP3, OLD)
    states, actions = np.asarray(every.observations), np.asarray(every.actions)
    log_p, f = trajectory_log_prob(MDP3, NEW, states, actions), np.asarray(every.returns())
    with jax.enable_x64(True):
        weights = np.asarray(importance_weights(jnp.asarray(log_p), jnp.asarray(log_q)))
        size = effective_sample_size(jnp.zeros(7) + 0.3)
        constant = importance_mean(jnp.ones(4), jnp.zeros(4))
    with item("3.27") as check:
        check(abs(np.exp(log_q) @ (weights * f) - np.exp(log_p) @ f), "<=", 1e-12, "E_q[p/q f] = E_p[f], exact")
        check(abs(float(size) - 7), "<=", 1e-12, "effective sample size where p = q")
        check(float(constant), "==", 1, "mean of 1")


def test_the_dynamics_cancel_in_the_ratio(item):
    worst = 0.0
    for seed in range(30):
        mdp = random_mdp(seed, 3, 2, num_terminal=seed % 2, horizon=3)
        new, old = random_policy(seed, 3, 2), random_policy(seed + 99, 3, 2, 3)
        every, log_q = enumerate_observed(mdp, old)
        log_p = trajectory_log_prob(mdp, new, np.asarray(every.observations), np.asarray(every.actions))
        ratio = trajectory_ratios(step_ratios(every, new, old))
        worst = max(worst, np.abs(ratio / np.exp(log_p - log_q) - 1).max())
    with item("3.28") as check:
        check(worst, "<=", 1e-12, "Π ρ against p'(τ) / p(τ) with the dynamics, relative, 30 MDPs")


def test_the_return_of_another_policy(item):
    worst = 0.0
    for seed in range(20):
        mdp = random_mdp(seed, 3, 2, num_terminal=seed % 2, horizon=3)
        new, old = random_policy(seed, 3, 2), random_policy(seed + 99, 3, 2)
        every, log_q = enumerate_observed(mdp, old)
        ratios, exact = step_ratios(every, new, old), expected_return(mdp, new)
        for per_decision in (False, True):
            found = off_policy_returns(every, ratios, 0.9, per_decision=per_decision)
            worst = max(worst, abs(np.exp(log_q) @ found - exact))
        weights = np.exp(log_q) * trajectory_ratios(ratios)
        worst = max(worst, abs(weights @ np.asarray(every.returns(0.9)) / weights.sum() - exact))
    data = simulate(TabularEnv(MDP3), TablePolicy(jnp.asarray(OLD, jnp.float32)), jax.random.key(0), 20_000, 3)
    exact = expected_return(MDP3, NEW)
    with item("3.29") as check:
        check(worst, "<=", 1e-12, "Π ρ R, per decision and self-normalised, by enumeration, 20 MDPs")
        for method in ("trajectory", "self_normalised", "per_decision"):
            found = off_policy_return(data, NEW, OLD, method=method)
            check(abs(found.value - exact) / found.standard_error, "<=", 4, f"{method}: standard errors from J")
        log_w = jnp.asarray(np.log(trajectory_ratios(step_ratios(data, NEW, OLD))), jnp.float32)
        expected = float(effective_sample_size(log_w))
        check(abs(found.effective_sample_size / expected - 1), "<=", 1e-4, "effective sample size, relative")
        same = off_policy_return(data, OLD, OLD)
        check(same.effective_sample_size, "==", 20_000, "effective sample size of the same policy")


def test_what_was_never_tried_cannot_be_weighted(item):
    always = one_hot_policy(np.zeros(2, int), 2)
    every, _ = enumerate_observed(MDP3, always)
    with item("3.27") as check:
        with pytest.raises(ValueError, match=r"never takes action 1"):
            step_ratios(every, NEW, always)
        with pytest.raises(ValueError, match="never takes"):
            weight_variances(MDP3, NEW, always)
        check(
            np.abs(step_ratios(every, always, OLD) - 1 / OLD[every.observations[:, :-1], 0]).max(),
            "==",
            0,
            "the other way round is fine: ρ = 1 / π(a | s)",
        )
    with pytest.raises(ValueError, match="cannot have produced"):
        off_policy_return(every, one_hot_policy(np.ones(2, int), 2), OLD)
    with pytest.raises(ValueError, match="give a horizon"):
        weight_variances(random_mdp(0, 2, 2), NEW, OLD)


def test_the_gradient_at_another_parameter(item):
    """Without the ratio it would be J(θ), whatever θ' is (erratum E3.7)."""
    every, log_q = enumerate_observed(MDP3, OLD)
    without = np.exp(log_q) @ np.asarray(every.returns())
    weighted = np.exp(log_q) @ off_policy_returns(every, step_ratios(every, NEW, OLD))
    with item("3.30") as check:
        check(np.abs(off_policy(trajectory_weights) - GRADIENT).max(), "<=", 1e-8, "against differences of J(θ')")
        check(abs(weighted - 0.39036958996), "<=", 1e-9, "J(θ') with the ratio, .3904")
        check(abs(weighted - expected_return(MDP3, NEW)), "<=", 1e-12, "which is J(θ')")
        check(abs(without - 0.42159978631), "<=", 1e-9, "as printed, without it, .4216")
        check(abs(without - expected_return(MDP3, NEW)), ">", 0.03, "which is not")


def test_the_same_parameter_needs_no_weights(item):
    every, _ = enumerate_observed(MDP3, OLD)
    ratios = step_ratios(every, OLD, OLD)
    weighted = gradient_samples(LOGITS, every, trajectory_weights(every, ratios))
    with item("3.31") as check:
        check(np.abs(ratios - 1).max(), "==", 0, "weights are 1")
        plain = gradient_samples(LOGITS, every, total_returns(every))
        check(np.abs(weighted - plain).max(), "==", 0, "bit for bit the policy gradient")


def test_the_variance_of_weights_grows_exponentially(item):
    p, q = np.array([[0.3, 0.7]]), np.array([[0.6, 0.4]])
    one = MDP(np.ones((1, 2, 1)), np.zeros((1, 2)), 0, 0.9)
    squared = 0.09 / 0.6 + 0.49 / 0.4
    closed = squared ** np.arange(31) - 1
    found = weight_variances(one, p, q, 30)
    slope = np.polyfit(np.arange(31), np.log(found + 1), 1)[0]
    worst = 0.0
    for seed in range(20):
        mdp = random_mdp(seed, 3, 2, num_terminal=seed % 2, horizon=4)
        new, old = random_policy(seed, 3, 2), random_policy(seed + 99, 3, 2)
        every, log_q = enumerate_observed(mdp, old)
        exact = moments(trajectory_ratios(step_ratios(every, new, old)), log_q).variance
        worst = max(worst, abs(weight_variances(mdp, new, old)[-1] / exact - 1))
    with item("3.32") as check:
        check(np.abs(found - closed)[1:].max() / closed[-1], "<=", 1e-12, "two actions: (1 + χ²)^t - 1, relative")
        check(100 * abs(slope / np.log(squared) - 1), "<=", 1, "per cent: slope of log(Var + 1) against T")
        check(worst, "<=", 1e-10, "with states: dynamic programming against enumeration, relative, 20 MDPs")


def ratio_twice(τ, ratios):
    """The inner product as printed, from t'' = t: ρ_t is there twice (erratum E3.8)."""
    return per_decision_weights(τ, ratios) * ratios


def test_per_decision_gradient(item):
    found, printed = off_policy(per_decision_weights), off_policy(ratio_twice)

    def single(τ, rho):
        return np.stack([sum(τ.rewards[:, j] * rho[:, : j + 1].prod(1) for j in range(t, 3)) for t in range(3)], 1)

    with item("3.33") as check:
        check(np.abs(found - policy_gradient(MDP3, OTHER)).max(), "<=", 1e-10, "from ∇J(θ')")
        check(np.abs(off_policy(single) - found).max(), "<=", 1e-14, "as a double sum: weight Π_{k <= t'} ρ_k")
        check(abs(np.abs(printed - GRADIENT).max() - 0.04144981), "<=", 1e-6, "as printed it is .041 off")


def test_discounted_per_decision_gradient(item):
    mdp, gradient = small(0.8).mdp, policy_gradient(small(0.8).mdp, OTHER)
    for weights in (per_decision_weights, trajectory_weights):
        found = off_policy(lambda τ, rho, w=weights: w(τ, rho, 0.8), mdp=mdp)
        with item("3.33") as check:
            check(np.abs(found - gradient).max(), "<=", 1e-10, f"{weights.__name__}, discounted: from ∇J_γ(θ')")


def deleted(τ, ratios):
    return per_decision_weights(τ, ratios, future_ratio=False)


def test_deleting_the_future_ratio(item):
    """Not the gradient, but the direction that improves on the old policy (erratum E3.9)."""
    found = off_policy(deleted)
    expected = expected_gradient(OTHER, state_visits(MDP3, NEW), q_values(MDP3, OLD))
    with item("3.34") as check:
        check(np.abs(found - expected).max(), "<=", 1e-12, "Σ_t E_{π'}[∇ log π' Q^π]")
        check(np.abs(found - GRADIENT).max(), ">", 1e-3, "bias")
        check(abs(np.abs(found - GRADIENT).max() - 0.00805734), "<=", 1e-7, "bias, .008")


def test_ratios_of_state_distributions(item):
    marginal = lambda τ: marginal_ratios(MDP3, τ, NEW, OLD)  # noqa: E731
    exact = off_policy(lambda τ, rho: per_decision_weights(τ, rho, past=marginal(τ)))
    old_q = off_policy(lambda τ, rho: per_decision_weights(τ, rho, past=marginal(τ), future_ratio=False))
    q = q_values(MDP3, NEW)
    critic = off_policy(lambda τ, rho: marginal(τ) * rho * action_values_at(τ, q))
    with item("3.35") as check:
        check(np.abs(exact - GRADIENT).max(), "<=", 1e-10, "with d'_t / d_t: from ∇J(θ')")
        check(np.abs(critic - GRADIENT).max(), "<=", 1e-10, "with d'_t / d_t and Q of the new policy")
        check(np.abs(old_q - off_policy(deleted)).max(), "<=", 1e-12, "without future ratios: as item 3.34")


def first_order(τ, ratios):
    return per_decision_weights(τ, ratios, past=np.ones(ratios.shape), future_ratio=False)


def mixed(seed, mdp, eps):
    """A policy that acts as another one with probability `eps`, as logits."""
    old, other = random_policy(seed, *mdp.rewards.shape), random_policy(seed + 50, *mdp.rewards.shape)
    return old, np.log((1 - eps) * old + eps * other)


def test_leaving_out_the_ratio_of_states(item):
    reach, slopes, matched = 0.0, [], 0.0
    sizes = np.array([0.001, 0.002, 0.004, 0.008])
    for seed in range(20):
        mdp, biases = random_mdp(seed, 3, 2, horizon=5, concentration=0.5), []
        for eps in (*sizes, 0.3):
            old, logits = mixed(seed, mdp, eps)
            new = softmax_policy(logits)
            old_visits = state_visits(mdp, old)
            # With Q of the new policy, only the states are wrong: item 3.35 without its ratio.
            q = q_values(mdp, new)
            bias = np.abs(expected_gradient(logits, old_visits, q) - policy_gradient(mdp, logits)).max()
            distance = 0.5 * np.abs(new - old).sum(-1).max()
            steepest = np.abs(expected_scores(logits, q)).max()
            bound = 2 * distance * (0.9 ** np.arange(5) * np.arange(5)).sum() * steepest
            reach = max(reach, bias / bound)
            found = expected_gradient(logits, old_visits, q_values(mdp, old))
            biases.append(np.abs(found - policy_gradient(mdp, logits)).max())
        slopes.append(np.polyfit(np.log(sizes), np.log(biases[:-1]), 1)[0])
    for eps in (0.0, 0.1):
        old, logits = mixed(0, MDP3, eps)
        found = off_policy(first_order, logits, old)
        expected = expected_gradient(logits, state_visits(MDP3, old), q_values(MDP3, old))
        matched = max(matched, np.abs(found - expected).max())
        if eps == 0:
            same = np.abs(found - policy_gradient(MDP3, logits)).max()
    with item("3.35") as check:
        check(reach, "<=", 1, "bias without d'_t / d_t, in units of C ε with C = 2 max|Σ ∇π Q| Σ γ^t t, 20 MDPs")
        check(reach, ">", 1e-3, "and the bias is there")
    with item("3.36") as check:
        check(matched, "<=", 1e-12, "estimator by enumeration against Σ_t E_{d_t}[∇π' Q^π]")
        check(same, "<=", 1e-12, "exact at θ' = θ")
        check(min(slopes), ">=", 0.9, "bias ~ ε^p: least p of 20 MDPs")
        check(max(slopes), "<=", 1.1, "bias ~ ε^p: greatest p of 20 MDPs")


def test_ratios_of_states_are_those_of_the_distributions():
    every, _ = enumerate_observed(MDP3, OLD)
    new, old = (state_distributions(MDP3, p) for p in (NEW, OLD))
    expected = (new / old)[np.arange(3), np.asarray(every.observations)[:, :-1]]
    assert np.array_equal(marginal_ratios(MDP3, every, NEW, OLD), expected)
