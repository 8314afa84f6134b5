"""Tabular Q-learning: updates by hand, convergence to Q*, the printed target, double tables, over-estimation."""

from typing import Any

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import MASK, EnvSpec, Rollout, Transition, from_space
from rewardtogo.envs.sparse import SparseEnv, SparseMDP
from rewardtogo.envs.tabular import TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.envs.toy_text import toy_text
from rewardtogo.exact import optimal_q_values
from rewardtogo.value.exploration import EpsilonGreedy
from rewardtogo.value.tabular_q import QLearning, QTableState, table_row, table_rows
from rewardtogo.value.theory import chance_of_best, expected_double_maximum, expected_maximum

SPEC = EnvSpec(from_space(spaces.Discrete(3)), from_space(spaces.Discrete(2)))
TABLE = np.array([[1.0, 2.0], [4.0, 3.0], [-1.0, -2.0]])


def rollout(mask: bool = False) -> Rollout:
    """Two steps of two environments: one terminated, one truncated; the last is the state and action of the first again."""
    s, a = np.array([[0, 1], [2, 0]], np.int32), np.array([[0, 1], [1, 0]], np.int32)
    r, to = np.array([[1.0, 0.5], [2.0, -1.0]], np.float32), np.array([[1, 2], [0, 1]], np.int32)
    terminated, truncated = np.array([[False, True], [False, False]]), np.array([[False, False], [True, False]])
    see = lambda x: {"observation": x, MASK: np.stack([np.ones_like(x), x != 1], -1).astype(np.int8)} if mask else x  # noqa: E731
    given = jax.tree.map(jnp.asarray, (see(s), a, r, terminated, truncated, see(to)))
    return Rollout(Transition(*given, {}), ())


@pytest.mark.parametrize("mask", [False, True])
def test_updates_worked_out_by_hand(mask):
    learner = QLearning(gamma=0.5, learning_rate=0.8, decay=0.5)
    spec = SPEC
    if mask:
        both = spaces.Dict({"observation": spaces.Discrete(3), MASK: spaces.MultiBinary(2)})
        spec = EnvSpec(from_space(both), SPEC.action)
    state = eqx.tree_at(
        lambda s: s.tables, learner.init(spec, jax.random.key(0)), jnp.asarray(TABLE[None], jnp.float32)
    )
    learner = eqx.tree_at(lambda x: x.exploration, learner, EpsilonGreedy(0.1))
    new, metrics, _ = jit(lambda s, b: learner.update(s, b, jax.random.key(0)))(state, rollout(mask))
    q = TABLE.copy()
    # In the masked state 1 the second action may not be taken; its value 4 is the first's anyway, then 3 + ... is not looked at.
    first = 1.0 + 0.5 * 4.0 - q[0, 0]
    q[0, 0] += 0.8 * first
    second = 0.5 - q[1, 1]  # terminated
    q[1, 1] += 0.8 * second
    third = 2.0 + 0.5 * max(q[0]) - q[2, 1]  # truncated: it bootstraps
    q[2, 1] += 0.8 * third
    ahead = q[1, 0] if mask else max(q[1])
    fourth = -1.0 + 0.5 * ahead - q[0, 0]
    q[0, 0] += 0.8 * 2**-0.5 * fourth  # the second visit
    np.testing.assert_allclose(new.tables[0], q, rtol=1e-6)
    np.testing.assert_array_equal(new.visits[0], [[2, 0], [0, 1], [0, 1]])
    assert float(metrics["td_error"]) == pytest.approx(np.mean(np.abs([first, second, third, fourth])), rel=1e-5)
    assert float(metrics["alpha"]) == pytest.approx(0.8 * (3 + 2**-0.5) / 4)


def test_double_learning_chooses_by_one_table_and_values_by_the_other():
    learner = QLearning(gamma=0.5, learning_rate=1.0, decay=0.0, double=True, exploration=EpsilonGreedy(0.1))
    tables = jnp.asarray(np.stack([TABLE, TABLE[:, ::-1] + 0.25]), jnp.float32)
    state = eqx.tree_at(lambda s: s.tables, learner.init(SPEC, jax.random.key(0)), tables)
    one = jax.tree.map(lambda x: x[:1, :1], rollout())  # state 0, action 0, reward 1, to state 1
    update = jit(lambda s, b, k: learner.update(s, b, k)[0])
    found = set()
    for i in range(12):
        new = update(state, one, jax.random.key(i))
        moved = [int(k) for k in range(2) if not np.array_equal(new.tables[k], tables[k])]
        assert len(moved) == 1
        which = moved[0]
        best = int(np.asarray(tables)[which, 1].argmax())
        assert float(new.tables[which, 0, 0]) == pytest.approx(1.0 + 0.5 * float(tables[1 - which, 1, best]))
        found.add(which)
    assert found == {0, 1}
    np.testing.assert_allclose(learner.policy(state, explore=False).table, np.asarray(tables).mean(0))


def trained(env: Any, learner: QLearning, iterations: int, unroll: int, keys: jax.Array) -> Any:
    """Tables, and steps and number of the episodes, of several seeds in one program."""

    def one(key: jax.Array) -> Any:
        loop = rtg.OnPolicy(env, learner, unroll=unroll).with_horizon(iterations)
        step = lambda s, k: (out := loop.step(s, k), (out[0], out[1][1]))[1]  # noqa: E731
        first, rest = jax.random.split(key)
        state, episodes = jax.lax.scan(step, loop.init(first), jax.random.split(rest, iterations))
        return state.learner.tables, episodes

    return jax.jit(jax.vmap(one))(keys)


def test_it_converges_to_q_star_whatever_policy_acts(item):
    """alpha = 1 / n^0.7 and uniformly random actions. The target as the notes print it goes elsewhere (E5.6)."""
    mdp = random_mdp(4, 4, 2, discount=0.7, num_terminal=1)
    q = optimal_q_values(mdp)
    learner = QLearning(gamma=0.7, decay=0.7, exploration=EpsilonGreedy(1.0))
    tables, _ = trained(rtg.vectorize(TabularEnv(mdp), 4), learner, 1500, 32, jax.random.split(jax.random.key(0), 1))
    error = np.abs(np.asarray(tables)[0, 0] - q)[~mdp.terminal].max()
    # y = r + γ max_a' Q(s, a'): of where one is, not of where one goes. Its fixed point:
    printed = mdp.rewards + 0.7 * mdp.rewards.max(-1, keepdims=True) / 0.3
    with item("5.19") as check:
        check(error, "<", 0.05, "||Q - Q*|| after 192,000 steps of random play, alpha = 1/n^0.7")
        check(np.abs(printed - q)[~mdp.terminal].max(), ">", 0.5, "E5.6: ||Q - Q*|| with max_a' Q(s_i, a')")


def test_the_cliff(item):
    env = rtg.vectorize(toy_text("CliffWalking-v1"), 1)
    learner = QLearning(gamma=1.0, decay=0.0, learning_rate=0.5, exploration=EpsilonGreedy(0.1))
    tables, _ = trained(env, learner, 400, 100, jax.random.split(jax.random.key(1), 2))
    from rewardtogo.envs.toy_text import gymnasium_table

    table: Any = gymnasium_table("CliffWalking-v1")
    with item("5.19") as check:
        for q in np.asarray(tables)[:, 0]:
            state, total, steps, done = 36, 0.0, 0, False
            while not done and steps < 100:
                _, state, reward, done = table.P[state][int(q[state].argmax())][0]
                total, steps = total + reward, steps + 1
            check(total, "==", -13, "CliffWalking: return of the greedy policy after 40,000 steps")


def test_double_learning_goes_the_wrong_way_less_often(item):
    """Sutton and Barto (2018), example 6.7: right ends with 0; left leads to ten actions of mean -0.1 and spread 1."""
    successors, masks = np.full((3, 10, 2), 2), np.zeros((3, 10), np.int8)
    successors[0, 0] = 1
    probabilities, rewards = np.full((3, 10, 2), 0.5), np.zeros((3, 10, 2))
    rewards[1] = [-1.1, 0.9]
    masks[0, :2] = masks[1] = masks[2] = 1
    env = SparseEnv(SparseMDP(successors, probabilities, rewards, 0, 1.0, np.arange(3) == 2), masks)
    left = {}
    for double in (False, True):
        learner = QLearning(
            gamma=1.0, learning_rate=0.1, decay=0.0, double=double, exploration=EpsilonGreedy(0.1, "uniform")
        )
        _, episodes = trained(rtg.vectorize(env, 1), learner, 300, 1, jax.random.split(jax.random.key(2), 400))
        # An episode that went left has two steps, another one.
        left[double] = float(episodes.length_sum.sum() / episodes.count.sum() - 1)
    with item("6.13") as check:
        check(left[False], ">", 0.25, "share of wrong lefts in the first 300 steps, Q-learning (5 % is exploration)")
        check(left[True], "<", 0.75 * left[False], "the same with two tables")


def test_over_estimation_in_closed_form(item):
    rng, n = np.random.default_rng(0), 400_000
    cases = [
        (np.zeros(2), 0.5642, "two N(0, 1)"),
        (np.zeros(10), 1.5388, "ten N(0, 1)"),
        (np.array([1.0, 0]), 1.1996, "N(1, 1), N(0, 1)"),
    ]
    with item("6.11") as check:
        for means, value, what in cases:
            draws = (rng.normal(size=(n, len(means))) + means).max(1)
            exact = expected_maximum(means)
            check(abs(exact - value), "<=", 5e-5, f"{what}: E max from {value}")
            check(abs(draws.mean() - exact) / (draws.std() / np.sqrt(n)), "<=", 3, f"{what}: sampled, standard errors")
            check(exact - means.max(), ">", 0, f"{what}: E max beyond max E")
        assert expected_maximum(np.zeros(2), np.array([3.0, 4.0])) == pytest.approx(5 / np.sqrt(2 * np.pi), abs=1e-9)
        assert chance_of_best(np.zeros(4)) == pytest.approx(0.25)


def test_double_estimates_are_not_above(item):
    rng, n = np.random.default_rng(1), 400_000
    for_one, for_two = rng.normal(size=(2, n, 2))
    equal = np.take_along_axis(for_two, for_one.argmax(1)[:, None], 1).mean()
    shifted = np.array([1.0, 0.0])
    under = np.take_along_axis(for_two + shifted, (for_one + shifted).argmax(1)[:, None], 1)[:, 0]
    with item("6.13") as check:
        check(abs(equal), "<=", 0.01, "bias of the double estimate, equal means")
        check(abs(expected_double_maximum(shifted) - 0.7602), "<=", 5e-5, "E6.3: means 1 and 0, from Φ(1/√2) = .7602")
        z = abs(under.mean() - expected_double_maximum(shifted)) / (under.std() / np.sqrt(n))
        check(z, "<=", 3, "the same sampled, standard errors")
        check(expected_double_maximum(shifted), "<", 1, "which is below the best mean, 1")


def test_the_value_of_the_best_is_the_best_value(item):
    rng = np.random.default_rng(0)
    tables = np.concatenate([rng.normal(size=(500, 4, 3)), rng.integers(0, 2, (500, 4, 3))]).astype(np.float32)
    of_best = jnp.take_along_axis(jnp.asarray(tables), jnp.argmax(tables, -1)[..., None], -1)[..., 0]
    with item("6.15") as check:
        check(
            np.abs(np.asarray(of_best) - tables.max(-1)).max(),
            "==",
            0,
            "max_a Q - Q(argmax_a Q), 1000 tables, half with ties",
        )


def test_observations_of_several_discrete_parts_have_rows():
    space = spaces.Dict({"a": spaces.Discrete(3), "b": spaces.MultiDiscrete([2, 4]), MASK: spaces.MultiBinary(2)})
    spec = from_space(space)
    assert table_rows(spec) == 24
    rows = {
        int(table_row(spec, {"a": jnp.asarray(a), "b": jnp.asarray([b, c])}))
        for a in range(3)
        for b in range(2)
        for c in range(4)
    }
    assert rows == set(range(24))


@pytest.mark.parametrize(
    ("observation", "action", "words"),
    [
        (spaces.Box(-1, 1, (4,), np.float32), spaces.Discrete(2), "box of shape (4,) dqn FrozenLake-v1"),
        (spaces.Discrete(4), spaces.Box(-1, 1, (1,), np.float32), "QLearning discrete box `rtg list`"),
        (spaces.Dict({MASK: spaces.MultiBinary(2)}), spaces.Discrete(2), "nothing but a mask"),
        (spaces.MultiDiscrete([10_000, 100_000]), spaces.Discrete(2), "1,000,000,000 observations does not fit dqn"),
    ],
)
def test_what_no_table_can_hold_is_refused(observation, action, words):
    with pytest.raises(ValueError) as refused:
        QLearning().init(EnvSpec(from_space(observation), from_space(action)), jax.random.key(0))
    assert all(word in str(refused.value) for word in words.split()), str(refused.value)


def test_a_state_is_arrays_and_a_static_spec():
    state = QLearning(initial=2.0, double=True).init(SPEC, jax.random.key(0))
    assert isinstance(state, QTableState) and state.tables.shape == (2, 3, 2) and float(state.tables.min()) == 2.0
    assert state.spec == SPEC.observation
