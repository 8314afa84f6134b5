"""What replay, several steps and double Q-learning change, in small problems whose values are known."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import Spec, Transition
from rewardtogo.envs.probes import TruncatedLoop
from rewardtogo.envs.tabular import MDP, TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.exact import optimal_q_values
from rewardtogo.figures import overestimation
from rewardtogo.ops import Linear
from rewardtogo.value.general import Rates, online_q_learning, replay_q_learning
from rewardtogo.value.overestimation import check_values, compare

KEY = jax.random.key(0)
SEEDS = jax.vmap(jax.random.key)(jnp.arange(6))


def chain(length: int, discount: float) -> MDP:
    """States in a row; actions are left, with a wall at the end, and right, with a reward of 1 and the end after the last."""
    transitions, rewards = np.zeros((length + 1, 2, length + 1)), np.zeros((length + 1, 2))
    for state in range(length):
        transitions[state, 0, max(0, state - 1)] = transitions[state, 1, state + 1] = 1
    transitions[length, :, length] = 1
    rewards[length - 1, 1] = 1
    initial = (np.arange(length + 1) < length) / length
    return MDP(transitions, rewards, initial, discount, np.arange(length + 1) == length)


def train(loop: rtg.OffPolicy, iterations: int, look: Any) -> Any:
    """`look(learner state, rows just collected)` after each iteration, for every seed: `[seeds, iterations]`."""
    loop = loop.with_horizon(iterations)

    def one(key: jax.Array) -> Any:
        def body(state: Any, i: jax.Array) -> tuple[Any, Any]:
            after, _ = loop.step(state, jax.random.fold_in(key, i))
            return after, look(after)

        return jax.lax.scan(body, loop.init(key), jnp.arange(iterations))[1]

    return jax.device_get(jit(jax.vmap(one))(SEEDS))


def q_table(network: Any, states: int) -> jax.Array:
    return jax.vmap(lambda s: network((), s)[1][:, 0])(jnp.arange(states))


# --- replay ----------------------------------------------------------------------------------------------------------


class Position(eqx.Module):
    """A state's place in the row as one number, through one hidden layer: what is learnt of one state moves the others."""

    layer: Any
    states: int = eqx.field(static=True)

    def __call__(self, state: jax.Array) -> jax.Array:
        return jnp.tanh(self.layer(2.0 * state.astype(jnp.float32)[None] / self.states - 1.0))


def position(spec: Spec, key: jax.Array) -> Position:
    layer = rtg.nn.Linear.of(1, 24, key, gain=4.0)
    return Position(layer, spec.counts[0])


def test_steps_in_their_order_are_a_bad_batch(item):
    """Online Q-learning against the same with a replay: batches, updates and steps alike."""
    problem = chain(12, 0.9)
    env, truth = rtg.vectorize(TabularEnv(problem), 1), optimal_q_values(problem)[:12]
    learner = rtg.DQN(network=position, gamma=0.9, epsilon=0.5, optimiser="sgd", learning_rate=0.1, huber=1e9)
    online = online_q_learning(env, learner)
    replay = replay_q_learning(env, learner, capacity=2000, batch_size=1, warm_up=500)
    assert Rates.of(online).steps_per_update == Rates.of(replay).steps_per_update == 1

    def look(state: Any) -> tuple[jax.Array, jax.Array]:
        return jnp.abs(q_table(state.learner.network, 12) - truth).mean(), state.actor.observation[0]

    (error, at), (error_replay, _) = train(online, 6000, look), train(replay, 6000, look)
    key, size = jax.random.key(1), 4000
    drawn = np.asarray(jax.vmap(lambda k: jax.random.randint(k, (), 0, size))(jax.random.split(key, size)))
    correlation = lambda x: float(np.corrcoef(x[:-1], x[1:])[0, 1])  # noqa: E731
    with item("6.1") as check:
        check(
            min(correlation(x) for x in at),
            ">",
            0.5,
            "correlation of a state with the one learnt from before, online",
        )
        check(abs(correlation(drawn)), "<", 0.05, "the same of places in a replay")
        late = [np.median(e[:, -2000:].mean(1)) for e in (error, error_replay)]
        check(late[0] / late[1], ">", 1.2, "error over all states, online to replay")


def test_algorithm_11_finds_q_star(item):
    problem = random_mdp(3, 4, 3, discount=0.8)
    env = rtg.vectorize(TabularEnv(problem), 4)
    learner = rtg.DQN(
        network=rtg.MLP(),
        gamma=0.8,
        epsilon=0.5,
        optimiser="sgd",
        learning_rate=Linear(1.0, 0.02),
        huber=1e9,
        max_grad_norm=1e9,
    )
    loop = replay_q_learning(env, learner, capacity=20_000, collect=8, updates=4, warm_up=2000)
    q = train(loop, 1500, lambda s: q_table(s.learner.network, 4))[:, -1]
    with item("6.3") as check:
        error = np.abs(q - optimal_q_values(problem)).max((1, 2))
        check(float(np.median(error)), "<=", 0.05, "Algorithm 11 in a random problem, distance from Q*")


def test_several_steps_learn_sooner(item):
    problem = chain(19, 0.95)
    env = rtg.vectorize(TabularEnv(problem), 1)

    def steps_needed(n: int) -> float:
        learner = rtg.DQN(
            network=rtg.MLP(), gamma=0.95, epsilon=0.3, optimiser="sgd", learning_rate=1.0, n_step=n, target_period=20
        )
        loop = rtg.OffPolicy(
            env, learner, rtg.UniformReplay(5000), unroll=5, updates=2, batch_size=32, warm_up=1000, length=n
        )
        right = train(loop, 800, lambda s: (jnp.diff(q_table(s.learner.network, 19), axis=1)[:, 0] > 0).mean())
        return float(np.median(np.where(right.max(1) >= 0.9, (right >= 0.9).argmax(1), 800))) * loop.steps_per_iteration

    one, five = steps_needed(1), steps_needed(5)
    with item("6.20") as check:
        check(one, "<", 4000, "environment steps until 90 % of the states go right, N = 1 (it gets there)")
        check(five / one, "<", 0.7, "N = 5 in parts of N = 1")


# --- over-estimation -------------------------------------------------------------------------------------------------


def test_double_q_learning_overrates_less(item):
    """The curves of `rtg figure overestimation`: estimated against true values of the greedy policy, from the same states."""
    found = {double: overestimation.curves(double) for double in (False, True)}
    late = {double: np.median((estimated / true - 1)[:, -10:].mean(1)) for double, (estimated, true) in found.items()}
    with item("6.12") as check:
        check(
            late[False] - late[True],
            ">",
            0.02,
            "median excess of DQN less that of double DQN, in parts of the true value",
        )
        check(late[True], ">", -0.05, "median excess of double DQN")
        check(float(np.abs(np.median(found[False][1]) - 10)), "<", 0.5, "true value by Monte Carlo, less 10")


def test_true_values_by_hand():
    """Two steps, then the end; then three of an episode that is cut, which count only where the rest is small."""
    reward, value = jnp.asarray([[1.0], [2.0], [4.0], [8.0], [1.0]]), jnp.asarray([[5.0], [6.0], [7.0], [8.0], [9.0]])
    terminated, truncated = jnp.arange(5)[:, None] == 1, jnp.arange(5)[:, None] == 4
    seen = jnp.zeros((5, 1, 1))
    t = Transition(seen, jnp.zeros((5, 1), jnp.int32), reward, terminated, truncated, seen, {"value": value})
    found = compare(t, 0.5, tolerance=0.0)
    np.testing.assert_allclose((found.estimated, found.true, found.states), (5.5, (2.0 + 2.0) / 2, 2), rtol=1e-6)
    found = compare(t, 0.5, tolerance=0.125)  # the third step too: 0.5^3 of what lies beyond is missing
    np.testing.assert_allclose((found.estimated, found.true, found.states), (6.0, (2 + 2 + 8.25) / 3, 3), rtol=1e-6)


def test_values_of_a_cut_loop_are_not_those_of_its_cut():
    """Reward 1 for ever, cut after 10 steps: at gamma 0.3 some states are known, at 0.99 none."""
    env = rtg.vectorize(TruncatedLoop(), 2)
    learner = rtg.DQN(network=rtg.MLP(), epsilon=0.1)
    policy = learner.policy(learner.init(rtg.core.env_spec(env), KEY), explore=False)
    one, other = (jit(lambda p, g: check_values(env, p, KEY, gamma=g, steps=20))(policy, g) for g in (0.3, 0.99))
    np.testing.assert_allclose(one.true, 1 / 0.7, rtol=0.01)
    assert int(other.states) == 0


def test_a_policy_without_values_has_none_to_check():
    env = rtg.vectorize(TruncatedLoop(), 2)
    with pytest.raises(ValueError, match="a RandomPolicy says no value"):
        check_values(env, rtg.loops.RandomPolicy(rtg.core.env_spec(env)), KEY, gamma=0.9, steps=3)
