import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import offset, small

from rewardtogo.envs.tabular import MDP, POMDP, TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.exact import TablePolicy, q_values, simulate, v_values
from rewardtogo.exact.estimators import estimator_moments, moments, step_moments
from rewardtogo.exact.gradients import policy_gradient
from rewardtogo.exact.observed import enumerate_observed
from rewardtogo.exact.signals import action_values_at, n_step_returns, rewards_to_go, total_returns, values_at
from rewardtogo.exact.softmax import control_variate_samples, gradient_samples, softmax_policy
from rewardtogo.ops import returns

SMALL = small()
GRADIENT = policy_gradient(SMALL.mdp, SMALL.logits)
Q = q_values(SMALL.mdp, softmax_policy(SMALL.logits))
V = v_values(SMALL.mdp, softmax_policy(SMALL.logits))


def distance(found, gradient=GRADIENT):
    return np.abs(found.mean - gradient).max()


@pytest.fixture(scope="module")
def sampled():
    table = TablePolicy(jnp.asarray(softmax_policy(SMALL.logits), jnp.float32))
    return simulate(TabularEnv(SMALL.mdp), table, jax.random.key(0), 100_000, 3)


def test_reinforce_is_unbiased(item, sampled):
    found = moments(gradient_samples(SMALL.logits, sampled, total_returns(sampled)))
    error = np.sqrt(found.variance / 100_000)
    with item("3.5") as check:
        check((np.abs(found.mean - GRADIENT) / error).max(), "<=", 4, "standard errors from ∇J, 10^5 trajectories")
        check(distance(estimator_moments(SMALL.mdp, SMALL.logits, total_returns)), "<=", 1e-12, "by enumeration")


def test_variance_by_enumeration_and_by_sampling(item, sampled):
    exact = estimator_moments(SMALL.mdp, SMALL.logits, total_returns, baseline=0.3)
    every, log_probs = enumerate_observed(SMALL.mdp, softmax_policy(SMALL.logits))
    score, total = gradient_samples(SMALL.logits, every), np.asarray(every.returns())[:, None, None]
    chance = np.exp(log_probs)
    formula = np.tensordot(chance, (score * (total - 0.3)) ** 2, 1) - np.tensordot(chance, score * total, 1) ** 2
    found = moments(gradient_samples(SMALL.logits, sampled, total_returns(sampled) - 0.3))
    with item("3.23") as check:
        check(np.abs(exact.variance - formula).max(), "<=", 1e-12, "E[g²(r - b)²] - E[g r]²")
        ratio = np.abs(found.variance / exact.variance - 1)
        check(100 * ratio.max(), "<=", 2, "per cent from it, each parameter, 10^5 samples")
        check(100 * abs(found.total_variance / exact.total_variance - 1), "<=", 2, "per cent, trace")


def test_reward_to_go(item):
    rewards = np.random.default_rng(0).normal(size=(50, 7))
    every, _ = enumerate_observed(random_mdp(0, 3, 2, num_terminal=1), np.full((3, 2), 0.5), 4)
    slow = sum(
        np.pad(every.rewards[:, k:] * 0.9**k, ((0, 0), (0, k))) for k in range(4)
    )  # Σ_k γ^k r_{t+k}, each term of the double sum once
    full = estimator_moments(SMALL.mdp, SMALL.logits, total_returns)
    causal = estimator_moments(SMALL.mdp, SMALL.logits, rewards_to_go)
    with jax.enable_x64(True):
        fast = jax.vmap(returns.reward_to_go)(jnp.asarray(rewards), jnp.full(rewards.shape, 0.9))
        double = sum(np.pad(rewards[:, k:] * 0.9**k, ((0, 0), (0, k))) for k in range(7))
        batch = np.abs(np.asarray(fast) - double).max()
    with item("3.18") as check:
        check(np.abs(rewards_to_go(every, 0.9) - slow).max(), "<=", 1e-13, "the definition, a double sum")
        check(batch, "<=", 1e-13, "ops.returns.reward_to_go against it")
        check(max(distance(full), distance(causal)), "<=", 1e-12, "both are unbiased")
        check(abs(full.total_variance - 1.1350847367915384), "<=", 1e-9, "total variance 1.135 ...")
        check(abs(causal.total_variance - 0.5599517292797556), "<=", 1e-9, "... goes down to .560 (E3.4)")


def test_reward_to_go_can_raise_the_variance(item):
    """First the state pays X = ±3, whatever is done, then -X: the total is 0, what is left is not (erratum E3.4)."""
    transitions = np.zeros((4, 2, 4))
    transitions[[0, 1], :, [2, 3]] = transitions[[2, 3], :, [2, 3]] = 1
    x = np.array([3.0, -3.0, -3.0, 3.0])[:, None].repeat(2, 1)
    problem = POMDP(MDP(transitions, x, [0.5, 0.5, 0, 0], horizon=2), np.eye(3)[[0, 1, 2, 2]])
    full, causal = (step_moments(problem, np.zeros((3, 2)), psi) for psi in (total_returns, rewards_to_go))
    with item("3.19") as check:
        check(np.abs(full.variance).max(), "==", 0, "variance with the full return")
        check(abs(causal.variance[1, 2, 0] - 2.25), "<=", 1e-14, "second step, reward to go: from E[score² X²] = 2.25")
        check(np.abs(full.mean).max() + np.abs(causal.mean).max(), "<=", 1e-15, "both are unbiased")


def test_the_variance_grows_with_the_square_of_an_offset(item):
    ks = np.array([10.0, 30.0, 100.0, 300.0, 1000.0])
    mdp, logits = random_mdp(5, 3, 2, horizon=3, discount=1.0), np.random.default_rng(5).normal(size=(3, 2))
    gradient = policy_gradient(mdp, logits)
    plain = [estimator_moments(offset(mdp, k), logits, total_returns) for k in ks]
    exponent = np.polyfit(np.log(ks), np.log([m.total_variance for m in plain]), 1)[0]
    every, log_probs = enumerate_observed(mdp, softmax_policy(logits))
    draws = np.random.default_rng(0).choice(len(log_probs), 20_000, p=np.exp(log_probs))
    worst = 0.0
    for k in ks:
        samples = gradient_samples(logits, every, total_returns(every) + 3 * k)[draws]
        error = samples.std(0) / np.sqrt(len(draws))
        worst = max(worst, (np.abs(samples.mean(0) - gradient) / error).max())
    held = [estimator_moments(offset(mdp, k), logits, lambda τ, k=k: total_returns(τ) - 3 * k - 0.2) for k in ks]
    with item("3.16") as check:
        check(exponent, ">=", 1.9, "Var ~ k^p: fitted p")
        check(exponent, "<=", 2.1, "Var ~ k^p: fitted p")
        check(max(distance(m, gradient) for m in plain), "<=", 1e-9, "the mean stays, exactly")
        check(worst, "<=", 4, "standard errors of a sample mean of 2 x 10^4 from ∇J")
        spread = np.ptp([m.total_variance for m in held])
        check(spread, "<=", 1e-9, "with a baseline that knows the offset the variance stays")


def test_true_q_lowers_the_variance_of_every_step(item):
    """Rao-Blackwell: Q is the mean of the reward to go given (s, a)."""
    steps, lower, bias = -np.inf, 0, 0.0
    for seed in range(60):
        mdp, logits = random_mdp(seed, 2, 2, horizon=3), np.random.default_rng(seed).normal(size=(2, 2))
        q = q_values(mdp, softmax_policy(logits))
        weights = [lambda τ, q=q: action_values_at(τ, q), lambda τ: rewards_to_go(τ, 0.9)]
        exact, causal = (step_moments(mdp, logits, w) for w in weights)
        steps = max(steps, (exact.variance - causal.variance).max())
        whole, usual = (estimator_moments(mdp, logits, w) for w in weights)
        lower += whole.total_variance <= usual.total_variance
        option_1 = policy_gradient(mdp, logits, discounting="option_1")
        bias = max(bias, distance(whole, option_1), distance(usual, option_1))
    with item("4.1") as check:
        check(bias, "<=", 1e-10, "unbiased, 60 MDPs")
        check(steps, "<=", 1e-12, "variance of a step beyond that with reward to go, at worst")
        check(lower, "==", 60, "of 60 MDPs have a lower total variance, too")


def test_the_critic_as_a_baseline(item):
    """Section 4.8 sums rewards from t' = 1: unbiased, too, but V(s_t) foretells rewards to go and not the total."""
    correct = estimator_moments(SMALL.mdp, SMALL.logits, lambda τ: rewards_to_go(τ) - values_at(τ, V))
    printed = estimator_moments(SMALL.mdp, SMALL.logits, lambda τ: total_returns(τ) - values_at(τ, V))
    with item("4.28") as check:
        check(distance(correct), "<=", 1e-10, "unbiased")
        check(distance(printed), "<=", 1e-10, "as printed: unbiased, too")
        check(abs(correct.total_variance - 0.4774), "<=", 5e-5, "total variance .477 ...")
        check(abs(printed.total_variance - 0.9902), "<=", 5e-5, "... and .990 as printed (E4.8)")


def test_baselines_that_depend_on_the_action(item):
    every, log_probs = enumerate_observed(SMALL.mdp, softmax_policy(SMALL.logits))
    ahead, rng, worst = rewards_to_go(every), np.random.default_rng(0), 0.0
    for shape in [(2, 2)] * 5 + [(3, 2, 2)] * 5:
        samples = control_variate_samples(SMALL.logits, every, ahead, rng.normal(size=shape))
        worst = max(worst, distance(moments(samples, log_probs)))
    forgotten = estimator_moments(SMALL.mdp, SMALL.logits, lambda τ: rewards_to_go(τ) - action_values_at(τ, Q / 2))
    first = step_moments(SMALL.mdp, SMALL.logits, lambda τ: rewards_to_go(τ) - action_values_at(τ, Q))
    left = ahead - action_values_at(every, Q)
    seen, actions, chance = every.observations[:, :-1], every.actions, np.exp(log_probs)
    given = [
        chance[chosen] @ left[chosen, t]
        for t in range(3)
        for chosen in [(seen[:, t] == s) & (actions[:, t] == a) for s in range(2) for a in range(2)]
    ]
    exact = control_variate_samples(SMALL.logits, every, action_values_at(every, Q), Q)
    # With deterministic dynamics r + V(s') is Q, one sample of it, and nothing is left of the first term.
    moves = np.eye(3)[np.random.default_rng(1).integers(3, size=(3, 2))]
    sure = MDP(moves, np.random.default_rng(2).normal(size=(3, 2)), [0.2, 0.5, 0.3], horizon=3)
    logits = np.random.default_rng(3).normal(size=(3, 2))
    v, q = v_values(sure, softmax_policy(logits)), q_values(sure, softmax_policy(logits))
    nothing = step_moments(sure, logits, lambda τ: n_step_returns(τ, v, 1) - action_values_at(τ, q))
    with item("4.29") as check:
        check(worst, "<=", 1e-10, "unbiased for any b(s, a), also of time")
        check(distance(forgotten), ">", 1e-3, "without what is put back it is biased")
        check(np.abs(given).max(), "<=", 1e-15, "b = Q: mean of the first term given (s, a)")
        check(first.variance[-1].max(), "<=", 1e-30, "b = Q: variance of the first term, last step")
        check(
            nothing.variance.max(),
            "<=",
            1e-30,
            "b = Q and r + V(s'), sure moves: variance of the first term, all steps",
        )
        check(distance(moments(exact, log_probs)), "<=", 1e-10, "b = Q: unbiased")


def test_signals_refuse_what_has_no_meaning():
    every, _ = enumerate_observed(SMALL.mdp, softmax_policy(SMALL.logits))
    with pytest.raises(ValueError, match="no reward in it"):
        n_step_returns(every, V, 0)
    with pytest.raises(ValueError, match="vary over 7 times"):
        values_at(every, np.zeros((7, 2)))
