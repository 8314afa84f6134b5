"""Learners trained on probes whose values are known: first of all, on the two ways in which an episode ends (erratum E1.5)."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import Algorithm
from rewardtogo.envs.probes import (
    ActionReward,
    DelayedReward,
    MatchingReward,
    ObservedReward,
    OneStep,
    Probe,
    QuadraticReward,
    TruncatedCycle,
    TruncatedLoop,
)
from rewardtogo.ops import Linear

GAMMA = 0.9
NETWORK = rtg.MLP(8)
KEY = jax.random.key(0)


def ppo(env: Probe) -> Algorithm:
    learner = rtg.PPO(network=NETWORK, learning_rate=Linear(3e-2, 0.0), gamma=GAMMA, epochs=4, minibatches=2)
    return rtg.OnPolicy(rtg.vectorize(env, 8), learner, unroll=8)


def reinforce(env: Probe) -> Algorithm:
    learner = rtg.PolicyGradient(
        network=NETWORK,
        learning_rate=Linear(3e-2, 0.0),
        value_learning_rate=Linear(3e-2, 0.0),
        gamma=GAMMA,
        value_updates=8,
    )
    return rtg.OnPolicy(rtg.vectorize(env, 8), learner, unroll=8)


def trpo(env: Probe) -> Algorithm:
    learner = rtg.TRPO(
        network=NETWORK, value_learning_rate=Linear(3e-2, 0.0), gamma=GAMMA, value_epochs=4, minibatches=2
    )
    return rtg.OnPolicy(rtg.vectorize(env, 8), learner, unroll=8)


def asynchronous(env: Probe) -> Algorithm:
    learner = rtg.PolicyGradient(
        network=NETWORK,
        returns="vtrace",
        gae_lambda=1.0,
        learning_rate=Linear(3e-3, 0.0),
        value_learning_rate=Linear(3e-2, 0.0),
        gamma=GAMMA,
        value_updates=8,
    )
    return rtg.Asynchronous(rtg.vectorize(env, 8), learner, workers=3, unroll=8)


def offpolicy_pg(env: Probe) -> Algorithm:
    learner = rtg.OffPolicyPG(
        network=NETWORK, learning_rate=Linear(3e-3, 0.0), value_learning_rate=Linear(3e-2, 0.0), gamma=GAMMA
    )
    return rtg.OffPolicy(
        rtg.vectorize(env, 4), learner, rtg.UniformReplay(256), unroll=8, updates=2, batch_size=16, warm_up=64, length=8
    )


def dqn(env: Probe) -> Algorithm:
    learner = rtg.DQN(
        network=NETWORK,
        learning_rate=Linear(3e-2, 0.0),
        gamma=GAMMA,
        epsilon=0.5,
        target_period=1,
        target_rate=0.1,
        huber=1e3,
    )
    return rtg.OffPolicy(
        rtg.vectorize(env, 4), learner, rtg.UniformReplay(400), unroll=4, updates=4, batch_size=32, warm_up=200
    )


LEARNERS: dict[str, tuple[Callable[[Probe], Algorithm], int]] = {
    "ppo": (ppo, 200),
    "reinforce": (reinforce, 150),
    "trpo": (trpo, 150),
    "async": (asynchronous, 300),
    "offpolicy_pg": (offpolicy_pg, 300),
    "dqn": (dqn, 200),
}
"""Every learner that bootstraps, and iterations enough for a probe. A new one adds a row."""
every = pytest.mark.parametrize("name", LEARNERS)


def trained(name: str, env: Probe) -> dict[str, np.ndarray]:
    """What the trained policy thinks of the observations with known values."""
    make, iterations = LEARNERS[name]
    algorithm = make(env).with_horizon(iterations)

    def train(key: jax.Array) -> Any:
        step = lambda i, state: algorithm.step(state, jax.random.fold_in(key, i))[0]  # noqa: E731
        state = jax.lax.fori_loop(0, iterations, step, algorithm.init(key))
        policy = algorithm.policy(state)
        return jax.vmap(lambda o: policy.inspect(policy.init(key), o))(env.observations())

    return jax.device_get(jit(train)(KEY))


@every
def test_an_end_is_worth_nothing_and_a_cut_changes_nothing(name, item):
    with item("1.25") as check:
        for env, value in ((OneStep(), 1.0), (TruncatedLoop(10), 1 / (1 - GAMMA))):
            found = float(trained(name, env)["value"][0])
            check(abs(found / value - 1), "<=", 0.01, f"{name}: relative error of V on {type(env).__name__}")


def best(name: str, thoughts: dict[str, np.ndarray]) -> np.ndarray:
    return thoughts["q_values" if name == "dqn" else "probabilities"].argmax(-1)


@pytest.mark.slow
@every
@pytest.mark.parametrize(
    "env", [ObservedReward(), DelayedReward(3), TruncatedCycle(3), TruncatedLoop(5, terminates=True)], ids=repr
)
def test_values_of_the_other_probes(name, env):
    np.testing.assert_allclose(
        trained(name, env)["value"], env.values(GAMMA), atol=0.05 * np.abs(env.values(GAMMA)).max()
    )


@pytest.mark.slow
@every
def test_actions_that_pay_are_found(name):
    assert best(name, trained(name, ActionReward())).tolist() == [1]
    thoughts = trained(name, MatchingReward())
    assert best(name, thoughts).tolist() == [0, 1]
    if name == "dqn":
        np.testing.assert_allclose(thoughts["q_values"], MatchingReward().q_values(GAMMA), atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "reinforce"])
def test_a_continuous_action_comes_to_its_target(name):
    thoughts = trained(name, QuadraticReward(0.5))
    assert abs(float(thoughts["mean"][0, 0]) - 0.5) < 0.1
    assert float(jnp.max(thoughts["std"])) < 0.5
