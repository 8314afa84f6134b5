import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.envs.tabular import MDP, TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import TablePolicy, monte_carlo_return, q_values, simulate, v_values
from rewardtogo.exact.observed import enumerate_observed
from rewardtogo.exact.signals import n_step_returns, rewards_to_go, td_errors, values_at
from rewardtogo.exact.targets import ResumeAt, advantage_values, n_step_return_moments, q_from_v, rollout_value


def test_advantages(item):
    mean, order = 0.0, 0
    for seed in range(40):
        mdp, policy = random_mdp(seed, 4, 3, num_terminal=seed % 2), random_policy(seed, 4, 3)
        for horizon in (None, 4):
            a, q = advantage_values(mdp, policy, horizon), q_values(mdp, policy, horizon)
            mean = max(mean, np.abs((policy * a).sum(-1)).max())
            order += (a.argmax(-1) != q.argmax(-1))[..., ~np.asarray(mdp.terminal)].sum()
    with item("4.4") as check:
        check(mean, "<=", 1e-12, "Σ_a π A, 40 MDPs, with and without a horizon")
        check(order, "==", 0, "states where A and Q have another best action")


def test_q_from_v(item):
    worst = 0.0
    for seed in range(40):
        mdp, policy = random_mdp(seed, 4, 3, num_terminal=seed % 2), random_policy(seed, 4, 3)
        for horizon in (None, 4):
            v = v_values(mdp, policy, horizon)
            v = np.where(np.asarray(mdp.terminal), 1e6, v) if seed % 2 else v  # of no account
            worst = max(worst, np.abs(q_from_v(mdp, v) - q_values(mdp, policy, horizon)).max())
    with item("4.5") as check:
        check(worst, "<=", 1e-12, "r + γ P V against Q, 40 MDPs, with and without a horizon")


MDP4 = random_mdp(11, 4, 2, num_terminal=1, horizon=4, discount=0.8)
TABLE = random_policy(12, 4, 2)
V, Q = v_values(MDP4, TABLE), q_values(MDP4, TABLE)


@pytest.fixture(scope="module")
def sampled():
    policy = TablePolicy(jnp.asarray(TABLE, jnp.float32))
    return simulate(TabularEnv(MDP4), policy, jax.random.key(0), 100_000, 4)


def worst_z(samples, expected, groups):
    """The farthest mean from what it should be, in standard errors, over groups of at least 100.

    Rewards are sampled in float32, whose rounding is all there is where nothing is random.
    """
    found = []
    for group in np.unique(groups):
        x = (samples - expected)[groups == group]
        if len(x) >= 100:
            found.append(abs(x.mean()) / max(x.std(ddof=1) / np.sqrt(len(x)), 1e-7))
    assert len(found) > 5
    return max(found)


def test_single_samples_are_unbiased(item, sampled):
    seen, actions = np.asarray(sampled.observations)[:, :-1], np.asarray(sampled.actions)
    taken, time = np.asarray(sampled.taken), np.broadcast_to(np.arange(4), (*seen.shape[:1], 4))
    by_pair, by_state = (time * 8 + seen * 2 + actions)[taken], (time * 4 + seen)[taken]
    target = n_step_returns(sampled, V, 1, 0.8)[taken]
    exact = Q[time, seen, actions][taken]
    with item("4.5") as check:
        check(worst_z(target, exact, by_pair), "<=", 4, "r + γ V(s'), one s': standard errors from Q(s, a), each t")
    with item("4.9") as check:
        found = worst_z(rewards_to_go(sampled, 0.8)[taken], values_at(sampled, V)[taken], by_state)
        check(found, "<=", 4, "reward to go of single rollouts: standard errors from V_t(s)")


def test_one_sample_advantages(item):
    every, log_probs = enumerate_observed(MDP4, TABLE)
    delta, chance = td_errors(every, V, 0.8), np.exp(log_probs)
    seen, actions, taken = np.asarray(every.observations)[:, :-1], np.asarray(every.actions), np.asarray(every.taken)
    exact, worst = advantage_values(MDP4, TABLE), 0.0
    for t, s, a in np.ndindex(4, 3, 2):
        chosen = (seen[:, t] == s) & (actions[:, t] == a) & taken[:, t]
        worst = max(worst, abs(chance[chosen] @ delta[chosen, t] / chance[chosen].sum() - exact[t, s, a]))
    with item("4.6") as check:
        check(worst, "<=", 1e-12, "E[δ | s, a] against A(s, a) by enumeration, each t")


def test_values_by_setting_the_simulator_back(item):
    env, policy = TabularEnv(MDP4), TablePolicy(jnp.asarray(TABLE, jnp.float32))
    state, observation = env.reset(jax.random.key(5))
    state, timestep = env.step(state, jnp.asarray(0), jax.random.key(6))
    observation = timestep.observation
    assert not timestep.terminated
    exact = V[1, int(observation)]

    def repeated(number, seed):
        keys = jax.random.split(jax.random.key(seed), 4000)
        values = jax.vmap(lambda k: rollout_value(env, state, observation, policy, k, number, 4, 0.8).mean)(keys)
        return np.asarray(values, np.float64)

    one, eight = repeated(1, 0), repeated(8, 1)
    many = rollout_value(env, state, observation, policy, jax.random.key(2), 4000, 4, 0.8)
    with item("4.10") as check:
        ratio = 8 * eight.var(ddof=1) / one.var(ddof=1)
        check(abs(100 * (ratio - 1)), "<=", 10, "per cent: variance of 8 rollouts against 1/8 of one's")
        check(abs(float(many.mean) - exact) / float(many.standard_error), "<=", 4, "standard errors from V_1(s)")
        same = monte_carlo_return(ResumeAt(env, state, observation), policy, jax.random.key(2), 4000, 4, 0.8)
        check(abs(float(same.mean - many.mean)), "==", 0, "the saved state can be used again")


def test_bias_and_variance_of_n_steps(item):
    mdp, policy = random_mdp(2, 5, 2, discount=0.9), random_policy(2, 5, 2)
    q, v = q_values(mdp, policy), v_values(mdp, policy)
    noise = np.random.default_rng(0).normal(size=5)
    shifted = [n_step_return_moments(mdp, policy, v + 0.7, n) for n in range(1, 16)]
    noisy = [n_step_return_moments(mdp, policy, v + noise, n) for n in range(1, 16)]
    scaled = np.array([np.abs(m.mean - q) / 0.9**n for n, m in enumerate(shifted, 1)])
    late = np.array([np.abs(m.mean - q).max() / 0.9**n for n, m in enumerate(noisy, 1)])[5:]
    growth = np.diff([m.variance for m in noisy], axis=0)
    exact = [n_step_return_moments(mdp, policy, v, n).mean for n in (1, 4)]
    with item("4.31") as check:
        check(np.abs(scaled / 0.7 - 1).max() * 100, "<=", 1, "per cent: V + c has the bias γ^n c")
        check(100 * (late.max() / late.min() - 1), "<=", 1, "per cent: V + noise, bias / γ^n from n = 6 on")
        check(
            np.abs(noisy[0].mean - q).max(), "<=", 0.9 * np.abs(noise).max(), "V + noise, n = 1: at most γ max|noise|"
        )
        check(growth.min(), ">=", 0, "variance of n + 1 steps less that of n, 1 <= n < 15, every (s, a)")
        check(np.abs(np.array(exact) - q).max(), "<=", 1e-12, "no bias with the true V")


def test_n_step_moments_by_enumeration(item):
    mdp = MDP(random_mdp(4, 3, 2, num_terminal=1).transitions, np.random.default_rng(0).normal(size=(3, 2, 3)), 0, 0.9,
              [False, False, True])  # fmt: skip
    policy, values, worst = random_policy(5, 3, 2), np.array([0.4, -1.0, 7.0]), 0.0
    every, log_probs = enumerate_observed(mdp, policy, 4)
    first = np.asarray(every.actions)[:, 0]
    for n in (1, 2, 3, 4):
        found, sums = n_step_return_moments(mdp, policy, values, n), n_step_returns(every, values, n, 0.9)[:, 0]
        for a in range(2):
            p = np.exp(log_probs[first == a])
            mean = p @ sums[first == a] / p.sum()
            variance = p @ (sums[first == a] - mean) ** 2 / p.sum()
            worst = max(worst, abs(found.mean[0, a] - mean), abs(found.variance[0, a] - variance))
    with item("4.31") as check:
        check(worst, "<=", 1e-12, "mean and variance against enumeration, r(s, a, s'), ends, n = 1..4")
    with pytest.raises(ValueError, match="no reward in it"):
        n_step_return_moments(mdp, policy, values, 0)
