import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import demonstrations, jit
from recorder import Recorder
from rewardtogo.envs.probes import CountingEnv
from rewardtogo.ops import Linear

ENV = rtg.vectorize(CountingEnv(5), 2)
KEY = jax.random.key(0)


def test_each_iteration_learns_once_from_fresh_steps():
    loop = rtg.OnPolicy(ENV, Recorder("rollout"), unroll=7)
    assert (loop.steps_per_iteration, loop.initial_steps, loop.default_num_envs()) == (14, 0, 8)
    state = jit(loop.init)(KEY)
    step = jit(lambda s, k: loop.step(s, k))
    state, (metrics, episodes) = step(state, KEY)
    rollout = metrics["batch"]
    np.testing.assert_array_equal(rollout.transitions.observation[:, 0, 0], [0, 1, 2, 3, 4, 0, 1])
    assert (episodes.count, episodes.return_sum) == (2, 30)
    assert metrics["updates"] == 1
    assert int(rollout.transitions.extras["explore"].min()) == 1
    state, (metrics, _) = step(state, KEY)
    rollout = metrics["batch"]
    np.testing.assert_array_equal(rollout.transitions.observation[:, 0, 0], [2, 3, 4, 0, 1, 2, 3])
    np.testing.assert_array_equal(rollout.transitions.extras["updates"], 1)
    assert metrics["updates"] == 2


def test_the_policy_is_asked_for_as_wanted():
    loop = rtg.OnPolicy(ENV, Recorder("rollout"), unroll=2)
    state = loop.init(KEY)
    for explore in (True, False):
        policy = loop.policy(state, explore)
        assert int(policy(policy.init(KEY), jnp.zeros(1), KEY)[2]["explore"]) == explore


@pytest.mark.parametrize("batch", ["transitions", "sequences"])
def test_a_learner_that_wants_old_data_is_refused(batch):
    with pytest.raises(ValueError, match=f"Recorder learns from {batch}, not from fresh rollouts: use OffPolicy"):
        rtg.OnPolicy(ENV, Recorder(batch))


def test_a_learner_that_wants_fresh_data_is_refused_elsewhere():
    with pytest.raises(ValueError, match=r"needs fresh rollouts.*use OnPolicy"):
        rtg.OffPolicy(ENV, Recorder("rollout"))
    with pytest.raises(ValueError, match=r"needs fresh rollouts.*use OnPolicy"):
        rtg.Offline(demonstrations(), Recorder("rollout"))


@pytest.mark.parametrize("unroll", [0, -1, True])
def test_a_wrong_length_is_refused(unroll):
    with pytest.raises(ValueError, match=r"OnPolicy\.unroll must be"):
        rtg.OnPolicy(ENV, Recorder("rollout"), unroll=unroll)


def test_schedules_are_stretched_over_the_updates():
    learner = dataclasses.replace(Recorder("rollout"), rate=Linear(1.0, 0.0))
    loop = rtg.OnPolicy(ENV, learner).with_horizon(30)
    assert loop.learner.rate.horizon == 30
    assert loop.with_horizon(60).learner.rate.horizon == 30
