"""One program plays the best policy and the exploring one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.envs import TimeLimit
from rewardtogo.envs.pendulum import Pendulum
from rewardtogo.runner.evaluate import Either, Evaluator


@pytest.mark.parametrize("network", [rtg.MLP(4), rtg.GRU(3, rtg.MLP(3))], ids=["mlp", "gru"])
def test_either_plays_as_the_policy_alone(network: rtg.MLP | rtg.GRU, key: jax.Array) -> None:
    env = rtg.vectorize(TimeLimit(Pendulum(), 5), 3)
    algorithm = rtg.OnPolicy(env, rtg.PPO(network=network), unroll=4)
    state, evaluator = jax.jit(algorithm.init)(key), Evaluator(env, 6)
    found = {}
    for explore in (False, True):
        alone = evaluator(algorithm.policy(state, explore), key)
        found[explore] = evaluator(Either.of(algorithm, state, explore), key)
        np.testing.assert_allclose(found[explore], alone, rtol=1e-6)
    assert not np.allclose(found[False][0], found[True][0])


def test_of_several_seeds(key: jax.Array) -> None:
    env = rtg.vectorize(TimeLimit(Pendulum(), 5), 2)
    algorithm = rtg.OnPolicy(env, rtg.PPO(network=rtg.MLP(4)), unroll=4)
    keys = jax.random.split(key, 2)
    states = jax.jit(jax.vmap(algorithm.init))(keys)
    policies = jax.vmap(lambda s: Either.of(algorithm, s, True))(states)
    returns, lengths = Evaluator(env, 4, seeds=True)(policies, key)
    assert returns.shape == (2, 4) and np.all(lengths == 5)
    alone = Evaluator(env, 4)(Either.of(algorithm, jax.tree.map(lambda x: x[1], states), True), key)
    np.testing.assert_allclose(returns[1], alone[0], rtol=1e-5)
    assert not jnp.allclose(returns[0], returns[1])
