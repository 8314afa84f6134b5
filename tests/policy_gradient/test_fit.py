"""What natural gradient methods make of a rollout, against how the policy acted; and the regression of the value function."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import MaskedProbe, jit, lstm, small, small_env
from rewardtogo.envs.pendulum import Pendulum
from rewardtogo.nn import Optimiser
from rewardtogo.policy_gradient.fisher import mean_kl
from rewardtogo.policy_gradient.fit import (
    action_laws,
    actor_parameters,
    critic,
    fit_values,
    mean_entropy,
    minibatch_size,
    samples_of,
    surrogate,
    thin,
)

KEY = jax.random.key(0)
LENGTH, ENVS, SEQUENCE = 40, 4, 20
"""With a memory, rollouts of 40 steps are cut into two sequences of 20."""
NETWORKS = {"mlp": small, "lstm": lstm}
ENVIRONMENTS = {"cartpole": small_env, "masked": MaskedProbe, "pendulum": Pendulum}


@functools.cache
def played(network: str = "mlp", env: str = "cartpole") -> tuple[Any, Any, Any]:
    """State after two updates of PPO that standardise observations, a rollout of its policy, and the samples of that."""
    learner = rtg.PPO(network=NETWORKS[network], normalise_observations=True)
    loop = rtg.OnPolicy(rtg.vectorize(ENVIRONMENTS[env](), ENVS), learner, unroll=LENGTH).with_horizon(8)

    def play(key: jax.Array) -> tuple[Any, Any, Any]:
        state = jax.lax.fori_loop(0, 2, lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0], loop.init(key))
        rollout = rtg.collect(loop.env, loop.policy(state, explore=True), state.actor, key, LENGTH)[1]
        s = state.learner
        return s, rollout, samples_of(s.network, s.norm, rollout, 0.97, 0.9, False, 32)

    return jit(play)(KEY)


@pytest.mark.parametrize(("network", "env"), [("mlp", "cartpole"), ("lstm", "cartpole"), ("mlp", "masked")])
def test_the_laws_are_those_that_acted(network, env):
    """Log-probabilities of all steps are those kept while acting, so that the surrogate begins at the mean advantage."""
    state, _, samples = played(network, env)
    laws = action_laws(state.network, samples)
    action = samples.action.reshape(-1)
    log_prob = jax.vmap(lambda law, a: law.log_prob(a))(laws, action)
    assert len(log_prob) == LENGTH * ENVS
    np.testing.assert_allclose(log_prob, samples.log_prob.reshape(-1), atol=1e-5)
    entropy = float(mean_entropy(laws))
    # Pure rounding, although weights of 1 +- 1e-6 multiply advantages of some size.
    expected = float(samples.advantage.mean()) + 0.5 * entropy
    assert float(surrogate(laws, samples, 0.5)) == pytest.approx(expected, abs=1e-4)
    assert float(mean_kl(laws, laws)) == 0.0


@pytest.mark.parametrize("network", ["mlp", "lstm"])
def test_advantages_and_targets(network):
    """One step at a time in float64."""
    state, rollout, samples = played(network)
    t = rollout.transitions
    assert bool(t.terminated.any())
    assert bool((t.truncated & ~t.terminated).any())
    value, following = (np.asarray(x, np.float64) for x in state.network.values(rollout, state.norm))
    advantage, after = np.zeros((LENGTH, ENVS)), np.zeros(ENVS)
    for i in reversed(range(LENGTH)):
        delta = np.asarray(t.reward)[i] + 0.97 * (1 - np.asarray(t.terminated)[i]) * following[i] - value[i]
        after = delta + 0.97 * 0.9 * (1 - np.asarray(t.done)[i]) * after
        advantage[i] = after
    arranged = (lambda x: x.reshape(-1)) if network == "mlp" else (lambda x: x.T.reshape(-1, SEQUENCE))
    np.testing.assert_allclose(samples.advantage, arranged(advantage), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(samples.target, arranged(advantage + value), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(samples.value, arranged(value), rtol=1e-5, atol=1e-5)
    whole = samples_of(state.network, state.norm, rollout, 0.97, 0.9, True, 32)
    assert float(whole.advantage.mean()) == pytest.approx(0.0, abs=1e-5)
    assert float(whole.advantage.std()) == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(whole.target, samples.target, rtol=1e-5)


def test_thinning():
    _, rollout, samples = played("mlp")
    few = thin(samples, ENVS, 8)
    np.testing.assert_array_equal(few.action, rollout.transitions.action[::8].reshape(-1))
    np.testing.assert_array_equal(thin(samples, ENVS, 1).action, samples.action)
    assert len(thin(samples, ENVS, 1000).action) == ENVS
    state, rollout, sequences = played("lstm")
    few = thin(sequences, ENVS, 2)
    np.testing.assert_array_equal(few.action, rollout.transitions.action.T.reshape(-1, SEQUENCE)[::2])
    assert {len(leaf) for leaf in jax.tree.leaves(few)} == {LENGTH // SEQUENCE * ENVS // 2}
    laws = action_laws(state.network, few)
    assert len(jax.tree.leaves(laws)[0]) == LENGTH * ENVS // 2


def test_the_actor_goes_out_and_back():
    """The log std of a Gaussian is among the parameters; the critic is not."""
    network = played("mlp", "pendulum")[0].network
    theta, network_of = actor_parameters(network)
    moved = network_of(theta + 1.0)
    same = lambda a, b: [  # noqa: E731
        bool(jnp.all(x == y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    ]
    assert all(same(network_of(theta), network))
    assert all(same(critic(moved), critic(network)))
    assert not any(same((moved.actor, moved.head), (network.actor, network.head)))
    np.testing.assert_allclose(moved.head.log_std, network.head.log_std + 1.0, rtol=1e-6)


@pytest.mark.parametrize("network", ["mlp", "lstm"])
def test_the_value_function_is_fitted_alone(network):
    state, _, samples = played(network)
    adam = Optimiser(1e-2, 10.0)

    def fit(key: jax.Array) -> Any:
        return fit_values(state.network, adam.init(critic(state.network)), adam, samples, key, 40, 2)

    fitted, optimiser, loss = jit(fit)(KEY)
    evaluate = jax.vmap(lambda n, *s: n.evaluate(*s)[2], in_axes=(None, 0, 0, 0, 0))
    error = lambda n: float(  # noqa: E731
        0.5
        * ((evaluate(n, samples.carry, samples.observation, samples.action, samples.done) - samples.target) ** 2).mean()
    )
    assert error(fitted) < 0.5 * error(state.network)
    assert error(fitted) < float(loss) < error(state.network)
    np.testing.assert_array_equal(actor_parameters(fitted)[0], actor_parameters(state.network)[0])
    assert int(optimiser[1][0].count) == 80


def test_one_full_batch_step_is_adam_on_the_gradient():
    state, _, samples = played("mlp")
    adam = Optimiser(1e-3, 1e9)
    start = adam.init(critic(state.network))
    fitted, _, loss = jit(lambda k: fit_values(state.network, start, adam, samples, k, 1, 1))(KEY)
    value = jax.vmap(lambda o: state.network.value(state.network.init(), o))(samples.observation)
    assert float(loss) == pytest.approx(0.5 * float(((value - samples.target) ** 2).mean()), rel=1e-5)
    # The first step of Adam is its rate in every direction that has a gradient; the output bias always has one.
    moved = abs(float((fitted.value_head.bias - state.network.value_head.bias)[0]))
    assert moved == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize(("recurrent", "what"), [(False, "3 steps"), (True, "3 sequences")])
def test_too_many_minibatches_are_refused(recurrent, what):
    assert minibatch_size(7, 3, recurrent) == 2
    with pytest.raises(ValueError, match=what):
        minibatch_size(3, 4, recurrent)
