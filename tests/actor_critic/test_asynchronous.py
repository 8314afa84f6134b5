"""Workers with parameters of different ages around one learner."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit, small, small_env
from rewardtogo.envs.probes import MatchingReward

KEY = jax.random.key(0)


def make(workers: int = 4, order: Any = "in_turn", **options: Any) -> rtg.Asynchronous:
    learner = rtg.PolicyGradient(network=small, returns="vtrace", gae_lambda=1.0, value_updates=1, **options)
    return rtg.Asynchronous(rtg.vectorize(small_env(), 2), learner, workers, 6, order)


def run(algorithm: rtg.Asynchronous, iterations: int) -> tuple[Any, dict[str, np.ndarray]]:
    def step(state: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        state, (metrics, _) = algorithm.step(state, key)
        return state, metrics

    def whole(key: jax.Array) -> Any:
        return jax.lax.scan(step, algorithm.init(key), jax.random.split(key, iterations))

    state, metrics = jit(whole)(KEY)
    return state, jax.device_get(metrics)


def test_in_turn_every_rollout_is_as_old_as_the_others_took(item):
    state, metrics = run(make(4), 20)
    with item("4.27") as check:
        check(
            metrics["lag"][:4].tolist() == [0, 1, 2, 3], "==", True, "the first rollouts, made before any update, age"
        )
        check(metrics["lag"][4:].min(), "==", 3, "lag of every later one with four workers")
        check(metrics["lag"][4:].max(), "==", 3, "likewise, the greatest")
        check(
            float(np.abs(metrics["behaviour_kl"][4:]).max()),
            ">",
            0,
            "KL of the policy that acted from the one that learns",
        )
    with item("4.26") as check:
        check(
            int(state.updates) - int(state.learner.updates), "==", 0, "updates of the server less those of the learner"
        )
        check(int(state.learner.updates), "==", 20, "no update is lost")


def test_at_random_lags_are_spread(item):
    _, metrics = run(make(4, "random"), 400)
    lags = metrics["lag"][20:]
    with item("4.27") as check:
        check(
            abs(lags.mean() - 3) / (lags.std() / np.sqrt(len(lags) / 4)),
            "<=",
            4,
            "standard errors of the mean lag from W - 1",
        )
        check(len(np.unique(lags)), ">=", 6, "different lags in the histogram")


def test_one_worker_is_never_late(item):
    """Then it is synchronous: the ratio is 1, and V-trace changes nothing."""
    state, metrics = run(make(1, max_grad_norm=1e9), 5)
    learner = rtg.PolicyGradient(
        network=small, returns="reward_to_go", value_updates=1, max_grad_norm=1e9, normalise_advantages=True
    )
    same, _ = run(rtg.Asynchronous(rtg.vectorize(small_env(), 2), learner, 1, 6), 5)
    gap = max(
        float(np.abs(a - b).max(initial=0))
        for a, b in zip(jax.tree.leaves(state.learner.network), jax.tree.leaves(same.learner.network), strict=True)
    )
    with item("4.26") as check:
        check(np.abs(metrics["lag"]).max(), "==", 0, "lag of a single worker")
        check(np.abs(metrics["largest_ratio"] - 1).max(), "<=", 1e-5, "its ratios, from 1")
        check(gap, "<=", 2e-3, "parameters from those of the synchronous learner after five updates")


def test_workers_keep_environments_and_parameters_of_their_own():
    state, _ = run(make(3), 4)
    observations = state.actors.observation
    assert observations.shape[:2] == (3, 2)
    assert len({tuple(o.ravel().tolist()) for o in observations}) == 3
    heads = state.acting.network.head.linear.weight
    assert state.fetched.tolist() == [4, 2, 3]
    assert not np.array_equal(heads[0], heads[1])
    np.testing.assert_array_equal(heads[0], state.learner.network.head.linear.weight)


def test_stale_data_reaches_a_good_policy(item):
    """With lags of eight updates the values and actions are those of the synchronous learner."""
    probe = MatchingReward()

    def reward_of(workers: int) -> float:
        learner = rtg.PolicyGradient(
            network=small, returns="vtrace", gamma=0.5, learning_rate=1e-2, value_learning_rate=2e-2, value_updates=4
        )
        algorithm = rtg.Asynchronous(rtg.vectorize(probe, 4), learner, workers, 8)
        policy = algorithm.policy(run(algorithm, 300)[0])
        seen = jit(jax.vmap(lambda o: policy.inspect(policy.init(KEY), o)))(probe.observations())
        return float(np.diag(seen["probabilities"]).mean())

    found = {workers: reward_of(workers) for workers in (1, 9)}
    with item("4.27") as check:
        check(found[9] / found[1], ">=", 0.9, "return with lag 8 over the synchronous one")


def test_learners_of_transitions_are_refused():
    with pytest.raises(ValueError, match="OffPolicy"):
        rtg.Asynchronous(rtg.vectorize(small_env(), 2), rtg.DQN(network=small))
    with pytest.raises(ValueError, match="workers"):
        make(0)
    assert jnp.all(make(2).spec.action.counts[0] == 2)
