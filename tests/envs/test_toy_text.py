"""The twins of Gymnasium's toy environments: their tables against Gymnasium's, and steps against it."""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import MASK, from_space
from rewardtogo.envs.drawing import Pictured
from rewardtogo.envs.sparse import SparseEnv
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.toy_text import LIMIT, TABULAR, gymnasium_table, table_mdp, toy_text

VARIANTS: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in TABULAR),
    ("FrozenLake-v1", {"is_slippery": False}),
    ("FrozenLake-v1", {"map_name": "8x8", "success_rate": 0.8}),
    ("Taxi-v4", {"is_rainy": True}),
]
variants = pytest.mark.parametrize(("name", "kwargs"), VARIANTS, ids=[f"{n}{k or ''}" for n, k in VARIANTS])


@variants
def test_tables_are_gymnasiums(name, kwargs):
    env: Any = gymnasium.make(name, disable_env_checker=True, **kwargs).unwrapped
    mdp = table_mdp(gymnasium_table(name, **kwargs))
    assert mdp.successors.shape[:2] == (env.observation_space.n, env.action_space.n)
    np.testing.assert_array_equal(mdp.initial, env.initial_state_distrib)
    for s in np.flatnonzero(~mdp.terminal):
        for a in range(mdp.num_actions):
            listed = env.P[s][a]
            for k, (p, to, r, end) in enumerate(listed):
                found = (mdp.probabilities[s, a, k], mdp.successors[s, a, k], mdp.outcome_rewards[s, a, k])
                assert (*found, mdp.ends[s, a, k]) == (p, to, r, end)
            assert not mdp.probabilities[s, a, len(listed) :].any()
    # Nobody acts in a terminal state: every way in ends the episode.
    into = mdp.terminal[mdp.successors] & (mdp.probabilities > 0)
    assert mdp.ends[into].all() and not mdp.initial[mdp.terminal].any()


@variants
def test_spaces_limit_and_mask(name, kwargs):
    twin, own = rtg.make(name, 2, **kwargs), rtg.make(name, 2, backend="gymnasium", **kwargs)
    assert from_space(twin.observation_space) == from_space(own.observation_space)
    assert from_space(twin.action_space) == from_space(own.action_space)
    limit = gymnasium.spec(name).max_episode_steps
    made = toy_text(name, **kwargs)
    assert isinstance(made, TimeLimit) and made.max_steps == (limit or LIMIT)
    if name == "Taxi-v4":
        env: Any = gymnasium.make(name, **kwargs).unwrapped
        assert isinstance(made.env, Pictured)
        inner = made.env.env
        assert isinstance(inner, SparseEnv) and inner.masks is not None
        np.testing.assert_array_equal(inner.masks, [env.action_mask(s) for s in range(500)])


@pytest.mark.parametrize("name", ["FrozenLake-v1", "CliffWalking-v1", "Taxi-v4"])
def test_steps_are_in_gymnasiums_table_and_as_often(name):
    """Random play of the twin: each outcome is one that `P` lists, and their frequencies agree with its probabilities."""
    env: Any = gymnasium.make(name, disable_env_checker=True).unwrapped
    twin = rtg.make(name, 16)

    def play(key: jax.Array) -> Any:
        reset_key, action_key, step_key = jax.random.split(key, 3)
        state, first = twin.reset(jax.random.split(reset_key, 16))
        actions = jax.random.randint(action_key, (1000, 16), 0, env.action_space.n)

        def step(loop: tuple, given: tuple) -> tuple:
            (state, seen), (action, key) = loop, given
            after, t = twin.step(state, action, jax.random.split(key, 16))
            where = lambda o: o["observation"] if isinstance(o, dict) else o  # noqa: E731
            ended = (t.reward, t.terminated, t.truncated)
            return (after, t.observation), (
                where(seen),
                action,
                where(t.final_observation),
                *ended,
                where(t.observation),
            )

        return jax.lax.scan(step, (state, first), (actions, jax.random.split(step_key, 1000)))[1]

    s, a, to, r, end, cut, following = (np.asarray(x).reshape(-1) for x in jit(play)(jax.random.key(0)))
    counts: dict[tuple, int] = {}
    for key in zip(s.tolist(), a.tolist(), to.tolist(), r.tolist(), end.tolist(), strict=True):
        counts[key] = counts.get(key, 0) + 1
    expected: dict[tuple, float] = {}
    visits: dict[tuple, int] = {}
    for (state, action, *_), n in counts.items():
        visits[state, action] = visits.get((state, action), 0) + n
    for (state, action), n in visits.items():
        for p, successor, reward, ended in env.P[state][action]:
            key = (state, action, int(successor), float(reward), bool(ended))
            expected[key] = expected.get(key, 0.0) + p * n
    assert set(counts) <= set(expected)
    often = [key for key in expected if expected[key] >= 5]
    z = [(counts.get(key, 0) - expected[key]) / np.sqrt(expected[key]) for key in often]
    degrees = len(often) - len({key[:2] for key in often})
    if degrees:
        assert stats.chi2.sf(np.sum(np.square(z)), degrees) > 1e-3
    else:
        assert not np.any(z)
    starts = following[end | cut]
    assert (cut.any() or name == "FrozenLake-v1") and (end.any() or name != "FrozenLake-v1")
    assert env.initial_state_distrib[starts].min() > 0


def test_taxi_starts_in_each_of_its_300_states_alike():
    twin = toy_text("Taxi-v4")
    starts = jit(jax.vmap(lambda k: twin.reset(k)[1]["observation"]))(jax.random.split(jax.random.key(1), 60_000))
    counts = np.bincount(np.asarray(starts), minlength=500)
    assert (counts > 0).sum() == 300
    assert stats.chisquare(counts[counts > 0]).pvalue > 1e-3


def test_an_argument_that_the_table_does_not_know_goes_to_gymnasium():
    from rewardtogo.envs.gymnasium import hosted

    assert hosted(rtg.make("Taxi-v4", 1, fickle_passenger=True))
    assert not hosted(rtg.make("Taxi-v4", 1, is_rainy=True))


@pytest.mark.parametrize(
    ("name", "kwargs", "words"),
    [
        ("FrozenLake-v1", {"slippery": True}, "slippery=True is_slippery map_name"),
        ("FrozenLake-v1", {"map_name": "16x16"}, "map_name='16x16' map_name"),
        ("CartPole-v1", {}, "CartPole-v1 table FrozenLake-v1 `rtg train`"),
        ("FrozenLak-v1", {}, "FrozenLak"),
    ],
)
def test_what_has_no_table_is_refused(name, kwargs, words):
    with pytest.raises(ValueError) as refused:
        gymnasium_table(name, **kwargs)
    assert all(word in str(refused.value) for word in words.split())


def test_masks_are_of_the_state(key):
    twin = toy_text("Taxi-v4")
    state, observation = twin.reset(key)
    _, timestep = twin.step(state, jnp.asarray(0, jnp.int32), key)
    env: Any = gymnasium.make("Taxi-v4").unwrapped
    for seen in (observation, timestep.observation):
        np.testing.assert_array_equal(seen[MASK], env.action_mask(int(seen["observation"])))
