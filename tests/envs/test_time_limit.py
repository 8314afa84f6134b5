"""A horizon that terminates and is seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.probes import TruncatedLoop
from rewardtogo.envs.tabular import TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.envs.time_limit import FiniteHorizon


def test_the_last_step_terminates_and_time_is_seen(key: jax.Array) -> None:
    env = FiniteHorizon(CartPole(), 4)
    state, observation = env.reset(key)
    plain_state, plain = CartPole().reset(key)
    seen, ends = [observation], []
    for i in range(4):
        state, timestep = env.step(state, jnp.asarray(i % 2), key)
        plain_state, expected = CartPole().step(plain_state, jnp.asarray(i % 2), key)
        np.testing.assert_array_equal(timestep.observation[:-1], expected.observation)
        assert env.observation_space.contains(np.asarray(timestep.observation))
        seen.append(timestep.observation)
        ends.append((bool(timestep.terminated), bool(timestep.truncated)))
    np.testing.assert_array_equal(seen[0][:-1], plain)
    np.testing.assert_allclose([float(o[-1]) for o in seen], [0, 0.25, 0.5, 0.75, 1], atol=1e-7)
    assert ends == [(False, False)] * 3 + [(True, False)]


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1 step, not 0"):
        FiniteHorizon(CartPole(), 0)
    with pytest.raises(ValueError, match="a vector of floats"):
        FiniteHorizon(TabularEnv(random_mdp(0, 3, 2)), 5)


def test_a_cut_of_the_environment_itself_stays_one_before_the_horizon(key: jax.Array) -> None:
    env = FiniteHorizon(TruncatedLoop(), 100)
    state, _ = env.reset(key)
    step = jax.jit(lambda state: env.step(state, jnp.zeros((), jnp.int32), key))
    for i in range(10):
        state, timestep = step(state)
        assert (bool(timestep.terminated), bool(timestep.truncated)) == (False, i == 9)
