"""Automatic reset: the true final observation, one key an environment, any B, the same numbers however it is run."""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import Environment, Timestep, VectorEnv, env_spec
from rewardtogo.envs.cartpole import ANGLE_LIMIT, X_LIMIT, CartPole
from rewardtogo.envs.probes import CountingEnv
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.vectorize import vectorize


class Dictionary(Environment):
    """Observes a dictionary, keeps a key in its state and ends at a random step."""

    @property
    def observation_space(self) -> spaces.Dict:
        return spaces.Dict({"draw": spaces.Box(0, 1, (2,), np.float32), "taken": spaces.Discrete(100)})

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key):
        state = (key, jnp.zeros((), jnp.int32))
        return state, self.show(state)

    def step(self, state, action, key):
        state = (state[0], state[1] + 1)
        ended, observation = jax.random.bernoulli(key, 0.3), self.show(state)
        return state, Timestep(observation, jnp.ones(()), ended, jnp.zeros((), bool), observation, {})

    def show(self, state):
        return {"draw": jax.random.uniform(state[0], (2,)), "taken": state[1]}


def roll(env: VectorEnv, length: int, key: jax.Array):
    """First observation and `length` steps of random actions, as one compiled scan."""

    @jax.jit
    def run(key):
        reset_key, action_key, step_key = jax.random.split(key, 3)
        actions = jax.random.randint(action_key, (length, env.num_envs), 0, 2)
        state, first = env.reset(jax.random.split(reset_key, env.num_envs))
        keys = jax.random.split(step_key, (length, env.num_envs))
        return first, jax.lax.scan(lambda s, x: env.step(s, *x), state, (actions, keys))[1]

    return run(key)


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("end", ["terminated", "truncated", "both"])
def test_final_observation_survives_the_reset(size, end, key):
    env = {
        "terminated": CountingEnv(3),
        "truncated": TimeLimit(CountingEnv(100), 3),
        "both": TimeLimit(CountingEnv(3), 3),
    }[end]
    first, steps = roll(vectorize(env, size), 7, key)
    column = lambda x: np.asarray(x).reshape(7, size).T  # noqa: E731
    np.testing.assert_array_equal(first, np.zeros((size, 1)))
    np.testing.assert_array_equal(column(steps.observation), [[1, 2, 0, 1, 2, 0, 1]] * size)
    np.testing.assert_array_equal(column(steps.final_observation), [[1, 2, 3, 1, 2, 3, 1]] * size)
    np.testing.assert_array_equal(column(steps.reward), [[1, 2, 3, 1, 2, 3, 1]] * size)
    ends = np.array([[0, 0, 1, 0, 0, 1, 0]] * size, bool)
    np.testing.assert_array_equal(column(steps.terminated), ends & (end != "truncated"))
    np.testing.assert_array_equal(column(steps.truncated), ends & (end != "terminated"))
    np.testing.assert_array_equal(column(steps.done), ends)


def test_time_limit_counts_anew_after_a_termination(key):
    _, steps = roll(vectorize(TimeLimit(CountingEnv(3), 4), 1), 12, key)
    assert not steps.truncated.any()
    assert steps.terminated.sum() == 4


def test_ends_at_different_times(key):
    first, steps = roll(vectorize(CartPole(), 3), 200, key)
    observation, final, done = (np.asarray(x) for x in (steps.observation, steps.final_observation, steps.done))
    assert done.any(axis=0).all() and not np.array_equal(done[:, 0], done[:, 1])
    np.testing.assert_array_equal(observation[~done], final[~done])
    assert np.all(np.abs(observation[done]) <= 0.05) and np.all(np.abs(first) <= 0.05)
    assert np.all((np.abs(final[done][:, 0]) > X_LIMIT) | (np.abs(final[done][:, 2]) > ANGLE_LIMIT))
    # A reset is random: no two episodes begin alike.
    assert len(np.unique(observation[done], axis=0)) == done.sum()
    # And the episode goes on from there: positions move by 0.02 s times the velocity that was seen before.
    np.testing.assert_allclose(final[1:, :, 0], observation[:-1, :, 0] + 0.02 * observation[:-1, :, 1], atol=1e-6)


def test_one_key_for_each_environment():
    env, length = vectorize(CartPole(), 3), 60
    keys = jax.random.split(jax.random.key(4), (length + 1, 3))
    actions = jax.random.randint(jax.random.key(5), (length, 3), 0, 2)

    def alone(env, keys, actions):
        state, first = env.reset(keys[0])
        return first, jax.lax.scan(lambda s, x: env.step(s, *x), state, (actions, keys[1:]))[1]

    first, together = jax.jit(lambda k, a: alone(env, k, a))(keys, actions)
    one = jax.jit(lambda k, a: alone(vectorize(CartPole(), 1), k, a))
    for i in range(3):
        alone_first, apart = one(keys[:, i : i + 1], actions[:, i : i + 1])
        np.testing.assert_array_equal(first[i], alone_first[0])
        for ours, theirs in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
            np.testing.assert_allclose(ours[:, i], theirs[:, 0], atol=1e-5)
        assert apart.done.any()
    same = jnp.stack([keys[0, 0]] * 3)
    _, observation = env.reset(same)
    np.testing.assert_array_equal(observation, jnp.stack([observation[0]] * 3))
    assert len(np.unique(first, axis=0)) == 3


def test_scan_and_loop_agree(key):
    env = vectorize(TimeLimit(CartPole(), 7), 2)
    _, steps = roll(env, 20, key)
    reset_key, action_key, step_key = jax.random.split(key, 3)
    state, _ = env.reset(jax.random.split(reset_key, 2))
    actions, keys = jax.random.randint(action_key, (20, 2), 0, 2), jax.random.split(step_key, (20, 2))
    advance = jax.jit(lambda s, a, k: env.step(s, a, k))
    for t in range(20):
        state, timestep = advance(state, actions[t], keys[t])
        for ours, theirs in zip(jax.tree.leaves(timestep), jax.tree.leaves(steps), strict=True):
            np.testing.assert_allclose(ours, theirs[t], atol=1e-5)
    assert np.asarray(steps.truncated).any(axis=0).all()


def test_any_tree_of_observations_and_states(key):
    first, steps = roll(vectorize(Dictionary(), 3), 30, key)
    done, taken, final = (
        np.asarray(x) for x in (steps.done, steps.observation["taken"], steps.final_observation["taken"])
    )
    assert done.sum() > 5
    assert np.all(taken[done] == 0) and np.all(final >= 1)
    draws = np.concatenate([np.asarray(first["draw"])[None], np.asarray(steps.observation["draw"])])
    changed = (draws[1:] != draws[:-1]).all(axis=-1)
    np.testing.assert_array_equal(changed, done)
    np.testing.assert_array_equal(np.asarray(steps.final_observation["draw"]), draws[:-1])


def test_spaces_are_those_of_one_environment():
    env = vectorize(TimeLimit(CartPole(), 500), 4)
    assert env.num_envs == 4
    assert env.observation_space == CartPole().observation_space and env.action_space == CartPole().action_space
    assert env_spec(env) == env_spec(CartPole())


def test_states_hold_arrays_only(key):
    state, _ = vectorize(TimeLimit(CartPole(), 5), 2).reset(jax.random.split(key, 2))
    assert all(eqx.is_array(leaf) and leaf.shape[0] == 2 for leaf in jax.tree.leaves(state))


def test_refusals():
    with pytest.raises(ValueError, match="at least one environment, not 0"):
        vectorize(CartPole(), 0)
    with pytest.raises(ValueError, match="at least 1 step, not 0"):
        TimeLimit(CartPole(), 0)
