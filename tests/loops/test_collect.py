import jax
import jax.numpy as jnp
import numpy as np

import rewardtogo as rtg
from algorithms_under_test import MaskedProbe, jit
from rewardtogo.core import MASK, Policy, env_spec
from rewardtogo.envs.probes import CountingEnv, QuadraticReward, TruncatedCycle
from rewardtogo.loops import RandomPolicy, begin, collect, shard

KEY = jax.random.key(0)


class Always(Policy):
    """One action, and a memory that counts its steps since the last reset."""

    action: jax.Array

    def init(self, key):
        del key
        return jnp.zeros((), jnp.int32)

    def __call__(self, carry, observation, key):
        del observation, key
        return carry + 1, self.action, {"seen": carry}

    def inspect(self, carry, observation):
        return {}


def play(env, policy, *lengths, keep_carry=False):
    def run(key):
        actor, found = begin(env, policy, key), []
        for i, length in enumerate(lengths):
            actor, rollout, episodes = collect(env, policy, actor, jax.random.fold_in(key, i), length, keep_carry)
            found.append((rollout, episodes))
        return actor, found

    return jax.device_get(jit(run)(KEY))


def test_every_number_lies_where_it_should():
    env = rtg.vectorize(CountingEnv(5), 2)
    actor, [(rollout, episodes)] = play(env, Always(jnp.asarray(1)), 12, keep_carry=True)
    t = rollout.transitions
    both = lambda row: np.repeat(np.array(row)[:, None], 2, 1)  # noqa: E731
    steps = np.arange(12) % 5
    np.testing.assert_array_equal(t.observation[..., 0], both(steps))
    np.testing.assert_array_equal(t.next_observation[..., 0], both(steps + 1))
    np.testing.assert_array_equal(t.reward, both(steps + 1))
    np.testing.assert_array_equal(t.terminated, both(steps == 4))
    assert not t.truncated.any()
    np.testing.assert_array_equal(t.extras["seen"], both(steps))
    np.testing.assert_array_equal(t.extras["carry"], both(steps))
    np.testing.assert_array_equal(rollout.carry, [0, 0])
    assert (episodes.count, episodes.return_sum, episodes.length_sum) == (4, 60, 20)
    np.testing.assert_array_equal(actor.stats.return_so_far, [3, 3])
    np.testing.assert_array_equal(actor.stats.length_so_far, [2, 2])
    np.testing.assert_array_equal(actor.observation[:, 0], [2, 2])
    np.testing.assert_array_equal(actor.carry, [2, 2])


def test_where_a_call_ends_does_not_show():
    env = rtg.vectorize(CountingEnv(5), 2)
    policy = Always(jnp.asarray(1))
    whole, [(one, episodes)] = play(env, policy, 12)
    parts, [(first, some), (second, rest)] = play(env, policy, 7, 5)
    joined = jax.tree.map(lambda a, b: np.concatenate([a, b]), first.transitions, second.transitions)
    jax.tree.map(np.testing.assert_array_equal, joined, one.transitions)
    jax.tree.map(np.testing.assert_array_equal, whole, parts)
    jax.tree.map(lambda a, b, c: np.testing.assert_array_equal(a + b, c), some, rest, episodes)
    np.testing.assert_array_equal(second.carry, [2, 2])
    assert "carry" not in second.transitions.extras


def test_the_observation_before_a_reset_is_kept():
    """The cut falls in the second state, the next episode begins in the first."""
    env = rtg.vectorize(TruncatedCycle(3), 1)
    _, [(rollout, _)] = play(env, Always(jnp.asarray(0)), 4)
    t = rollout.transitions
    np.testing.assert_array_equal(t.truncated[:, 0], [False, False, True, False])
    np.testing.assert_array_equal(t.next_observation[2, 0], [0, 1])
    np.testing.assert_array_equal(t.observation[3, 0], [1, 0])


def test_actions_are_clipped_for_the_environment_only():
    env = rtg.vectorize(QuadraticReward(0.5), 2)
    _, [(rollout, _)] = play(env, Always(jnp.asarray([3.0])), 3)
    np.testing.assert_array_equal(rollout.transitions.action, 3.0)
    np.testing.assert_allclose(rollout.transitions.reward, -0.25)


def test_a_random_policy_takes_every_allowed_action_and_no_other():
    env = rtg.vectorize(MaskedProbe(), 8)
    _, [(rollout, _)] = play(env, RandomPolicy(env_spec(env)), 20)
    t = rollout.transitions
    mask, action = t.observation[MASK], t.action
    assert np.all(np.take_along_axis(mask, action[..., None], -1) == 1)
    assert set(action[mask[..., 1] == 1].tolist()) == {1, 2}
    assert t.reward.min() == 1


def test_equal_keys_give_equal_rollouts():
    env = rtg.vectorize(rtg.make("CartPole-v1", 1).env, 3)
    policy = RandomPolicy(env_spec(env))
    run = jit(lambda key: collect(env, policy, begin(env, policy, key), key, 9)[1].transitions)
    one, same, other = run(KEY), run(KEY), run(jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, one, same)
    assert not np.array_equal(one.observation, other.observation)
    assert not np.array_equal(one.observation[:, 0], one.observation[:, 1])


def test_shard_without_devices_is_nothing():
    tree = {"a": jnp.ones(4), "b": jnp.ones(())}
    assert shard(tree) is tree
    assert "sharding" not in str(jax.make_jaxpr(shard)(tree))
