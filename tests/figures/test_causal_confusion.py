"""Causal confusion and its cures: items 2.16 to 2.18."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import env_spec
from rewardtogo.envs.imitation_problems import Braking, brake
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.figures.causal_confusion import BEST, SEEN, ask, clone, demonstrations
from rewardtogo.imitation import BC, as_expert, choose_graph_by_queries, choose_graph_by_return, with_random_graphs
from rewardtogo.imitation.causal import GraphPolicy
from rewardtogo.loops.offline import Offline
from rewardtogo.nn import MLP
from rewardtogo.runner.engine import run


def test_a_light_makes_it_look_better_and_drive_worse(item):
    plain, lit = clone(False), clone(True)
    with item("2.16") as check:
        check(lit.loss, "<", plain.loss, "validation loss with the light, against that without it")
        check(lit.earned / plain.earned, "<=", 0.8, "return with the light, in that without it")


def test_dagger_cures_it(item):
    rounds = ask()
    with item("2.17") as check:
        check(rounds[0] / BEST, "<", 0.8, "return of the policy of the expert's own data, in the expert's")
        check(rounds[-1] / BEST, ">=", 0.95, "return after ten rounds, in the expert's")


@pytest.fixture(scope="module")
def fitted():
    """Policies for all graphs, of five seeds."""
    key = jax.random.key(0)
    data = with_random_graphs(demonstrations(Braking(), key), SEEN, key)
    algorithm = Offline(data, BC(network=MLP(16), learning_rate=0.01), batch_size=1000, updates=10)
    state, _ = run(algorithm, jax.random.split(key, 5), 30)
    return [algorithm.policy(jax.tree.map(lambda x, i=i: x[i], state), explore=True) for i in range(5)]


def test_returns_choose_the_graph(fitted, item):
    env = vectorize(Braking(), 10)
    found = [choose_graph_by_return(env, p, SEEN, jax.random.key(i)) for i, p in enumerate(fitted)]
    right = sum(tuple(choice.graph) == (True, False) for choice in found)
    with item("2.18") as check:
        check(right, ">=", 4, "of 5 seeds in which returns choose the sensor and not the light")
    assert all(len(choice.scores) == 20 for choice in found)


def test_the_expert_chooses_the_graph(fitted, item):
    env = vectorize(Braking(), 10)
    expert = as_expert(brake, env_spec(env))
    found = [choose_graph_by_queries(env, p, expert, SEEN, jax.random.key(i)) for i, p in enumerate(fitted)]
    right = sum(tuple(choice.graph) == (True, False) for choice in found)
    with item("2.18") as check:
        check(right, ">=", 4, "of 5 seeds in which 32 answers choose the sensor and not the light")


def test_data_of_random_graphs(key):
    data = demonstrations(Braking(), key)
    more = with_random_graphs(data, (2, 0), key, copies=3)
    seen = np.asarray(more.transitions.observation)
    graph = seen[:, 2:]
    assert more.num_steps == 3 * data.num_steps and seen.shape[1] == 4
    assert set(np.unique(graph)) == {0.0, 1.0} and np.abs(graph.mean(0) - 0.5).max() < 0.15
    assert np.array_equal(seen[:, :2], np.tile(np.asarray(data.transitions.observation)[:, [2, 0]], (3, 1)) * graph)
    assert (graph.reshape(150, 100, 2) == graph.reshape(150, 100, 2)[:, :1]).all()
    assert np.array_equal(np.asarray(more.transitions.next_observation)[:, 2:], graph)
    assert np.array_equal(more.transitions.action, np.tile(data.transitions.action, 3))
    shown = GraphPolicy(as_expert(brake, data.spec), jnp.asarray([1.0, 0.0]), (2, 0)).shown(
        jnp.asarray([0.3, 0.5, 0.7])
    )
    assert np.allclose(shown, [0.7, 0.0, 1.0, 0.0])


def test_what_is_refused(fitted, key):
    env = vectorize(Braking(), 2)
    with pytest.raises(ValueError, match="no episode ended within 20 steps"):
        choose_graph_by_return(env, fitted[0], SEEN, key, steps=20)
    with pytest.raises(ValueError, match="at least 2 rounds"):
        choose_graph_by_return(env, fitted[0], SEEN, key, rounds=1)
    with pytest.raises(ValueError, match="40 states are fewer than 50 queries"):
        choose_graph_by_queries(
            env, fitted[0], as_expert(brake, env_spec(env)), SEEN, key, rounds=2, steps=10, queries=50
        )
    with pytest.raises(ValueError, match="each episode is there at least once"):
        with_random_graphs(demonstrations(Braking(), key), SEEN, key, copies=0)
