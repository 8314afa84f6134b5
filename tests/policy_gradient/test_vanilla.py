"""REINFORCE against the definition of the policy gradient."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import first_gradient, jit, lstm, small, small_env
from rewardtogo.core import env_spec

KEY = jax.random.key(0)
LENGTH = 40
ENV = rtg.vectorize(small_env(), 4)


def make(**options: Any) -> Any:
    common = {"network": small, "gamma": 0.95, "max_grad_norm": 1e9, "value_updates": 1, "normalise_advantages": False}
    return rtg.PolicyGradient(**{**common, **options})


@functools.cache
def played(network: Any = small) -> tuple[Any, Any]:
    """A fresh state, which no other option changes, and a rollout of its policy."""
    loop = rtg.OnPolicy(ENV, make(network=network), unroll=LENGTH)

    def play(key: jax.Array) -> tuple[Any, Any]:
        state = loop.init(key)
        return state.learner, rtg.collect(ENV, loop.policy(state, explore=True), state.actor, key, LENGTH)[1]

    state, rollout = jit(play)(KEY)
    t = rollout.transitions
    assert bool(t.terminated.any())
    assert bool((t.truncated & ~t.terminated).any())
    return state, rollout


def returns_by_hand(gamma: float, t: Any, following: Any) -> np.ndarray:
    """G_t as a sum over all later steps of the episode, each looked at anew; V only where the sum is cut, not where it ends."""
    reward, following = np.asarray(t.reward, np.float64), np.asarray(following, np.float64)
    terminated, truncated = np.asarray(t.terminated), np.asarray(t.truncated)
    length, envs = reward.shape
    found = np.zeros_like(reward)
    for env in range(envs):
        for start in range(length):
            for i in range(start, length):
                found[start, env] += gamma ** (i - start) * reward[i, env]
                if terminated[i, env]:
                    break
                if truncated[i, env] or i == length - 1:
                    found[start, env] += gamma ** (i - start + 1) * following[i, env]
                    break
    return found


@pytest.mark.parametrize("baseline", ["none", "mean", "value"])
def test_the_gradient_is_the_definition(baseline):
    """What reaches Adam is the gradient of -mean log pi(a|s) (G - b), G by a double loop."""
    learner = make(baseline=baseline)
    state, rollout = played()
    t = rollout.transitions
    value, following = state.network.values(rollout, lambda o: o)
    returns = returns_by_hand(learner.gamma, t, following)
    below = {"none": 0.0, "mean": returns.mean(), "value": np.asarray(value, np.float64)}[baseline]
    weight = jnp.asarray(returns - below, jnp.float32)

    def surrogate(network: Any) -> jax.Array:
        score = jax.vmap(jax.vmap(lambda o, a: network.act((), o)[1].log_prob(a)))(t.observation, t.action)
        return -(score * weight).mean()

    expected = jit(jax.grad(surrogate))(state.network)
    new, _, _ = jit(lambda s, r: learner.update(s, r, KEY))(state, rollout)
    scale = max(float(jnp.abs(g).max(initial=0)) for g in jax.tree.leaves(expected))
    found = first_gradient(new.policy_optimiser, state.network)
    for one, gradient in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, gradient, atol=1e-6 * scale)


def test_the_value_is_fitted_to_the_returns():
    learner = make(value_updates=300, value_learning_rate=1e-2)
    state, rollout = played()
    update = jit(lambda s, r: learner.update(s, r, KEY))
    new, metrics, _ = update(state, rollout)
    _, following = state.network.values(rollout, lambda o: o)
    returns = returns_by_hand(learner.gamma, rollout.transitions, following)
    fitted, _ = new.network.values(rollout, lambda o: o)
    before = float(metrics["value_loss"])
    assert before == pytest.approx(
        0.5 * np.mean((np.asarray(state.network.values(rollout, lambda o: o)[0], np.float64) - returns) ** 2), rel=1e-4
    )
    assert 0.5 * np.mean((np.asarray(fitted) - returns) ** 2) < 0.5 * before


def test_actor_and_critic_are_trained_by_their_own_losses():
    """The policy's gradient leaves the critic alone and the other way round."""
    learner = make()
    state, rollout = played()
    new, _, _ = jit(lambda s, r: learner.update(s, r, KEY))(state, rollout)
    sizes = lambda tree: max(float(jnp.abs(x).max(initial=0)) for x in jax.tree.leaves(tree))  # noqa: E731
    policy, value = (first_gradient(o, state.network) for o in (new.policy_optimiser, new.value_optimiser))
    assert sizes((policy.critic, policy.value_head)) == 0.0
    assert sizes((value.actor, value.head)) == 0.0
    assert sizes(policy.actor) > 0.0
    assert sizes(value.critic) > 0.0


def test_a_memory_is_replayed_from_where_it_stood():
    """With one rollout and no baseline the surrogate's value is -mean log_prob G, log_prob as it was when acting."""
    learner = make(network=lstm, baseline="none")
    state, rollout = played(lstm)
    _, following = state.network.values(rollout, lambda o: o)
    returns = returns_by_hand(learner.gamma, rollout.transitions, following)
    expected = -(np.asarray(rollout.transitions.extras["log_prob"], np.float64) * returns).mean()
    _, metrics, _ = jit(lambda s, r: learner.update(s, r, KEY))(state, rollout)
    assert float(metrics["policy_loss"]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("normalise", [True, False])
def test_statistics_change_after_the_update(normalise):
    learner = make(normalise_observations=normalise)
    state = learner.init(env_spec(ENV), KEY)
    assert (state.norm is not None) == normalise
