import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import finite_difference, small

from rewardtogo.envs.tabular import MDP, POMDP
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.exact import expected_return, trajectory_log_prob, v_values
from rewardtogo.exact.estimators import estimator_moments, moments
from rewardtogo.exact.gradients import expected_gradient, fisher_matrix, policy_gradient, policy_return, state_visits
from rewardtogo.exact.observed import enumerate_observed
from rewardtogo.exact.signals import rewards_to_go, total_returns
from rewardtogo.exact.softmax import expected_scores, gradient_samples, score_table, softmax_policy


def return_of(mdp, horizon=None):
    return lambda logits: policy_return(mdp, logits, horizon).value


def test_three_ways_to_the_return(item):
    worst, values, z = 0.0, 0.0, []
    for seed in range(30):
        mdp = random_mdp(seed, 3, 2, num_terminal=seed % 2, horizon=4)
        logits = np.random.default_rng(seed).normal(size=(3, 2))
        exact = policy_return(mdp, logits).value
        worst = max(worst, abs(policy_return(mdp, logits, method="enumeration").value - exact))
        values = max(values, abs(mdp.initial @ v_values(mdp, softmax_policy(logits))[0] - exact))
        if seed < 3:
            sampled = policy_return(mdp, logits, method="monte_carlo", num_episodes=4000, key=jax.random.key(seed))
            z.append(abs(sampled.value - exact) / sampled.standard_error)
    for name in ("3.1", "4.8"):
        with item(name) as check:
            check(worst, "<=", 1e-12, "dynamic programming against enumeration, 30 MDPs")
            check(max(z), "<=", 4, "standard errors of Monte Carlo from it, 3 MDPs")
    with item("4.8") as check:
        check(values, "<=", 1e-12, "E[V(s_0)] against J")
    with pytest.raises(ValueError, match="needs a key and a horizon"):
        policy_return(random_mdp(0, 3, 2), np.zeros((3, 2)), method="monte_carlo")


def log_softmax_choice(theta, x, a):
    return jax.nn.log_softmax(theta.reshape(3, 2) @ x)[a.astype(int)]


def log_gaussian(theta, x, a):
    mean, log_std = jnp.tanh(theta[:2] @ x), theta[2]
    return -0.5 * ((a - mean) / jnp.exp(log_std)) ** 2 - log_std - 0.5 * jnp.log(2 * jnp.pi)


def log_mixture(theta, x, a):
    weights = jax.nn.log_softmax(theta[:2] * x[0])
    return jax.nn.logsumexp(weights + jnp.stack([log_gaussian(theta[2 + 3 * k : 5 + 3 * k], x, a) for k in range(2)]))


@pytest.mark.parametrize(
    "log_prob, size", [(log_softmax_choice, 6), (log_gaussian, 3), (log_mixture, 8)], ids=["softmax", "gaussian", "mdn"]
)
def test_the_log_derivative_identity(item, log_prob, size):
    """∇π = π ∇ log π and E_π[∇ log π] = 0, the integrals by a fine sum over actions."""
    discrete = log_prob is log_softmax_choice
    actions = np.arange(3.0) if discrete else np.linspace(-14, 14, 4001)
    weight = 1.0 if discrete else actions[1] - actions[0]
    theta, x = 0.5 * np.random.default_rng(size).normal(size=size), np.array([0.7, -0.4])
    with jax.enable_x64(True):
        density = jax.jit(jax.vmap(lambda theta, a: jnp.exp(log_prob(theta, jnp.asarray(x), a)), (None, 0)))
        scores = np.asarray(jax.jit(jax.vmap(jax.grad(log_prob), (None, None, 0)))(theta, x, actions))
        p = np.asarray(density(theta, actions))
        moved = finite_difference(lambda t: density(t, actions), theta).T
    with item("3.2") as check:
        check(np.abs(moved - p[:, None] * scores).max(), "<=", 1e-6, "∇π - π ∇ log π, differences against autodiff")
        check(np.abs(weight * p @ scores).max(), "<=", 1e-10, "E[∇ log π]")


def test_softmax_scores(item):
    logits = np.random.default_rng(0).normal(size=(4, 3))
    policy, scores = softmax_policy(logits), score_table(logits)
    with item("3.2") as check:
        moved = finite_difference(lambda t: np.log(softmax_policy(t)), logits)
        own = np.einsum("oboa->oab", moved)
        check(np.abs(own - scores).max(), "<=", 1e-6, "tables: one_hot(a) - π against differences")
        check(np.abs(np.einsum("oa,oab->ob", policy, scores)).max(), "<=", 1e-15, "tables: E[score]")
    values = np.random.default_rng(1).normal(size=(4, 3))
    assert np.allclose(np.einsum("oa,oab,oa->ob", policy, scores, values), expected_scores(logits, values), atol=1e-15)


def test_the_exact_gradient_is_that_of_the_return(item):
    worst, varying, endless = 0.0, 0.0, 0.0
    for seed in range(100):
        rng, states, actions = np.random.default_rng(seed), 2 + seed % 2, 2 + seed % 3 // 2
        mdp = random_mdp(seed, states, actions, num_terminal=seed % 2)
        logits = rng.normal(size=(states, actions))
        worst = max(worst, np.abs(policy_gradient(mdp, logits, 4) - finite_difference(return_of(mdp, 4), logits)).max())
        if seed < 10:
            difference = policy_gradient(mdp, logits) - finite_difference(return_of(mdp), logits)
            endless = max(endless, np.abs(difference).max())
            logits = rng.normal(size=(3, states, actions))
            difference = policy_gradient(mdp, logits, 3) - finite_difference(return_of(mdp, 3), logits)
            varying = max(varying, np.abs(difference).max())
    with item("3.3") as check:
        check(worst, "<=", 1e-8, "against differences of J, 100 MDPs, 4 steps")
        check(endless, "<=", 1e-8, "without a horizon, 10 MDPs")
        check(varying, "<=", 1e-8, "logits that vary with time, 10 MDPs")


def test_initial_states_and_dynamics_cancel(item):
    """The same trajectories under two dynamics: log p(τ) differs, its gradient does not, and is the sum of scores."""
    mdp, logits = small().mdp, small().logits
    every, _ = enumerate_observed(mdp, softmax_policy(logits))
    dynamics = [mdp, random_mdp(7, 2, 2, horizon=3)]
    states, actions = np.asarray(every.observations), np.asarray(every.actions)

    def log_density(theta, process):
        log_pi = jax.nn.log_softmax(theta, -1)[states[:, :-1], actions].sum(-1)
        moves = jnp.log(jnp.asarray(process.transitions))[states[:, :-1], actions, states[:, 1:]].sum(-1)
        return jnp.log(jnp.asarray(process.initial))[states[:, 0]] + moves + log_pi

    with jax.enable_x64(True):
        both = [np.asarray(jax.jacobian(log_density)(jnp.asarray(logits), process)) for process in dynamics]
        values = [np.asarray(log_density(jnp.asarray(logits), process)) for process in dynamics]
    with item("3.4") as check:
        check(np.abs(values[0] - values[1]).min(), ">", 0, "log p(τ) depends on the dynamics")
        check(np.abs(both[0] - both[1]).max(), "==", 0, "its gradient does not")
        check(np.abs(both[0] - gradient_samples(logits, every)).max(), "<=", 1e-12, "and is the sum of the scores")
        other = trajectory_log_prob(dynamics[1], softmax_policy(logits), states, actions)
        check(np.abs(values[1] - other).max(), "<=", 1e-12, "the density is that of item 1.14")


def test_policy_gradient_is_weighted_maximum_likelihood(item):
    mdp, logits = small().mdp, small().logits
    rng = np.random.default_rng(0)
    one = MDP(mdp.transitions, np.full((2, 2), 0.25), mdp.initial, horizon=4)
    every, _ = enumerate_observed(one, softmax_policy(logits))
    likelihood = gradient_samples(logits, every).mean(0)
    with item("3.11") as check:
        difference = gradient_samples(logits, every, total_returns(every)).mean(0) - likelihood
        check(np.abs(difference).max(), "==", 0, "r(τ) = 1: bit for bit the gradient of the likelihood")
        success = rng.integers(2, size=len(every.actions)).astype(float)
        weighted = gradient_samples(logits, every, np.repeat(success[:, None], 4, 1)).mean(0)
        chosen = jax.tree.map(lambda x: np.asarray(x)[success == 1], every)
        cloned = gradient_samples(logits, chosen).sum(0) / len(success)
        check(np.abs(weighted - cloned).max(), "<=", 1e-15, "r in {0, 1}: behavioural cloning of the successes")


def arms(rewards):
    """One state, one action to take: each trajectory is one arm."""
    return MDP(np.ones((1, len(rewards), 1)), np.array([rewards]), horizon=1)


def change_of_log_prob(mdp, logits, step):
    states, actions = np.zeros((3, 2), int), np.arange(3)[:, None]
    old, new = (softmax_policy(table) for table in (logits, logits + step))
    return trajectory_log_prob(mdp, new, states, actions) - trajectory_log_prob(mdp, old, states, actions)


def test_more_rewarding_trajectories_become_more_probable(item):
    rewards = [1.0, 0.3, -0.8]
    mdp, logits = arms(rewards), np.zeros((1, 3))
    change = change_of_log_prob(mdp, logits, 0.5 * policy_gradient(mdp, logits))
    with item("3.12") as check:
        check((np.argsort(change) != np.argsort(rewards)).sum(), "==", 0, "Δ log p(τ) in the order of the rewards")
        check(change[0], ">", 0, "the best becomes more probable")
        check(change[2], "<", 0, "the worst becomes less probable")
        closed = np.log(np.exp(np.array(rewards) / 6)) - np.log(np.exp(np.array(rewards) / 6).mean())
        check(np.abs(change - closed).max(), "<=", 1e-12, "as computed by hand: logits move by α (r - mean r) / 3")


def test_an_offset_of_the_rewards_changes_what_one_step_does(item):
    """Each of three trajectories once, the third one bad and rare. The mean step does not change, this one does."""
    logits = np.log([[0.4, 0.4, 0.2]])
    changes, hand = [], []
    for k in (0.0, 1.0, 100.0):
        rewards = np.array([1.0, 1.2, -1.0]) + k
        every, _ = enumerate_observed(arms(rewards), softmax_policy(logits))
        step = 1e-3 * gradient_samples(logits, every, total_returns(every)).mean(0)
        changes.append(change_of_log_prob(arms(rewards), logits, step)[2])
        moved = np.exp(logits[0] + 1e-3 * (rewards / 3 - np.exp(logits[0]) * rewards.mean()))
        hand.append(np.log(moved[2] / moved.sum() / 0.2))
    exact = [policy_gradient(arms(np.array([1.0, 1.2, -1.0]) + k), logits) for k in (0.0, 100.0)]
    with item("3.17") as check:
        check(changes[0], "<", 0, "no offset: the bad trajectory becomes less probable")
        check(changes[1] - changes[0], ">", 0, "offset 1: it falls less")
        check(changes[2], ">", 0, "offset 100: it becomes more probable")
        check(np.abs(np.subtract(changes, hand)).max(), "<=", 1e-12, "as computed by hand")
        check(np.abs(exact[0] - exact[1]).max(), "<=", 1e-12, "the exact gradient does not change")


def test_the_two_discounts(item):
    problem = small(0.8)
    gradient = finite_difference(return_of(problem.mdp), problem.logits)
    powers = 0.8 ** np.arange(3)
    lines = [
        lambda τ: np.repeat((powers * τ.rewards).sum(-1, keepdims=True), 3, 1),
        lambda τ: np.flip(np.cumsum(np.flip(powers * τ.rewards, 1), 1), 1),
        lambda τ: powers * rewards_to_go(τ, 0.8),
    ]
    printed = [estimator_moments(problem.mdp, problem.logits, line).mean for line in lines]
    with item("4.19") as check:
        check(np.abs(policy_gradient(problem.mdp, problem.logits) - gradient).max(), "<=", 1e-10, "option 2 is ∇J_γ")
        check(max(np.abs(p - gradient).max() for p in printed), "<=", 1e-10, "the three printed lines, in expectation")
    one = policy_gradient(problem.mdp, problem.logits, discounting="option_1")
    sampled = estimator_moments(problem.mdp, problem.logits, lambda τ: rewards_to_go(τ, 0.8)).mean
    with item("4.18") as check:
        check(np.abs(sampled - one).max(), "<=", 1e-10, "Σ_t E_{d_t}[∇π Q_γ] with undiscounted d_t")
        check(abs(np.abs(one - gradient).max() - 0.06804851), "<=", 1e-7, "distance from ∇J_γ, .068 (E4.6)")
    ends = random_mdp(3, 4, 2, num_terminal=1, discount=0.8)
    logits = np.random.default_rng(3).normal(size=(4, 2))
    endless, long = (policy_gradient(ends, logits, horizon, "option_1") for horizon in (None, 200))
    with item("4.18") as check:
        check(np.abs(endless - long).max(), "<=", 1e-10, "without a horizon against 200 steps")
    with pytest.raises(ValueError, match="undiscounted visits"):
        policy_gradient(random_mdp(0, 3, 2), np.zeros((3, 2)), discounting="option_1")


def look_alike():
    """Now 1 for action 0; two steps later, in a state that looks the same, 2 for action 1."""
    transitions = np.zeros((3, 2, 3))
    transitions[0, :, 1] = transitions[1, :, 2] = transitions[2, :, 2] = 1
    mdp = MDP(transitions, [[1.0, 0.0], [0.0, 0.0], [0.0, 2.0]], discount=0.5, horizon=3)
    return POMDP(mdp, np.eye(2)[[0, 1, 0]])


def test_option_1_need_not_lead_to_the_best_discounted_return(item):
    problem, found = look_alike(), {}
    full = POMDP(MDP(problem.mdp.transitions, problem.mdp.rewards, horizon=3), problem.emissions)
    for option in ("option_1", "option_2"):
        logits = np.zeros((2, 2))
        for _ in range(150):
            logits = logits + 20 * policy_gradient(problem, logits, discounting=option)
        found[option] = policy_return(problem, logits).value, policy_return(full, logits).value
    with item("4.20") as check:
        check(abs(found["option_1"][0] - 0.5), "<=", 0.01, "option 1: discounted J is 0.5 ...")
        check(abs(found["option_2"][0] - 1.0), "<=", 0.01, "... where option 2 has 1")
        check(abs(found["option_1"][1] - 2.0), "<=", 0.01, "option 1: undiscounted J is 2 ...")
        check(abs(found["option_2"][1] - 1.0), "<=", 0.01, "... where option 2 has 1")


def test_option_1_is_the_gradient_of_nothing(item):
    """A gradient field has a symmetric derivative (erratum E4.6)."""
    problem, skew = small(0.8), {}
    for option in ("option_1", "option_2"):
        field = lambda t, option=option: policy_gradient(problem.mdp, t, discounting=option).ravel()  # noqa: E731
        derivative = finite_difference(field, problem.logits).reshape(4, 4)
        skew[option] = np.abs(derivative - derivative.T).max()
    with item("4.20") as check:
        check(skew["option_2"], "<=", 1e-9, "option 2: asymmetry of the derivative")
        check(skew["option_1"], ">", 1e-3, "option 1: asymmetry of the derivative")


def test_fisher_matrix(item):
    problem = small()
    policy = softmax_policy(problem.logits)
    found = fisher_matrix(problem.mdp, problem.logits)
    every, log_probs = enumerate_observed(problem.mdp, policy)
    whole = gradient_samples(problem.logits, every).reshape(len(log_probs), -1)
    with item("3.40") as check:
        enumerated = np.einsum("n,ni,nj->ij", np.exp(log_probs), whole, whole) / 3
        check(np.abs(found - enumerated).max(), "<=", 1e-10, "steps against scores of whole trajectories, per step")
        visits = state_visits(problem.mdp, policy).sum(0) / 3
        block = np.diag(policy[1]) - np.outer(policy[1], policy[1])
        check(np.abs(found[2:, 2:] - visits[1] * block).max(), "<=", 1e-15, "diag(p) - p p^T in each state")

        def divergence(logits):
            return (visits[:, None] * policy * np.log(policy / softmax_policy(logits))).sum()

        slope = lambda t: finite_difference(divergence, t, 1e-4).ravel()  # noqa: E731
        hessian = finite_difference(slope, problem.logits, 1e-4).reshape(4, 4)
        check(np.abs(hessian - found).max(), "<=", 1e-5, "second differences of the mean KL")
    assert np.allclose(fisher_matrix(random_mdp(0, 3, 2), np.zeros((3, 2))).sum(), 0, atol=1e-15)


def test_expected_gradient_takes_any_visits():
    problem = small()
    visits, values = np.random.default_rng(0).random((3, 2)), np.random.default_rng(1).normal(size=(3, 2, 2))
    by_hand = np.einsum(
        "ts,sa,sab,tsa->sb", visits, softmax_policy(problem.logits), score_table(problem.logits), values
    )
    assert np.allclose(expected_gradient(problem.logits, visits, values), by_hand, atol=1e-14)
    assert expected_return(problem.mdp, softmax_policy(problem.logits)) == pytest.approx(0.4215997863)
    with pytest.raises(ValueError, match="vary over 2 steps"):
        every, _ = enumerate_observed(problem.mdp, softmax_policy(problem.logits))
        gradient_samples(np.zeros((2, 2, 2)), every)
    assert moments(np.arange(4.0)).variance == pytest.approx(5 / 3)
