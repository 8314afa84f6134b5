"""Policy evaluation: regression on reward sums and on bootstrapped targets, and tables that learn step by step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.actor_critic.tabular_values import (
    learn_n_step,
    learn_td_lambda,
    monte_carlo_values,
    normal_equations,
    td_fixed_point,
    td_values,
)
from rewardtogo.actor_critic.value_fitting import ValueNetwork, ValueTable, fit_value, value_targets
from rewardtogo.core import Spec, Transition
from rewardtogo.envs.tabular import TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp, random_policy, random_walk
from rewardtogo.exact import TablePolicy, Trajectories, simulate, v_values
from rewardtogo.exact.targets import n_step_return_moments
from rewardtogo.nn import GRU, MLP, Optimiser

WALK, UNIFORM = random_walk(), np.full((21, 2), 0.5)
STATES = slice(1, -1)
TRUE = v_values(WALK, UNIFORM)
RATES = np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0])
RUNS = 60


@pytest.fixture(scope="module")
def walks():
    """60 learners' first 10 episodes."""
    policy = TablePolicy(jnp.asarray(UNIFORM, jnp.float32))
    return jax.tree.map(np.asarray, simulate(TabularEnv(WALK), policy, jax.random.key(0), 10 * RUNS, 700))


def rmse(tables):
    """Over the 19 states."""
    return np.sqrt(((tables - TRUE)[..., STATES] ** 2).mean(-1))


def steps(observation, reward, terminated, next_observation):
    """`[T, B]` transitions without actions."""
    arrays = (observation, jnp.zeros(reward.shape, jnp.int32), reward, terminated, jnp.zeros(reward.shape, bool))
    return Transition(*map(jnp.asarray, (*arrays, next_observation)), {})


def linear(size):
    """V of one dense layer, in float64."""
    spec = Spec("box", (size,), low=(-np.inf,), high=(np.inf,))
    return jax.tree.map(lambda x: x.astype(jnp.float64), ValueNetwork.of(MLP(), spec, jax.random.key(0)))


def test_the_random_walk():
    assert np.abs(TRUE[STATES] - (np.arange(1, 20) / 10 - 1)).max() <= 1e-14
    assert random_walk(4).num_states == 6 and random_walk(1).initial[1] == 1
    with pytest.raises(ValueError, match="nowhere to start"):
        random_walk(0)


def test_regression_on_reward_sums_is_the_normal_equations(item):
    rng, (length, number, size) = np.random.default_rng(0), (12, 8, 3)
    # Networks read observations as float32, so let them be such numbers.
    seen = rng.normal(size=(length + 1, number, size)).astype(np.float32).astype(np.float64)
    reward = rng.normal(size=(length, number))
    terminated = (rng.random((length, number)) < 0.15) | (np.arange(length)[:, None] == length - 1)
    sums, ahead = np.zeros((length, number)), np.zeros(number)
    for t in reversed(range(length)):
        sums[t] = ahead = reward[t] + 0.9 * np.where(terminated[t], 0, ahead)
    features = np.concatenate([seen[:-1], np.ones((length, number, 1))], -1).reshape(-1, size + 1)
    exact = np.linalg.solve(features.T @ features, features.T @ sums.ravel())
    with jax.enable_x64(True):
        data = steps(seen[:-1], reward, terminated, seen[1:])
        plain = Optimiser(0.5, 1e9, rule="sgd")
        found, losses = fit_value(linear(size), data, gamma=0.9, updates=500, optimiser=plain)
        weights = np.append(np.asarray(found.head.weight)[0], np.asarray(found.head.bias)[0])
        targets = np.asarray(value_targets(found, data, 0.9, 1.0))
    with item("4.12") as check:
        check(np.abs(targets - sums).max(), "<=", 1e-12, "targets against the reward sums, over i and t")
        check(np.abs(weights - exact).max(), "<=", 1e-8, "gradient descent against the normal equations")
        check(np.abs(normal_equations(features, sums.ravel()) - exact).max(), "<=", 1e-12, "`normal_equations`, too")
    assert losses.shape == (1,)


def test_a_table_fitted_to_reward_sums_is_their_mean(item, walks):
    seen, sums, taken = walks.observations[:, :-1], np.zeros(walks.rewards.shape), walks.taken
    sums[:] = walks.rewards.sum(-1, keepdims=True)  # The only reward is the last one.
    means = [sums[taken & (seen == s)].mean() for s in range(1, 20)]
    with item("4.12") as check:
        error = np.abs(monte_carlo_values(walks, np.eye(21))[STATES] - means).max()
        check(error, "<=", 1e-8, "one feature for each state: mean of the reward sums from there")


def every_outcome(mdp, policy):
    """All (s, a, s') in a row, as a batch of single steps, and p(a, s' | s)."""
    joint = policy[..., None] * mdp.transitions * ~mdp.terminal[:, None, None]
    s, a, after = np.nonzero(joint)
    return steps(s[None], mdp.rewards[s, a][None], mdp.terminal[after][None], after[None]), joint[s, a, after]


@jax.jit
def targets_and_slope(value, data):
    """Bootstrapped targets, and the gradient of their sum with respect to V."""
    targets = value_targets(value, data, 0.9, 0.0)
    return targets[0], jax.grad(lambda value: value_targets(value, data, 0.9, 0.0).sum())(value).values


def test_bootstrapped_targets(item):
    bias, ended, slope, ratios = 0.0, 0.0, 0.0, ([], [])
    for seed in range(20):
        mdp, policy, c = random_mdp(seed, 4, 2, num_terminal=seed % 2), random_policy(seed, 4, 2), 0.7
        v, live = v_values(mdp, policy), ~mdp.terminal
        with jax.enable_x64(True):
            data, chance = every_outcome(mdp, policy)
            value = ValueTable(jnp.asarray(v + c * live))
            y, pull = map(np.asarray, targets_and_slope(value, data))
        slope, s = max(slope, np.abs(pull).max()), np.asarray(data.observation)[0]
        mean, square = np.bincount(s, chance * y, 4), np.bincount(s, chance * y**2, 4)
        goes_on = np.einsum("sa,sax,x->s", policy, mdp.transitions, live * 1.0)
        error = np.abs((mean - v - 0.9 * c * goes_on)[live]).max()
        bias, ended = (max(bias, error), ended) if live.all() else (bias, max(ended, error))
        sums = n_step_return_moments(mdp, policy, v, 400)
        monte_carlo = (policy * (sums.variance + sums.mean**2)).sum(-1) - v**2
        ratios[seed % 2].append(((square - mean**2) / np.where(live, monte_carlo, np.inf)).max())
    with item("4.13") as check:
        check(bias, "<=", 1e-12, "V = V^pi + c: mean of the target less V^pi less gamma c, every state, 10 MDPs")
        check(ended, "<=", 1e-12, "the same with ends: less gamma c times the chance to go on")
        check(max(ratios[0]), "<", 1, "variance of the target over that of the reward sum, at most, 10 MDPs")
        check(max(ratios[1]), ">", 1, "with ends, where V is right whatever c is, it is no law")
        check(slope, "==", 0, "gradient through the target")


def test_bootstrapped_regression_ends_at_its_fixed_point(item):
    mdp, policy = random_mdp(3, 4, 2), random_policy(3, 4, 2)
    with jax.enable_x64(True):
        data, chance = every_outcome(mdp, policy)
        # Rewards and next states of a batch in which each outcome is as frequent as it should be, up to 1 / 500.
        times = np.maximum(np.round(500 * chance), 1).astype(int)
        data = jax.tree.map(lambda x: jnp.repeat(x, times, axis=1), data)
        plain = Optimiser(1.0, 1e9, rule="sgd")
        found, _ = fit_value(
            ValueTable(jnp.zeros(4)), data, gamma=0.9, lambda_=0.0, rounds=400, updates=4, optimiser=plain
        )
        found, eye = np.asarray(found.values), np.eye(4)
        now, after, reward = (np.asarray(x)[0] for x in (data.observation, data.next_observation, data.reward))
    exact = td_fixed_point(eye[now], reward, np.full(len(now), 0.9), eye[after])
    with item("4.13") as check:
        check(np.abs(found - exact).max(), "<=", 1e-8, "rounds of regression against the TD fixed point of the data")
        check(np.abs(exact - v_values(mdp, policy)).max(), "<=", 0.05, "the fixed point against V^pi, counts rounded")


def test_td_is_better_than_monte_carlo_in_the_random_walk(item, walks):
    batch = {10: [], 3: []}
    for number, errors in batch.items():
        for run in range(RUNS):
            some = jax.tree.map(lambda x, run=run, number=number: x[10 * run : 10 * run + number], walks)
            errors.append([rmse(f(some, np.eye(21))) for f in (td_values, monte_carlo_values)])
    online = {n: rmse(learn_n_step(walks, 21, n, RATES, runs=RUNS)).mean((0, 1)).min() for n in (1, 2, 4, 700)}
    with item("4.14") as check:
        for number, errors in batch.items():
            td, monte_carlo = np.mean(errors, 0)
            check(td, "<", monte_carlo, f"RMSE of a table fitted to {number} walks: TD, Monte Carlo (60 runs)")
        for n in (1, 2, 4):
            check(online[n], "<", online[700], f"RMSE over 10 walks learned online, best alpha: n = {n}, Monte Carlo")


def test_a_few_steps_are_best(item, walks):
    sizes = (1, 2, 4, 8, 16, 32, 64, 128, 256)
    best = [rmse(learn_n_step(walks, 21, n, RATES, runs=RUNS)).mean((0, 1)).min() for n in sizes]
    least = int(np.argmin(best))
    with item("4.32") as check:
        check(sizes[least], ">=", 2, "best n, 19-state walk, 10 episodes, best alpha for each n")
        check(sizes[least], "<=", 16, "best n")
        check(np.diff(best[: least + 1]).max(), "<", 0, "U-shaped: falls up to the best n")
        check(np.diff(best[least:]).min(), ">", 0, "U-shaped: rises after it")
        check(abs(best[0] - 0.34), "<=", 0.02, "RMSE of n = 1 against the literature's")
        check(abs(best[2] - 0.26), "<=", 0.02, "RMSE of n = 4 against the literature's")


def one_learner(walks, episodes=2):
    return jax.tree.map(lambda x: x[:episodes], walks)


def test_tables_learn_as_the_updates_say(walks):
    few, table, traced = one_learner(walks), np.zeros(21), np.zeros(21)
    n, alpha, lambda_ = 3, 0.4, 0.7
    for i in range(2):
        seen, rewards, end = few.observations[i], few.rewards[i], int(few.lengths[i])
        for now in range(end + n - 1):  # Sutton and Barto's loop: update the state of n - 1 steps ago.
            t = now - n + 1
            if t >= 0:
                target = rewards[t : min(t + n, end)].sum() + (table[seen[t + n]] if t + n < end else 0)
                table[seen[t]] += alpha * (target - table[seen[t]])
        trace = np.zeros(21)
        for t in range(end):
            trace = lambda_ * trace + np.eye(21)[seen[t]]
            ahead = traced[seen[t + 1]] if t + 1 < end else 0
            traced = traced + alpha * (rewards[t] + ahead - traced[seen[t]]) * trace
    assert np.abs(learn_n_step(few, 21, n, np.array([alpha]))[0, -1, 0] - table).max() <= 1e-14
    assert np.abs(learn_td_lambda(few, 21, lambda_, np.array([alpha]))[0, -1, 0] - traced).max() <= 1e-14
    one, zero = learn_n_step(few, 21, 1, RATES), learn_td_lambda(few, 21, 0.0, RATES)
    assert np.abs(one - zero).max() <= 1e-14
    with pytest.raises(ValueError, match="in equal numbers"):
        learn_n_step(few, 21, 1, RATES, runs=3)


def test_truncated_episodes_bootstrap():
    """Two steps in a loop of reward 1, cut: the last update looks at V of where it was cut."""
    loop = Trajectories(np.zeros((1, 3), int), np.zeros((1, 2), int), np.ones((1, 2)), np.array([2]), np.array([False]),
                        np.array([True]), {})  # fmt: skip
    assert learn_n_step(loop, 1, 2, np.ones(1), discount=0.5)[0, 0, 0, 0] == 1.75  # 1 + .5, then 1 + .5 * 1.5
    assert learn_td_lambda(loop, 1, 0.0, np.ones(1), discount=0.5)[0, 0, 0, 0] == 1.5
    assert td_values(loop, np.eye(1), 0.5)[0] == pytest.approx(2, abs=1e-12)
    with pytest.raises(ValueError, match="lower the discount"):
        td_values(loop, np.eye(1))


def test_generalising_lowers_the_variance(item):
    """One walk from each state. A table keeps each return as it is; a fitted V compares what is near."""
    rng, start = np.random.default_rng(0), np.tile(np.arange(1, 20), 200)
    places = start[:, None] + rng.choice(np.array([-1, 1], np.int16), (len(start), 2500)).cumsum(-1, dtype=np.int16)
    out = (places <= 0) | (places >= 20)
    assert out.any(-1).all()
    returns = np.where(places[np.arange(len(start)), out.argmax(-1)] >= 20, 1.0, -1.0).reshape(200, 19)
    near = np.exp(-0.5 * ((np.arange(1, 20)[:, None] - np.linspace(1, 19, 5)) / 4) ** 2)
    squares = lambda found: ((found - TRUE[STATES]) ** 2).mean()  # noqa: E731
    fitted = np.mean([squares(near @ normal_equations(near, y)) for y in returns])
    with item("4.11") as check:
        check(fitted, "<", 0.5 * squares(returns), "MSE to V: five bumps fitted to the samples; half of a table's MSE")
        check(squares(returns), ">", 0.5, "MSE to V of single samples in a table: about 1 - V^2")


def test_the_loop_of_reward_1(item):
    gamma, states = 0.9, np.arange(3)
    ring = (states[None], np.ones((1, 3)), np.zeros((1, 3), bool), (states[None] + 1) % 3)
    with jax.enable_x64(True):
        found, _ = fit_value(ValueTable(jnp.zeros(3)), steps(*ring), gamma=gamma, lambda_=0.0, rounds=250, updates=1,
                             optimiser=Optimiser(3.0, 1e9, rule="sgd"))  # fmt: skip
        table = np.asarray(found.values)
        end = value_targets(found, steps(ring[0], ring[1], np.ones((1, 3), bool), ring[3]), gamma, 0.0)
    places = np.random.default_rng(0).normal(size=(3, 2)).astype(np.float32)
    seen = (places[ring[0]], ring[1].astype(np.float32), ring[2], places[ring[3]])
    network = ValueNetwork.of(MLP(16), Spec("box", (2,), low=(-np.inf,), high=(np.inf,)), jax.random.key(1))
    fitted, losses = fit_value(network, steps(*seen), gamma=gamma, lambda_=0.0, rounds=300, updates=10,
                               optimiser=Optimiser(1e-2, 10.0))  # fmt: skip
    values = np.array([fitted(jnp.asarray(x)) for x in places])
    exact = td_fixed_point(np.eye(3), np.ones(3), np.full(3, gamma), np.eye(3)[[1, 2, 0]])
    with item("4.17") as check:
        check(np.abs(table - 10).max(), "<=", 1e-8, "a table, after 250 rounds: V - 1 / (1 - gamma)")
        check(np.abs(exact - 10).max(), "<=", 1e-8, "its fixed point")
        check(np.abs(np.asarray(end) - 1).max(), "==", 0, "terminated: the target is r")
        check(10 * np.abs(values - 10).max(), "<=", 1, "a network: per cent off 1 / (1 - gamma)")
    assert losses.shape == (300,)


def test_value_networks_refuse_what_they_cannot_do():
    spec = Spec("box", (2,), low=(-np.inf,), high=(np.inf,))
    with pytest.raises(ValueError, match="reads single observations"):
        ValueNetwork.of(GRU(4), spec, jax.random.key(0))
    data = steps(np.zeros((1, 1), int), np.ones((1, 1), np.float32), np.zeros((1, 1), bool), np.zeros((1, 1), int))
    with pytest.raises(ValueError, match="at least 1 of each"):
        fit_value(ValueTable(jnp.zeros(1)), data, gamma=0.9, updates=0)
