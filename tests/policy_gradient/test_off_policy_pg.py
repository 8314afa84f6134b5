"""The off-policy policy gradient against sums written out, and against the exact gradient."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import first_gradient, jit, small, small_env
from rewardtogo.core import Batch, env_spec
from rewardtogo.policy_gradient.off_policy import corrected_returns, log_weights

KEY = jax.random.key(0)
ENV = rtg.vectorize(small_env(), 4)
T = 9
RNG = np.random.default_rng(0)
CUT = np.zeros(T, bool)
CUT[[3, 6]] = True
LOG_RATIO = RNG.normal(size=T) * 0.5


def pieces() -> list[range]:
    return [range(0, 4), range(4, 7), range(7, 9)]


def test_returns_weigh_each_reward_by_the_ratios_between(item):
    reward, value = RNG.normal(size=T), RNG.normal(size=T)
    terminated = np.zeros(T, bool)
    terminated[3] = True
    discount, ratio = 0.9 * (1.0 - terminated), np.exp(LOG_RATIO)
    with jax.enable_x64(True):
        found = corrected_returns(*(jnp.asarray(x) for x in (reward, discount, value, ratio, CUT)))
        found = np.asarray(found)
    expected, printed = np.zeros(T), np.zeros(T)
    for piece in pieces():
        for t in piece:
            for k in piece[piece.index(t) :]:
                between = np.prod(ratio[t + 1 : k + 1])
                gamma = 0.9 ** (k - t)
                expected[t] += gamma * between * reward[k]
                printed[t] += gamma * ratio[t] * between * reward[k]  # the ratio at t once more, as printed (E3.8)
                if k == piece[-1] and not terminated[k]:
                    expected[t] += gamma * 0.9 * between * value[k]
    with item("3.33") as check:
        check(np.abs(found - expected).max(), "<=", 1e-12, "the learner's returns: sum over later rewards")
        check(np.abs(found - printed).max(), ">", 0.1, "with the product from k = t, as printed (E3.8)")


@pytest.mark.parametrize("weighting", ["trajectory", "per_decision", "first_order"])
def test_weights_are_products_within_the_trajectory(item, weighting):
    with jax.enable_x64(True):
        found = np.asarray(jnp.exp(log_weights(jnp.asarray(LOG_RATIO), jnp.asarray(CUT), weighting)))
    expected = np.zeros(T)
    for piece in pieces():
        for t in piece:
            last = {"trajectory": piece[-1], "per_decision": t, "first_order": t}[weighting]
            first = t if weighting == "first_order" else piece[0]
            expected[t] = np.exp(LOG_RATIO[first : last + 1].sum())
    with item({"trajectory": "3.30", "per_decision": "3.33", "first_order": "3.36"}[weighting]) as check:
        check(np.abs(found / expected - 1).max(), "<=", 1e-12, f"the learner's weights, {weighting}: products by hand")


def sequences(learner: Any) -> tuple[Any, Batch]:
    loop = rtg.OffPolicy(ENV, learner, rtg.UniformReplay(256), unroll=8, batch_size=6, warm_up=64, length=8)
    state = jit(loop.init)(KEY)
    return state.learner, loop.replay.sample_sequences(state.replay, KEY, 6, 8)


@pytest.mark.parametrize("weighting", ["trajectory", "per_decision", "first_order"])
def test_on_policy_it_is_the_policy_gradient(item, weighting):
    """Where the policy that acted is the one that learns, all weights are 1 (item 3.31)."""
    learner = rtg.OffPolicyPG(network=small, weighting=weighting, max_grad_norm=1e9, value_updates=1)
    state, batch = sequences(learner)
    t = batch.transitions
    own = jax.vmap(jax.vmap(lambda o, a: state.network.act((), o)[1].log_prob(a)))(t.observation, t.action)
    t = jax.tree.map(lambda x: x, t)
    t.extras["log_prob"] = own
    batch = Batch(t, batch.indices, batch.weights)
    new, metrics, _ = jit(lambda s, b: learner.update(s, b, KEY))(state, batch)
    vanilla = rtg.PolicyGradient(
        network=small, normalise_advantages=False, max_grad_norm=1e9, value_updates=1, returns="reward_to_go"
    )
    rollout = rtg.Rollout(t, jax.tree.map(lambda x: x[0], t.extras["carry"]))
    same = eqx.tree_at(lambda s: s.network, vanilla.init(env_spec(ENV), KEY), state.network)
    other, _, _ = jit(lambda s, r: vanilla.update(s, r, KEY))(same, rollout)
    one, two = (first_gradient(x.policy_optimiser, state.network) for x in (new, other))
    scale = max(float(jnp.abs(x).max(initial=0)) for x in jax.tree.leaves(two))
    gap = max(
        float(jnp.abs(a - b).max(initial=0)) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
    )
    with item("3.31") as check:
        check(gap / scale, "<=", 1e-5, f"{weighting}: the learner's gradient against the on-policy one")
        check(abs(float(metrics["effective_sample_size"]) - 1), "<=", 1e-5, "effective sample size over N, from 1")


def test_data_without_probabilities_is_refused():
    learner = rtg.OffPolicyPG(network=small)
    state, batch = sequences(learner)
    t = batch.transitions
    del t.extras["log_prob"]
    with pytest.raises(ValueError, match="probability with which each action was chosen"):
        learner.update(state, Batch(t, batch.indices, batch.weights), KEY)


def test_truncation_bounds_the_weights():
    big = rtg.OffPolicyPG(network=small, truncation=1e6, max_grad_norm=1e9)
    state, batch = sequences(big)
    t = batch.transitions
    t.extras["log_prob"] = t.extras["log_prob"] - 3.0
    batch = Batch(t, batch.indices, batch.weights)
    found = {}
    for limit in (1e6, 2.0):
        learner = rtg.OffPolicyPG(network=small, truncation=limit, max_grad_norm=1e9)
        new, _, _ = jit(lambda s, b, x=learner: x.update(s, b, KEY))(state, batch)
        found[limit] = first_gradient(new.policy_optimiser, state.network).head.linear.weight
    assert float(jnp.abs(found[2.0]).max()) < 0.2 * float(jnp.abs(found[1e6]).max())
