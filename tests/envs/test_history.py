"""Histories as observations: what they show, and that they make a process Markov again."""

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.history import DiscreteHistory, History
from rewardtogo.envs.tabular import MDP, POMDP, TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.exact import TablePolicy, markov_test, simulate


def second_order():
    """What is seen next depends on the last two observations and the action: hidden states are pairs of them."""
    chance = np.random.default_rng(3).dirichlet(np.full(2, 0.5), (2, 2, 2))
    transitions = np.zeros((4, 2, 4))
    for before, now, action, after in np.ndindex(2, 2, 2, 2):
        transitions[2 * before + now, action, 2 * now + after] = chance[before, now, action, after]
    return POMDP(MDP(transitions, np.zeros((4, 2)), np.full(4, 0.25), 0.9), np.eye(2)[[0, 1, 0, 1]])


def observed(env, size):
    policy = TablePolicy(jnp.full((size, 2), 0.5))
    batch = simulate(env, policy, jax.random.key(0), 600, 40)
    return markov_test(batch.observations, batch.actions, batch.lengths)


def test_a_window_makes_the_process_markov(item):
    env = TabularEnv(second_order())
    window = DiscreteHistory(env, 2)
    with item("3.14") as check:
        rejected = observed(env, 2)
        check(
            rejected.p_value, "<", 1e-6, f"one observation, χ² {rejected.statistic:.0f}/{rejected.degrees_of_freedom}"
        )
        accepted = observed(window, int(window.observation_space.n))
        check(accepted.p_value, ">", 0.01, f"window of 2, χ² {accepted.statistic:.0f}/{accepted.degrees_of_freedom}")


def unroll(env, length):
    """Observations and actions of one episode."""
    step = jax.jit(lambda *given: env.step(*given))
    state, observation = jax.jit(lambda key: env.reset(key))(jax.random.key(1))
    seen, actions = [np.asarray(observation)], []
    for t in range(length):
        action = jax.random.randint(jax.random.key(t), (), 0, 2)
        state, timestep = step(state, action, jax.random.key(100 + t))
        assert np.array_equal(timestep.observation, timestep.final_observation)
        seen.append(np.asarray(timestep.observation))
        actions.append(int(action))
    return seen, actions


@pytest.mark.parametrize("window", [1, 2, 3])
def test_codes_are_the_last_steps(item, window):
    env = TabularEnv(POMDP(random_mdp(0, 4, 2), np.eye(3)[[0, 1, 2, 2]]))
    plain, actions = unroll(env, 6)
    codes, same = unroll(DiscreteHistory(env, window), 6)
    wrong = int(same != actions)
    for t, code in enumerate(codes):
        digits, rest = [int(code) % 3], int(code) // 3
        for _ in range(window - 1):
            digits.append(rest % 7)
            rest //= 7
        past = [1 + actions[k] * 3 + int(plain[k]) if k >= 0 else 0 for k in range(t - 1, t - window, -1)]
        wrong += digits != [int(plain[t]), *past] or rest != 0 or code.dtype != np.int32
    with item("3.14") as check:
        check(wrong, "==", 0, f"codes that are not the last {window} steps, of 7")
        check(int(DiscreteHistory(env, window).observation_space.n), "==", 3 * 7 ** (window - 1), "number of histories")


@pytest.mark.parametrize("window", [1, 3])
def test_vectors_are_the_last_steps(item, window):
    env = CartPole()
    plain, actions = unroll(env, 5)
    vectors, _ = unroll(History(env, window), 5)
    space, worst = History(env, window).observation_space, 0.0
    for t, vector in enumerate(vectors):
        parts = [plain[t]]
        for k in range(t - 1, t - window, -1):
            parts.insert(0, np.concatenate([[1], plain[k], np.eye(2)[actions[k]]]) if k >= 0 else np.zeros(7))
        worst = max(worst, np.abs(vector - np.concatenate(parts)).max())
        assert space.contains(vector)
    with item("3.14") as check:
        check(worst, "==", 0, f"vectors that are not the last {window} steps")


def test_discrete_observations_become_one_hot_vectors():
    env = TabularEnv(random_mdp(0, 3, 2))
    vectors, _ = unroll(History(env, 2), 2)
    assert vectors[0].tolist()[:6] == [0] * 6 and vectors[0][6:].sum() == 1
    assert vectors[2][0] == 1 and vectors[2].sum() == 4 and vectors[2].shape == (9,)


def test_histories_do_not_reach_into_the_episode_before():
    env = DiscreteHistory(TabularEnv(random_mdp(0, 3, 2, horizon=2)), 3)
    batch = vectorize(env, 4)
    state, first = batch.reset(jax.random.split(jax.random.key(0), 4))
    for t in range(2):
        state, timestep = batch.step(state, jnp.zeros(4, jnp.int32), jax.random.split(jax.random.key(t), 4))
    assert timestep.terminated.all() and (first < 3).all()
    assert (timestep.observation < 3).all() and (timestep.final_observation >= 3).all()


def test_what_cannot_be_counted_is_refused():
    env = TabularEnv(random_mdp(0, 3, 2))
    with pytest.raises(ValueError, match="at least 1"):
        DiscreteHistory(env, 0)
    with pytest.raises(ValueError, match="use History"):
        DiscreteHistory(CartPole(), 2)
    with pytest.raises(ValueError, match="more than an int32"):
        DiscreteHistory(env, 20)
    assert isinstance(History(env, 2).action_space, spaces.Discrete)
