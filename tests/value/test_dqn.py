"""DQN on batches that are worked out by hand, with linear networks whose weights are known."""

from typing import Any

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import MaskedProbe, first_gradient, jit, small
from rewardtogo.core import MASK, Batch, EnvSpec, Transition, from_space
from rewardtogo.ops import Linear
from rewardtogo.value.dqn import DQNState

KEY = jax.random.key(0)
SPEC = EnvSpec(from_space(spaces.Box(-9, 9, (2,), np.float32)), from_space(spaces.Discrete(3)))
LINEAR = rtg.MLP()
W = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 2.0]], np.float32)
W_TARGET = np.array([[2.0, 1.0], [0.5, -1.0], [1.0, 1.0]], np.float32)


def state_of(learner: Any, weight: np.ndarray = W, target: np.ndarray = W_TARGET) -> DQNState:
    state = learner.init(SPEC, KEY)
    put = lambda n, w: eqx.tree_at(lambda n: n.head.layers[0].weight, n, jnp.asarray(w))  # noqa: E731
    return eqx.tree_at(lambda s: (s.network, s.target), state, (put(state.network, weight), put(state.target, target)))


S = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], np.float32)
A = np.array([0, 2, 1], np.int32)
R = np.array([0.5, -1.0, 2.0], np.float32)
NEXT = np.array([[1.0, 2.0], [2.0, -1.0], [0.0, 1.0]], np.float32)
TERMINATED, TRUNCATED = np.array([False, True, False]), np.array([False, False, True])
Q = np.array([1.0, 2.0, 1.0])  # W s at the action taken


def batch(weights: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Batch:
    t = Transition(*(jnp.asarray(x) for x in (S, A, R, TERMINATED, TRUNCATED, NEXT)), {})
    return Batch(t, jnp.arange(3, dtype=jnp.int32), jnp.asarray(weights))


def targets(double: bool, gamma: float = 0.9) -> np.ndarray:
    target, online = NEXT @ W_TARGET.T, NEXT @ W.T
    best = target[np.arange(3), online.argmax(1)] if double else target.max(1)
    return R + gamma * (1 - TERMINATED) * best


def test_the_worked_example_tells_its_cases_apart():
    plain, double = targets(False), targets(True)
    np.testing.assert_allclose(plain, [0.5 + 0.9 * 4.0, -1.0, 2.0 + 0.9 * 1.0], rtol=1e-6)
    np.testing.assert_allclose(double, [0.5 + 0.9 * 3.0, -1.0, 2.0 + 0.9 * 1.0], rtol=1e-6)


@pytest.mark.parametrize("double", [False, True])
def test_targets_are_those_worked_out_by_hand(double, item):
    """A terminated step adds nothing, a truncated one bootstraps; priorities are the absolute errors."""
    learner = rtg.DQN(
        network=LINEAR, gamma=0.9, double=double, huber=1e9, target_period=99, max_grad_norm=1e9, epsilon=0.1
    )
    weights = (1.0, 0.5, 2.0)
    new, metrics, priorities = jit(lambda s, b: learner.update(s, b, KEY))(state_of(learner), batch(weights))
    error = Q - targets(double)
    np.testing.assert_allclose(priorities, np.abs(error), rtol=1e-5)
    with item("6.14" if double else "6.6") as check:
        gap = float(np.abs(priorities - np.abs(error)).max())
        check(gap, "<=", 1e-5, f"{'double' if double else 'plain'} targets of a batch, by hand")
    assert float(metrics["q_loss"]) == pytest.approx(np.mean(np.array(weights) * 0.5 * error**2), rel=1e-5)
    assert float(metrics["td_error"]) == pytest.approx(np.abs(error).mean(), rel=1e-5)
    assert float(metrics["q_mean"]) == pytest.approx(Q.mean(), rel=1e-5)
    # d/dW of the mean of weight * error^2 / 2, with no gradient through the target.
    expected = np.zeros((3, 2))
    for s, a, e, w in zip(S, A, error, weights, strict=True):
        expected[a] += w * e * s / 3
    np.testing.assert_allclose(
        first_gradient(new.optimiser, new.network).head.layers[0].weight, expected, rtol=1e-4, atol=1e-6
    )


def test_errors_beyond_the_huber_threshold_count_linearly():
    learner = rtg.DQN(network=LINEAR, gamma=0.9, huber=0.5, epsilon=0.1)
    _, metrics, _ = jit(lambda s, b: learner.update(s, b, KEY))(state_of(learner), batch())
    size = np.abs(Q - targets(False))
    loss = np.where(size <= 0.5, 0.5 * size**2, 0.5 * (size - 0.25))
    assert float(metrics["q_loss"]) == pytest.approx(loss.mean(), rel=1e-5)


def test_double_is_plain_where_the_networks_agree():
    found = []
    for double in (False, True):
        learner = rtg.DQN(network=small, double=double, epsilon=0.1)
        state = learner.init(SPEC, KEY)
        found.append(jit(lambda s, b: learner.update(s, b, KEY))(state, batch())[2])  # noqa: B023
    np.testing.assert_array_equal(*found)


def test_the_target_is_copied_at_the_period():
    learner = rtg.DQN(network=LINEAR, target_period=3, epsilon=0.1)
    update, state = jit(lambda s, b: learner.update(s, b, KEY)[0]), state_of(learner)
    for i in range(1, 7):
        before, state = state.target, update(state, batch())
        if i % 3:
            jax.tree.map(np.testing.assert_array_equal, state.target, before)
            assert not np.array_equal(state.target.head.layers[0].weight, state.network.head.layers[0].weight)
        else:
            jax.tree.map(np.testing.assert_array_equal, state.target, state.network)
    assert int(state.updates) == 6


def test_the_target_follows_by_polyak_averaging():
    learner = rtg.DQN(network=LINEAR, target_period=1, target_rate=0.25, epsilon=0.1)
    state = state_of(learner)
    new = jit(lambda s, b: learner.update(s, b, KEY)[0])(state, batch())
    expected = 0.75 * W_TARGET + 0.25 * np.asarray(new.network.head.layers[0].weight)
    np.testing.assert_allclose(new.target.head.layers[0].weight, expected, rtol=1e-6)


def test_a_fresh_target_is_the_network():
    state = rtg.DQN(network=small).init(SPEC, KEY)
    jax.tree.map(np.testing.assert_array_equal, state.target, state.network)


# --- acting ----------------------------------------------------------------------------------------------------------


def test_exploration_is_epsilon_greedy():
    learner = rtg.DQN(network=LINEAR, epsilon=0.3)
    state, keys = state_of(learner), jax.random.split(KEY, 4000)
    act = jit(lambda p, k: jax.vmap(lambda k: p(p.init(k), jnp.asarray([1.0, 0.0]), k)[1])(k))
    explored = np.asarray(act(learner.policy(state, explore=True), keys))
    frequencies = np.bincount(explored, minlength=3) / len(explored)
    np.testing.assert_allclose(frequencies, [0.8, 0.1, 0.1], atol=0.03)
    assert set(np.asarray(act(learner.policy(state, explore=False), keys)).tolist()) == {0}


def test_epsilon_follows_its_schedule(item):
    learner = rtg.OffPolicy(rtg.make("CartPole-v1", 1), rtg.DQN(network=small), updates=2).with_horizon(50).learner
    state = learner.init(SPEC, KEY)
    for updates, epsilon in ((0, 1.0), (10, 0.525), (20, 0.05), (99, 0.05)):
        at = eqx.tree_at(lambda s: s.updates, state, jnp.asarray(updates, jnp.int32))
        assert float(learner.policy(at, explore=True).epsilon) == pytest.approx(epsilon, rel=1e-5)  # type: ignore[attr-defined]
        assert float(learner.policy(at, explore=False).epsilon) == 0.0  # type: ignore[attr-defined]
    rates = rtg.DQN(learning_rate=Linear(1e-3, 1e-4), epsilon=Linear(1.0, 0.05, fraction=0.2))
    rates = rtg.OffPolicy(rtg.make("CartPole-v1", 1), rates).with_horizon(100).learner
    ends = [float(value(i)) for value in (rates.learning_rate, rates.epsilon) for i in (0, 100)]  # type: ignore[attr-defined]
    with item("6.29") as check:
        wanted = np.float32([1e-3, 1e-4, 1.0, 0.05]).tolist()
        check(
            max(abs(a - b) for a, b in zip(ends, wanted, strict=True)),
            "==",
            0,
            "ends of the schedules of rate and epsilon",
        )


@pytest.mark.parametrize("epsilon", [0.0, 1.0])
def test_a_masked_action_is_never_taken(epsilon):
    learner = rtg.DQN(network=small, epsilon=epsilon, learning_rate=1e-2)
    loop = rtg.OffPolicy(rtg.vectorize(MaskedProbe(), 4), learner, rtg.UniformReplay(200), warm_up=40, batch_size=8)

    def play(key: jax.Array) -> tuple[Any, Transition]:
        step = lambda state, k: (out := loop.step(state, k), (out[0], out[1][0]))[1]  # noqa: E731
        state, metrics = jax.lax.scan(step, loop.init(key), jax.random.split(key, 3))
        policy = loop.policy(state, explore=True)
        return metrics, rtg.collect(loop.env, policy, state.actor, key, 10)[1].transitions

    metrics, t = jit(play)(KEY)
    assert np.all(np.take_along_axis(t.observation[MASK], t.action[..., None], -1) == 1)
    assert float(t.reward.min()) == 1.0
    assert float(jnp.abs(metrics["q_mean"]).max()) < 100  # no forbidden value got into a target


def test_a_masked_action_is_not_bootstrapped_from():
    spec = EnvSpec(
        from_space(spaces.Dict({"x": spaces.Box(-9, 9, (2,), np.float32), MASK: spaces.MultiBinary(3)})),
        SPEC.action,
    )
    learner = rtg.DQN(network=LINEAR, gamma=0.9, epsilon=0.1)
    state = learner.init(spec, KEY)
    state = eqx.tree_at(
        lambda s: (s.network.head.layers[0].weight, s.target.head.layers[0].weight),
        state,
        (jnp.asarray(W), jnp.asarray(W_TARGET)),
    )
    masks = np.array([[0, 1, 1], [1, 1, 1], [0, 1, 0]], np.int8)
    b = batch()
    see = lambda x, m: {"x": jnp.asarray(x), MASK: jnp.asarray(m)}  # noqa: E731
    t = Transition(see(S, np.ones((3, 3), np.int8)), b.transitions.action, b.transitions.reward, b.transitions.terminated,
                   b.transitions.truncated, see(NEXT, masks), {})  # fmt: skip
    _, _, priorities = jit(lambda s, b: learner.update(s, b, KEY))(state, Batch(t, b.indices, b.weights))
    allowed = np.where(masks > 0, NEXT @ W_TARGET.T, -np.inf).max(1)
    np.testing.assert_allclose(priorities, np.abs(Q - (R + 0.9 * (1 - TERMINATED) * allowed)), rtol=1e-5)


@pytest.mark.parametrize(
    "space", [spaces.Box(-1, 1, (1,), np.float32), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)]
)
def test_other_actions_are_refused(space):
    with pytest.raises(ValueError, match="DQN chooses discrete actions"):
        rtg.DQN().init(EnvSpec(SPEC.observation, from_space(space)), KEY)


def test_standardised_observations_are_part_of_the_state():
    learner = rtg.DQN(network=LINEAR, normalise_observations=True, epsilon=0.1)
    state = learner.init(SPEC, KEY)
    new, _, _ = jit(lambda s, b: learner.update(s, b, KEY))(state, batch())
    np.testing.assert_allclose(new.norm.mean[""], S.mean(0), rtol=1e-6)
    policy = learner.policy(new, explore=False)
    q = policy.inspect(policy.init(KEY), jnp.asarray(S[0]))["q_values"]
    seen = (S[0] - S.mean(0)) / np.sqrt(S.var(0) + 1e-8)
    np.testing.assert_allclose(
        q, np.asarray(new.network.head.layers[0].weight) @ seen + np.asarray(new.network.head.layers[0].bias), rtol=1e-5
    )
