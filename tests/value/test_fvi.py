"""Fitted value iteration with a network: its target against what can be computed by hand, and what it refuses."""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit, small
from rewardtogo.core import Batch, EnvSpec, Observed, Timestep, Transition, from_space
from rewardtogo.envs import Simulator
from rewardtogo.runner.plan import Plan, from_config, plan

SPEC = EnvSpec(from_space(spaces.Box(-9, 9, (2,), np.float32)), from_space(spaces.Discrete(2)))


class Coin(Observed):
    """s' = s + (1, 0) or, by action 1, s + (0, z) with z either -2 or 2; the reward is the sum of s', and beyond 3 it ends."""

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-9, 9, (2,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = jax.random.uniform(key, (2,))
        return state, state

    def state_of(self, observation: jax.Array) -> jax.Array:
        return observation

    def step(self, state: jax.Array, action: jax.Array, key: jax.Array) -> tuple[jax.Array, Timestep]:
        tossed = jnp.where(jax.random.bernoulli(key), 2.0, -2.0)
        state = state + jnp.where(action == 0, jnp.asarray([1.0, 0.0]), jnp.stack([jnp.zeros(()), tossed]))
        ended = state.sum() > 3.0
        return state, Timestep(state, state.sum(), ended, jnp.zeros((), bool), state, {})


def batch_of(x: np.ndarray, weights: np.ndarray) -> Batch:
    """The transitions say nothing but where they began: their actions, rewards and ends are not looked at."""
    n = len(x)
    t = Transition(
        jnp.asarray(x, jnp.float32),
        jnp.zeros(n, jnp.int32),
        jnp.full(n, jnp.nan),
        jnp.ones(n, bool),
        jnp.zeros(n, bool),
        jnp.full((n, 2), jnp.nan),
        {},
    )
    return Batch(t, jnp.arange(n, dtype=jnp.int32), jnp.asarray(weights, jnp.float32))


def test_the_target_is_the_best_action_s_expectation(item):
    """max outside, E inside: with 4,096 outcomes against both coins enumerated; the maximum of one outcome would be another number."""
    learner = rtg.FVI(dynamics=Coin(), network=small, epsilon=0.1, samples=4096, gamma=0.9)
    state = learner.init(SPEC, jax.random.key(0))
    v = jit(lambda x: state.target(x))
    x = np.array([-1.0, 0.5], np.float32)

    def one(after: np.ndarray) -> float:
        return float(after.sum()) + (0.0 if after.sum() > 3 else 0.9 * float(v(jnp.asarray(after))))

    sides = [one(x + np.array([0, z], np.float32)) for z in (-2, 2)]
    exact = np.array([one(x + np.array([1, 0], np.float32)), np.mean(sides)])
    found = jit(lambda key: learner.policy(state, False).q_values(jnp.asarray(x), key))(jax.random.key(1))
    spread = abs(sides[0] - sides[1]) / 2 / np.sqrt(4096)
    with item("5.11") as check:
        check(float(np.abs(np.asarray(found) - exact)[0]), "<=", 1e-5, "deep: the certain action")
        check(
            float(np.abs(np.asarray(found) - exact)[1]),
            "<=",
            4 * spread,
            "deep: the random action, four standard errors",
        )
    inside = np.mean([max(exact[0], side) for side in sides])
    assert inside > exact.max() + 10 * spread


def test_a_regression_lasts_as_long_as_its_target():
    learner = rtg.FVI(
        dynamics=Coin(), network=small, epsilon=0.1, samples=1, target_period=3, gamma=0.5, max_grad_norm=1e6
    )
    state = learner.init(SPEC, jax.random.key(0))
    weights = np.array([1.0, 0.5, 2.0])
    batch = batch_of(np.array([[0.0, 0.0], [2.0, 0.5], [3.0, 3.0]]), weights)
    key = jax.random.key(7)
    update = jit(lambda s: learner.update(s, batch, key))
    keys = jax.random.split(key, 3)
    y = jit(jax.vmap(lambda o, k: learner.policy(state, False).q_values(o, k).max()))(
        batch.transitions.observation, keys
    )
    first = state.target
    for i in range(3):
        jax.tree.map(np.testing.assert_array_equal, state.target, first)
        before = jax.vmap(state.network.__call__)(batch.transitions.observation)
        state, metrics, priorities = update(state)
        np.testing.assert_allclose(metrics["v_loss"], 0.5 * np.mean(weights * np.asarray(before - y) ** 2), rtol=1e-5)
        np.testing.assert_allclose(priorities, np.abs(before - y), rtol=1e-4)
        assert int(state.updates) == i + 1
    jax.tree.map(np.testing.assert_array_equal, state.target, state.network)
    values = jit(jax.vmap(lambda network, x: network(x), (None, 0)))
    seen = batch.transitions.observation
    assert np.abs(values(state.network, seen) - values(first, seen)).max() > 1e-4


def test_the_policy_looks_one_step_ahead():
    """With a value of zero everywhere it takes the larger reward; explored, every action comes up."""
    learner = rtg.FVI(dynamics=rtg.envs.CartPole(), network=small, epsilon=0.1)
    env = rtg.envs.CartPole()
    spec = EnvSpec(from_space(env.observation_space), from_space(env.action_space))
    state = learner.init(spec, jax.random.key(0))
    fallen_left = jnp.asarray([0.0, 0.0, -0.2, -0.5])
    falling = lambda v: eqx.tree_at(lambda n: n.head.weight, v, jnp.zeros_like(v.head.weight))  # noqa: E731
    policy = learner.policy(eqx.tree_at(lambda s: s.network, state, falling(state.network)), False)
    q = jit(lambda: policy.q_values(fallen_left, jax.random.key(0)))()
    np.testing.assert_allclose(q, 1.0)  # both steps are rewarded, and the value of what follows is nothing
    act = jit(jax.vmap(lambda p, key: p((), fallen_left, key)[1], (None, 0)))
    explored = eqx.tree_at(lambda p: p.epsilon, policy, jnp.ones(()))
    keys = jax.random.split(jax.random.key(0), 256)
    assert set(np.asarray(act(policy, keys))) == {0}
    assert 96 <= int(np.asarray(act(explored, keys)).sum()) <= 160


@pytest.mark.parametrize(
    ("learner", "words"),
    [
        (lambda: rtg.FVI(network=small), "simulator dynamics=CartPole()"),
        (lambda: rtg.FVI(dynamics=Simulator("CartPole-v1")), "CartPole another (4,) (2,)"),
        (lambda: rtg.FVI(dynamics=Simulator("CartPole-v2")), "'CartPole-v2' CartPole-v1"),
        (lambda: rtg.FVI(dynamics=Simulator("FrozenLake-v1")), "FrozenLake-v1 state fqi"),
        (lambda: rtg.FVI(dynamics=Simulator()), "name"),
        (lambda: rtg.FVI(dynamics=Coin(), network=rtg.GRU(4)), "without a memory"),
    ],
)
def test_what_cannot_be_is_refused(learner, words):
    with pytest.raises(ValueError) as refused:
        learner().init(SPEC, jax.random.key(0))
    assert all(word in str(refused.value) for word in words.split()), refused.value


def learner_of(made: Plan) -> rtg.FVI:
    return made.algorithm.learner  # type: ignore[attr-defined]


def test_a_run_knows_its_own_environment():
    """`rtg train fvi CartPole-v1` fills the simulator in, writes its name down, and reads it back."""
    made = plan("fvi", "CartPole-v1", steps=64)
    for again in (made, from_config(made.config, steps=None)):
        learner = learner_of(again)
        assert learner.dynamics == Simulator("CartPole-v1")
        assert isinstance(learner.simulator, rtg.envs.CartPole)
    own = learner_of(plan("fvi", rtg.envs.TimeLimit(rtg.envs.CartPole(), 16), steps=64))
    assert isinstance(own.dynamics, rtg.envs.CartPole), "a time limit is no property of the dynamics"


@pytest.mark.slow
def test_cartpole_by_fitted_values(tmp_path, item):
    run = rtg.train("fvi", "CartPole-v1", steps=30_000, seed=0, out=tmp_path / "run", quiet=True)
    with item("5.11") as check:
        check(run.evaluation["return_mean"], ">=", 475, "CartPole-v1, deep, 30,000 steps, 100 episodes")
