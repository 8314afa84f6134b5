"""REINFORCE against the definition of the policy gradient."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import first_gradient, jit, lstm, small, small_env
from rewardtogo.core import env_spec
from rewardtogo.envs.tabular import MDP, TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.exact import expected_return, policy_gradient, softmax_policy, v_values
from rewardtogo.nn import Optimiser
from rewardtogo.ops import normalise
from rewardtogo.policy_gradient.vanilla import regress

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


def test_actor_and_critic_are_trained_by_their_own_losses(item):
    """The policy's gradient leaves the critic alone and the other way round."""
    learner = make()
    state, rollout = played()
    new, _, _ = jit(lambda s, r: learner.update(s, r, KEY))(state, rollout)
    sizes = lambda tree: max(float(jnp.abs(x).max(initial=0)) for x in jax.tree.leaves(tree))  # noqa: E731
    policy, value = (first_gradient(o, state.network) for o in (new.policy_optimiser, new.value_optimiser))
    assert sizes((policy.critic, policy.value_head)) == 0.0
    with item("4.23") as check:
        check(sizes((value.actor, value.head)), "==", 0, "the value loss's gradient on the actor")
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


def equal(one: Any, other: Any) -> bool:
    return all(bool((a == b).all()) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


def test_fitting_the_value_leaves_the_actor_as_it_is(item):
    """To the bit: Algorithm 3's regression comes first and must not move the policy."""
    state, rollout = played()
    rule = Optimiser(1e-2, 1e9)
    new, _, _ = jit(lambda n, o, r: regress(n, o, rule, r, jnp.ones((LENGTH, 4)), 5))(
        state.network, state.value_optimiser, rollout
    )
    with item("4.23") as check:
        same = equal((new.actor, new.head), (state.network.actor, state.network.head))
        check(same, "==", True, "actor's parameters are the same bits after five steps of the critic")
        check(equal(new.critic, state.network.critic), "==", False, "the critic's are not")


@pytest.mark.parametrize("detached", [False, True])
def test_a_shared_torso(item, detached):
    learner = make(shared=True, detached=detached, value_cost=0.7)
    two, one = (x.init(env_spec(ENV), KEY).network for x in (make(), learner))
    state, rollout = learner.init(env_spec(ENV), KEY), played()[1]
    rollout = dataclasses.replace(rollout, carry=((), ()))
    new, metrics, _ = jit(lambda s, r: learner.update(s, r, KEY))(state, rollout)
    half, _, _ = jit(lambda s, r: dataclasses.replace(learner, value_cost=0.35).update(s, r, KEY))(state, rollout)
    size = lambda tree: sum(x.size for x in jax.tree.leaves(tree))  # noqa: E731
    gradient, of_half = (first_gradient(n.policy_optimiser, state.network) for n in (new, half))
    ratio = of_half.value_head.weight / gradient.value_head.weight
    with item("4.24") as check:
        check(size(one), "<", size(two), "parameters, shared against apart")
        check(
            float(jnp.abs(ratio - 0.5).max()), "<=", 1e-4, "half the coefficient, half the gradient of the value head"
        )
        trunk = float(jnp.abs(of_half.actor.layers[0].weight - gradient.actor.layers[0].weight).max())
        check(
            trunk,
            "==" if detached else ">",
            0,
            "change of the trunk's gradient with it, " + ("cut" if detached else "not cut"),
        )
        check(float(jnp.abs(gradient.head.linear.weight).max()), ">", 0, "the policy's gradient")
    assert np.isfinite(float(metrics["value_loss"]))


def test_one_plain_step_is_alpha_g(item):
    state, rollout = played()
    learner = make(optimiser="sgd", learning_rate=0.25)
    state = dataclasses.replace(state, policy_optimiser=learner._optimiser(0.25).init(state.network))
    state = dataclasses.replace(state, value_optimiser=state.policy_optimiser)
    new, _, _ = jit(lambda s, r: learner.update(s, r, KEY))(state, rollout)
    adam, _, _ = jit(lambda s, r: make().update(s, r, KEY))(played()[0], rollout)
    gradient = first_gradient(adam.policy_optimiser, state.network)
    step = jax.tree.map(
        lambda a, b, g: jnp.abs((a - b) + 0.25 * g).max(initial=0),
        new.network.actor,
        state.network.actor,
        gradient.actor,
    )
    with item("3.7") as check:
        check(max(map(float, jax.tree.leaves(step))), "<=", 1e-6, "theta' - theta = alpha g, for plain steps")


def test_a_small_exact_step_raises_the_objective(item):
    worst = np.inf
    for seed in range(50):
        mdp = random_mdp(seed, 4, 3, horizon=4)
        logits = np.random.default_rng(seed).normal(size=(4, 3))
        ascent = logits + 1e-3 * policy_gradient(mdp, logits)
        gain = expected_return(mdp, softmax_policy(ascent)) - expected_return(mdp, softmax_policy(logits))
        worst = min(worst, gain)
    with item("3.7") as check:
        check(worst, ">", 0, "least gain of J by alpha = 1e-3 along the exact gradient, 50 MDPs")


def test_two_arms(item):
    """A bandit that pays 1 for one arm and 0 for the other."""
    bandit = MDP(np.ones((1, 2, 1)), np.array([[0.0, 1.0]]), horizon=1)
    learner = make(learning_rate=3e-2, baseline="mean")
    loop = rtg.OnPolicy(rtg.vectorize(TabularEnv(bandit), 8), learner, unroll=4)

    def train(key: jax.Array) -> jax.Array:
        state = jax.lax.fori_loop(0, 200, lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0], loop.init(key))
        policy = loop.policy(state)
        return policy.inspect(policy.init(key), jnp.zeros((), jnp.int32))["probabilities"][1]

    chances = jit(jax.vmap(train))(jax.random.split(KEY, 5))
    with item("3.6") as check:
        check(float(jnp.median(chances)), ">", 0.99, "pi(best arm), median of five seeds")


def test_stale_actions_are_refused(item):
    state, rollout = played()
    learner = make()
    older = dataclasses.replace(state, updates=state.updates + 3)
    refused = 0
    for who, name in ((learner, "PolicyGradient"), (rtg.PPO(network=small), "PPO")):
        with pytest.raises(ValueError, match=f"{name} learns from its own fresh actions.*3 updates ago"):
            who.update(dataclasses.replace(who.init(env_spec(ENV), KEY), updates=older.updates), rollout, KEY)
        refused += 1
    learner.update(state, rollout, KEY)
    make(returns="vtrace").update(older, rollout, KEY)
    with item("3.25") as check:
        check(refused, "==", 2, "learners that refuse actions chosen three updates ago; fresh ones, and V-trace, pass")


def test_how_often_a_sample_is_used(item):
    on = rtg.OnPolicy(ENV, make(), unroll=5)
    off = rtg.OffPolicy(ENV, rtg.DQN(network=small), unroll=2, updates=3, batch_size=16)
    with item("3.26") as check:
        check(on.uses_per_sample, "==", 1, "uses of each sample by a policy gradient")
        check(off.uses_per_sample, ">", 1, "uses of each sample by DQN")


def test_extras_that_are_off_change_nothing(item):
    """Without normalisation, bonus and clipping the update is Algorithm 4's, to the bit."""
    state, rollout = played()
    options = {"returns": "n_step", "n_steps": 1, "value_first": True, "max_grad_norm": 1e30}
    plain = make(**options)
    extras = make(**options, entropy_cost=0.0, normalise_observations=False, value_cost=3.0)
    one, other = (jit(lambda s, r, x=x: x.update(s, r, KEY)[0])(state, rollout) for x in (plain, extras))
    advantages = normalise(jnp.asarray(np.random.default_rng(0).normal(3, 5, (50, 8)), jnp.float32))
    with item("4.37") as check:
        check(equal(one.network, other.network), "==", True, "same bits with every extra off")
        check(abs(float(advantages.mean())), "<=", 1e-6, "mean of normalised advantages")
        check(abs(float(advantages.std()) - 1), "<=", 1e-5, "their standard deviation, from 1")


def test_the_order_of_workers_does_not_matter(item):
    """A batch is n environments by k steps, and which is called first changes rounding only."""
    state, rollout = played()
    assert rollout.transitions.reward.shape == (LENGTH, 4)
    turned = jax.tree.map(lambda x: x[:, ::-1], rollout.transitions)
    update = jit(lambda s, r: make().update(s, r, KEY)[0].network)
    one, other = update(state, rollout), update(state, dataclasses.replace(rollout, transitions=turned))
    gap = max(
        float(jnp.abs(a - b).max(initial=0)) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )
    with item("4.25") as check:
        check(rollout.transitions.reward.size, "==", LENGTH * 4, "samples in a batch: n k")
        check(gap, "<=", 1e-5, "difference of the parameters with the workers turned round")


def test_gamma(item):
    with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\]"):
        rtg.PolicyGradient(gamma=1.01)
    with pytest.raises(ValueError, match="discount"):
        v_values(MDP(np.ones((1, 1, 1)), [[1.0]], discount=1.0), np.ones((1, 1)))
    endless = v_values(MDP(np.ones((1, 1, 1)), [[1.0]], discount=0.99), np.ones((1, 1)))[0]
    with item("4.21") as check:
        check(rtg.PolicyGradient().gamma, "==", 0.99, "default")
        check(abs(endless - 100), "<=", 1e-9, "V of reward 1 for ever; at gamma 1 it is refused")
