"""Memories: what is replayed is what was acted, exactly, through both ways an episode ends. A learning curve does not show this."""

import functools
import importlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import Rollout, env_spec
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.loops.collect import begin, collect
from rewardtogo.nn import ActorCritic, ActorCriticPolicy
from rewardtogo.value.q_network import QNetwork

ENV = rtg.vectorize(TimeLimit(CartPole(), 14), 8)
LENGTH = 40
TOLERANCE = 2e-6
LOST = 1e-3
MEMORIES = {"gru": rtg.GRU(6, rtg.MLP(5)), "lstm": rtg.LSTM(6, rtg.MLP(5))}
memories = pytest.mark.parametrize("memory", MEMORIES)


def loud(network: ActorCritic) -> ActorCritic:
    """With a head whose output depends on the memory; a fresh one hardly does."""
    weight = jax.random.normal(jax.random.key(2), network.head.linear.weight.shape)
    return eqx.tree_at(lambda n: n.head.linear.weight, network, weight)


@functools.cache
def act(memory: str) -> tuple[ActorCritic, Rollout]:
    """A rollout that begins in the middle of episodes, with the memory before every step."""

    def play(key: jax.Array) -> tuple[ActorCritic, Rollout]:
        network = loud(ActorCritic.of(MEMORIES[memory], env_spec(ENV), key))
        policy = ActorCriticPolicy(network, None, True)
        actor, _, _ = collect(ENV, policy, begin(ENV, policy, key), jax.random.key(1), 5)
        return network, collect(ENV, policy, actor, jax.random.key(2), LENGTH, keep_carry=True)[1]

    network, rollout = jit(play)(jax.random.key(0))
    t = rollout.transitions
    assert int(t.terminated[:-1].sum()) >= 2
    assert int((t.truncated & ~t.terminated)[:-1].sum()) >= 2
    assert float(jnp.abs(jax.tree.leaves(rollout.carry)[0]).max()) > 0.01
    return network, rollout


def replayed(network: ActorCritic, rollout: Rollout, done: jax.Array) -> jax.Array:
    """Log-probabilities as a learner computes them, `[T, B]`."""
    t = rollout.transitions
    evaluate = jax.vmap(network.evaluate, in_axes=(0, 1, 1, 1), out_axes=1)
    return jit(evaluate)(rollout.carry, t.observation, t.action, done)[0]


def gap(a: jax.Array, b: jax.Array) -> float:
    return float(jnp.abs(a - b).max())


@memories
def test_replayed_log_probs_are_those_of_acting(memory):
    network, rollout = act(memory)
    t = rollout.transitions
    assert gap(replayed(network, rollout, t.done), t.extras["log_prob"]) <= TOLERANCE


@memories
@pytest.mark.parametrize("forgotten", ["all", "terminated", "truncated"])
def test_a_reset_that_the_learner_forgets_shows(memory, forgotten):
    network, rollout = act(memory)
    t = rollout.transitions
    done = {"all": jnp.zeros_like(t.done), "terminated": t.truncated, "truncated": t.terminated & ~t.truncated}[
        forgotten
    ]
    assert gap(replayed(network, rollout, done), t.extras["log_prob"]) > LOST


def test_a_carry_that_is_forgotten_shows():
    network, rollout = act("gru")
    fresh = jax.tree.map(jnp.zeros_like, rollout.carry)
    forgetful = Rollout(rollout.transitions, fresh)
    t = rollout.transitions
    assert gap(replayed(network, forgetful, t.done), t.extras["log_prob"]) > LOST


def test_a_reset_that_acting_forgets_shows(monkeypatch):
    module = importlib.import_module("rewardtogo.loops.collect")
    monkeypatch.setattr(module, "reset_where", lambda done, fresh, old: old)
    network, rollout = act.__wrapped__("gru")
    t = rollout.transitions
    assert gap(replayed(network, rollout, t.done), t.extras["log_prob"]) > LOST


def value_after(network: ActorCritic, rollout: Rollout, reset: bool) -> tuple[jax.Array, jax.Array]:
    """V of every observation and of where it led, one step at a time from the memory that acting had before the step."""
    t = rollout.transitions

    def one(carry: Any, observation: jax.Array, following: jax.Array, done: jax.Array) -> tuple[jax.Array, jax.Array]:
        value = network.value(carry, observation)
        after = network.critic(carry[1], observation)[0]
        lost = jax.tree.map(lambda fresh, old: jnp.where(done, fresh, old), network.critic.init(), after)
        return value, network.value((carry[0], lost if reset else after), following)

    return jit(jax.vmap(jax.vmap(one)))(t.extras["carry"], t.observation, t.next_observation, t.done)


@memories
def test_values_are_those_of_the_memory_before_a_reset(memory):
    network, rollout = act(memory)
    t = rollout.transitions
    value, following = jit(lambda n, r: n.values(r, lambda o: o))(network, rollout)
    expected, expected_following = value_after(network, rollout, reset=False)
    assert gap(value, expected) <= TOLERANCE
    assert gap(following, expected_following) <= TOLERANCE
    inside = ~t.done[:-1]
    assert gap(jnp.where(inside, following[:-1], 0.0), jnp.where(inside, value[1:], 0.0)) <= TOLERANCE
    # After a reset the same observation would have had another value: the comparison above would have seen it.
    mutated = value_after(network, rollout, reset=True)[1]
    assert gap(jnp.where(t.truncated, following, 0.0), jnp.where(t.truncated, mutated, 0.0)) > LOST


@memories
def test_the_memory_is_fresh_after_each_end(memory):
    _, rollout = act(memory)
    t = rollout.transitions
    for leaf in jax.tree.leaves(t.extras["carry"]):
        before_next, done = np.asarray(leaf)[1:], np.asarray(t.done)[:-1]
        np.testing.assert_array_equal(before_next[done], 0.0)
        if leaf.shape[-1]:
            assert np.abs(before_next[~done]).max(-1).min() > 0
    for first, stored in zip(jax.tree.leaves(rollout.carry), jax.tree.leaves(t.extras["carry"]), strict=True):
        np.testing.assert_array_equal(first, stored[0])


@pytest.mark.parametrize("memory", ["lstm", pytest.param("gru", marks=pytest.mark.slow)])
def test_q_values_of_sequences_are_those_of_acting(memory):
    learner = rtg.DQN(network=MEMORIES[memory], epsilon=0.5)
    loop = rtg.OffPolicy(ENV, learner, rtg.UniformReplay(512), unroll=5, warm_up=200, batch_size=16, length=20)

    def sample(key: jax.Array) -> tuple[QNetwork, Any, jax.Array, jax.Array]:
        state = loop.init(key)
        policy = learner.policy(state.learner, explore=True)
        rollout = collect(ENV, policy, state.actor, key, 5, keep_carry=True)[1]
        replay = loop.replay.add(state.replay, rollout.transitions)
        batch = loop.replay.sample_sequences(replay, jax.random.key(5), loop.batch_size, loop.length)
        return state.learner.network, batch, *state.learner.network.along(batch.transitions)

    network, batch, q, following = jit(sample)(jax.random.key(0))
    t = batch.transitions

    def one(carry: Any, observation: jax.Array, after: jax.Array) -> tuple[jax.Array, jax.Array]:
        carry, q = network(carry, observation)
        return q, network(carry, after)[1]

    expected, expected_following = jit(jax.vmap(jax.vmap(one)))(t.extras["carry"], t.observation, t.next_observation)
    assert int(t.terminated[:-1].sum()) >= 1
    assert int(t.truncated[:-1].sum()) >= 1
    assert gap(q, expected) <= TOLERANCE
    assert gap(following, expected_following) <= TOLERANCE
    forgetful = eqx.tree_at(lambda t: (t.terminated, t.truncated), t, (t.terminated & False, t.truncated & False))
    assert gap(network.along(forgetful)[0], expected) > LOST


def test_a_memory_makes_recall_possible():
    """PPO with a GRU on the recall probe: the action that is asked for names the cue."""
    from rewardtogo.envs.probes import RecallProbe

    learner = rtg.PPO(network=rtg.GRU(8, rtg.MLP(8)), learning_rate=1e-2, minibatches=1, entropy_cost=0.01, gamma=0.9)
    loop = rtg.OnPolicy(rtg.vectorize(RecallProbe(delay=2), 16), learner, unroll=12).with_horizon(60)

    def train(key: jax.Array) -> jax.Array:
        state = loop.init(key)
        state = jax.lax.fori_loop(0, 60, lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0], state)
        policy = loop.policy(state)
        episodes = collect(loop.env, policy, begin(loop.env, policy, key), key, 12)[2]
        return episodes.return_sum / episodes.count

    assert jit(train)(jax.random.key(0)) > 0.95
