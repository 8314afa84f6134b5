"""PPO against what it must reduce to."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import MaskedProbe, first_gradient, jit, lstm, small, small_env
from rewardtogo.core import MASK
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.ops.advantages import normalise
from rewardtogo.policy_gradient.fit import Samples, samples_of

KEY = jax.random.key(0)
LENGTH = 40
PLAIN = rtg.PPO(
    network=small,
    epochs=1,
    minibatches=1,
    clip=1e6,
    value_cost=0.0,
    normalise_advantages=False,
    max_grad_norm=1e9,
    gamma=0.97,
    gae_lambda=0.9,
)


def played(learner: Any, env: Any = None, unroll: int = LENGTH, updates: int = 0) -> tuple[Any, Any]:
    """The learner's state, after a few updates if wanted, and a fresh rollout of its policy."""
    loop = rtg.OnPolicy(rtg.vectorize(small_env() if env is None else env, 4), learner, unroll=unroll).with_horizon(8)

    return jit(lambda key: _play(loop, key, updates, unroll))(KEY)


def _play(loop: Any, key: jax.Array, updates: int, unroll: int) -> tuple[Any, Any]:
    state = loop.init(key)
    state = jax.lax.fori_loop(0, updates, lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0], state)
    rollout = rtg.collect(loop.env, loop.policy(state, explore=True), state.actor, key, unroll)[1]
    return state.learner, rollout


def gae_by_hand(learner: Any, t: Any, value: np.ndarray, following: np.ndarray) -> np.ndarray:
    """The definition, one step at a time in float64."""
    terminated, done = np.asarray(t.terminated), np.asarray(t.done)
    reward, value, following = (np.asarray(x, np.float64) for x in (t.reward, value, following))
    advantage, after = np.zeros_like(reward), np.zeros(reward.shape[1])
    for i in reversed(range(len(reward))):
        delta = reward[i] + learner.gamma * (1 - terminated[i]) * following[i] - value[i]
        after = delta + learner.gamma * learner.gae_lambda * (1 - done[i]) * after
        advantage[i] = after
    return advantage


def relative_gap(a: Any, b: Any) -> float:
    """Greatest difference of two gradients in units of the greatest entry."""
    scale = max(float(jnp.abs(x).max(initial=0)) for x in jax.tree.leaves(b))
    gaps = jax.tree.map(lambda x, y: float(jnp.abs(x - y).max(initial=0)), a, b)
    return max(jax.tree.leaves(gaps)) / scale


def test_one_step_without_clipping_is_the_policy_gradient():
    """The gradient that reaches Adam (its first moment is a tenth of it) is that of -mean log pi(a|s) A, A from GAE."""
    state, rollout = played(PLAIN)
    t = rollout.transitions
    assert bool(t.terminated.any())
    assert bool((t.truncated & ~t.terminated).any())
    value, following = state.network.values(rollout, lambda o: o)
    advantage = jnp.asarray(gae_by_hand(PLAIN, t, value, following), jnp.float32)

    def surrogate(network: Any) -> jax.Array:
        score = jax.vmap(jax.vmap(lambda o, a: network.act((), o)[1].log_prob(a)))(t.observation, t.action)
        return -(score * advantage).mean()

    expected = jit(jax.grad(surrogate))(state.network)
    new, metrics, feedback = jit(lambda s, r: PLAIN.update(s, r, KEY))(state, rollout)
    assert relative_gap(first_gradient(new.optimiser, state.network), expected) <= 1e-6
    assert (
        relative_gap(
            jit(jax.grad(lambda n: PLAIN._loss(n, arranged(state, rollout), state.multiplier)[0]))(state.network),
            expected,
        )
        <= 1e-6
    )
    assert feedback == ()
    assert float(metrics["grad_norm"]) == pytest.approx(
        float(jnp.sqrt(sum(jnp.sum(g**2) for g in jax.tree.leaves(expected)))), rel=1e-4
    )
    assert int(new.updates) == 1


@pytest.mark.parametrize("network", [small, lstm], ids=["mlp", "lstm"])
def test_the_ratio_begins_at_one(network):
    """Also when observations are standardised, after the statistics have moved, and with a memory through ends of episodes."""
    learner = rtg.PPO(network=network, epochs=1, minibatches=1, normalise_observations=True)
    state, rollout = played(learner, updates=2)
    assert float(state.norm.count) == 2 * LENGTH * 4
    new, metrics, _ = jit(lambda s, r: learner.update(s, r, KEY))(state, rollout)
    assert abs(float(metrics["approx_kl"])) <= 1e-6
    assert float(metrics["clip_fraction"]) == 0.0
    assert float(new.norm.count) == 3 * LENGTH * 4


def arranged(state: Any, rollout: Any) -> Samples:
    return samples_of(state.network, state.norm, rollout, PLAIN.gamma, PLAIN.gae_lambda, normalised=False, bptt=32)


@pytest.fixture(scope="module")
def samples() -> tuple[Any, Any]:
    state, rollout = played(PLAIN)
    return state, arranged(state, rollout)


def test_a_ratio_beyond_the_clip_has_no_gradient(samples, item):
    state, s = samples
    learner = rtg.PPO(network=small, clip=0.2, value_cost=0.0, normalise_advantages=False)

    def gradient(shift: float, advantage: float) -> float:
        changed = eqx.tree_at(
            lambda s: (s.log_prob, s.advantage), s, (s.log_prob - shift, jnp.full_like(s.advantage, advantage))
        )
        found = jax.grad(lambda n: learner._loss(n, changed, jnp.ones(()))[0])(state.network)
        return max(float(jnp.abs(g).max(initial=0)) for g in jax.tree.leaves(found))

    with item("7.27") as check:
        check(gradient(0.5, 1.0), "==", 0, "gradient where an action is too likely already, and good")
        check(gradient(0.5, -1.0), ">", 1e-4, "too likely, and bad")
        check(gradient(-0.5, -1.0), "==", 0, "too unlikely already, and bad")
        check(gradient(-0.5, 1.0), ">", 1e-4, "too unlikely, and good")
        check(gradient(0.1, 1.0), ">", 1e-4, "inside")


def test_the_loss_is_the_sum_that_is_written(samples):
    state, s = samples
    learner = rtg.PPO(network=small, clip=0.3, value_cost=0.7, entropy_cost=0.2)
    loss, metrics = learner._loss(state.network, eqx.tree_at(lambda s: s.log_prob, s, s.log_prob - 0.5), jnp.ones(()))
    ratio, advantage = np.exp(0.5), np.asarray(normalise(s.advantage), np.float64)
    policy = -np.minimum(ratio * advantage, 1.3 * advantage).mean()
    value = jax.vmap(lambda o: state.network.value(state.network.init(), o))(s.observation)
    square = 0.5 * np.mean((np.asarray(value, np.float64) - np.asarray(s.target)) ** 2)
    assert float(metrics["policy_loss"]) == pytest.approx(policy, rel=1e-4, abs=1e-6)
    assert float(metrics["value_loss"]) == pytest.approx(square, rel=1e-5)
    assert float(loss) == pytest.approx(policy + 0.7 * square - 0.2 * float(metrics["entropy"]), rel=1e-4)
    assert float(metrics["clip_fraction"]) == 1.0
    assert float(metrics["approx_kl"]) == pytest.approx(ratio - 1 - 0.5, rel=1e-4)
    np.testing.assert_allclose(s.target, s.advantage + value, rtol=1e-5)


@pytest.mark.parametrize(("network", "what"), [(small, "steps"), (lstm, "sequences")])
def test_too_many_minibatches_are_refused(network, what):
    learner = rtg.PPO(network=network, minibatches=99)
    loop = rtg.OnPolicy(rtg.vectorize(small_env(), 4), learner, unroll=8)
    with pytest.raises(ValueError, match=what):
        jax.eval_shape(lambda k: loop.step(loop.init(k), k), KEY)


def test_a_masked_action_is_never_taken():
    learner = rtg.PPO(network=small, learning_rate=1e-2)
    state, rollout = played(learner, MaskedProbe(), updates=2)
    t = rollout.transitions
    assert np.all(np.take_along_axis(t.observation[MASK], t.action[..., None], -1) == 1)
    assert float(t.reward.min()) == 1.0
    greedy = learner.policy(state, explore=False)
    action = jax.vmap(lambda o: greedy(greedy.init(KEY), o, KEY)[1])(jax.tree.map(lambda x: x[:, 0], t.observation))
    assert np.all(np.take_along_axis(t.observation[MASK][:, 0], np.asarray(action)[:, None], -1) == 1)


@pytest.mark.parametrize("explore", [True, False])
def test_what_a_policy_keeps(explore):
    state, rollout = played(PLAIN, unroll=4)
    policy = PLAIN.policy(state, explore)
    observation = rollout.transitions.observation[0, 0]
    _, action, extras = policy(policy.init(KEY), observation, KEY)
    thoughts = policy.inspect(policy.init(KEY), observation)
    assert set(thoughts) == {"value", "entropy", "probabilities"}
    assert float(extras["log_prob"]) == pytest.approx(float(jnp.log(thoughts["probabilities"][action])), abs=1e-5)
    if not explore:
        assert int(action) == int(jnp.argmax(thoughts["probabilities"]))


@pytest.mark.parametrize("objective", ["adaptive_kl", "dual_kl"])
def test_a_penalty_keeps_the_divergence_near_its_target(item, objective):
    """Over the second half of a run, with a constant step size: the median divergence of an update."""
    learner = rtg.PPO(
        network=rtg.MLP(32), objective=objective, target_kl=0.01, learning_rate=3e-3, epochs=8, minibatches=2
    )
    loop = rtg.OnPolicy(rtg.vectorize(CartPole(), 8), learner, unroll=32)

    def step(state: Any, key: jax.Array) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        state, (metrics, _) = loop.step(state, key)
        return state, (metrics["kl"], metrics["multiplier"])

    def run(key: jax.Array) -> Any:
        return jax.lax.scan(step, loop.init(key), jax.random.split(key, 160))[1]

    kl, multiplier = jax.device_get(jax.jit(run)(KEY))
    with item("7.20") as check:
        check(np.median(kl[80:]) / 0.01, "<=", 2.0, f"{objective}: median KL over its target")
        if objective == "adaptive_kl":
            check(np.median(kl[80:]) / 0.01, ">=", 0.5, f"{objective}: median KL over its target")
        else:
            # A multiplier rests at 0 where the step size alone keeps the policy near enough.
            active = multiplier[79:-1] > 0
            check(np.mean(active | (kl[80:] <= 0.01)), ">=", 0.9, "updates with KL <= eps, or a multiplier at work")
        check(multiplier.min(), ">=", 0, "least multiplier")


def test_multipliers_by_hand(item):
    adaptive, dual = (rtg.PPO(objective=o, target_kl=0.01, dual_rate=0.5) for o in ("adaptive_kl", "dual_kl"))
    one = jnp.ones(())
    with item("7.20") as check:
        found = [float(adaptive._next_multiplier(one, jnp.asarray(kl))) for kl in (0.02, 0.01, 0.005)]
        check(found == [2.0, 1.0, 0.5], "==", True, "doubled above 1.5 eps, halved below eps / 1.5")
    with item("7.19") as check:
        found = [float(dual._next_multiplier(one, jnp.asarray(kl))) for kl in (0.02, 0.01, 0.0)]
        check(
            max(abs(a - b) for a, b in zip(found, [1.5, 1.0, 0.5], strict=True)),
            "<=",
            1e-6,
            "lambda + alpha (KL - eps)",
        )
        check(float(dual._next_multiplier(0.1 * one, jnp.zeros(()))), "==", 0, "and never below 0 (E7.7)")
