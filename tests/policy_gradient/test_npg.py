"""The natural policy gradient against dense linear algebra and the gradient it comes from."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit, lstm, small, small_env
from rewardtogo.policy_gradient.fisher import fisher_matrix, mean_kl
from rewardtogo.policy_gradient.fit import action_laws, actor_parameters, samples_of
from rewardtogo.policy_gradient.npg import NPG

KEY = jax.random.key(0)
LENGTH = 40
ENV = rtg.vectorize(small_env(), 4)
PLAIN: dict[str, Any] = {
    "network": small,
    "gamma": 0.97,
    "gae_lambda": 0.9,
    "cg_iterations": 60,
    "value_epochs": 1,
    "normalise_observations": True,
}


@functools.cache
def played(network: Any = small) -> tuple[Any, Any]:
    """A state after two updates, and a fresh rollout of its policy."""
    loop = rtg.OnPolicy(ENV, NPG(**{**PLAIN, "network": network}), unroll=LENGTH)

    def play(key: jax.Array) -> tuple[Any, Any]:
        state = jax.lax.fori_loop(0, 2, lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0], loop.init(key))
        return state.learner, rtg.collect(ENV, loop.policy(state, explore=True), state.actor, key, LENGTH)[1]

    return jit(play)(KEY)


def step_of(learner: Any, state: Any, rollout: Any) -> tuple[np.ndarray, Any, Any]:
    """How an update moves the parameters of the policy; the new state; the metrics."""
    new, metrics, feedback = jit(lambda s, r: learner.update(s, r, KEY))(state, rollout)
    assert feedback == ()
    moved = np.asarray(actor_parameters(new.network)[0], np.float64) - actor_parameters(state.network)[0]
    return moved, new, metrics


@functools.cache
def dense() -> tuple[np.ndarray, np.ndarray]:
    """The policy gradient, as the mean of score times advantage, and F + 0.1 I, in float64 from there on."""
    state, rollout = played()
    samples = samples_of(state.network, state.norm, rollout, 0.97, 0.9, True, 32)
    theta, network_of = actor_parameters(state.network)
    score = lambda x: jax.vmap(lambda law, a: law.log_prob(a))(action_laws(network_of(x), samples), samples.action)  # noqa: E731
    gradient = jit(jax.grad(lambda x: (score(x) * samples.advantage).mean()))(theta)
    matrix = jit(lambda x: fisher_matrix(lambda x: action_laws(network_of(x), samples), x, 0.1))(theta)
    return np.asarray(gradient, np.float64), np.asarray(matrix, np.float64)


def gap(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def test_a_step_by_kl(item):
    state, rollout = played()
    gradient, matrix = dense()
    direction = np.linalg.solve(matrix, gradient)
    moved, new, metrics = step_of(NPG(**PLAIN, kl_step=1e-3), state, rollout)
    expected = np.sqrt(2 * 1e-3 / (gradient @ direction)) * direction
    with item("7.24") as check:
        check(gap(moved, expected), "<=", 1e-3, "step of NPG against sqrt(2 eps / g'F^-1 g) F^-1 g, dense, float32")
        check(0.5 * moved @ matrix @ moved / 1e-3, "<=", 1.001, "d'(F + xi I)d / 2 over eps")
    samples = samples_of(state.network, state.norm, rollout, 0.97, 0.9, True, 32)
    kl = mean_kl(action_laws(state.network, samples), action_laws(new.network, samples))
    assert float(metrics["kl"]) == pytest.approx(float(kl), rel=1e-3)
    # Part of what damping allows for is not KL.
    assert 1e-4 < float(kl) < 1.05e-3
    assert float(metrics["grad_norm"]) == pytest.approx(np.linalg.norm(gradient), rel=1e-3)
    assert int(new.updates) == 3
    assert float(new.norm.count) == 3 * LENGTH * 4


def test_a_step_by_rate():
    gradient, matrix = dense()
    moved, _, metrics = step_of(NPG(**PLAIN, step_by="rate", learning_rate=0.02), *played())
    assert gap(moved, 0.02 * np.linalg.solve(matrix, gradient)) <= 1e-3
    assert float(metrics["step_size"]) == pytest.approx(0.02)


def test_without_the_matrix_it_is_the_policy_gradient():
    """A damping of 1e4 leaves nothing of F: the step is alpha / 1e4 times g."""
    gradient, _ = dense()
    moved, _, _ = step_of(NPG(**PLAIN, step_by="rate", damping=1e4, learning_rate=1e4 * 0.1), *played())
    assert gap(moved, 0.1 * gradient) <= 1e-3


def test_with_a_memory():
    """Every second sequence for the Fisher matrix."""
    state, rollout = played(lstm)
    learner = NPG(**{**PLAIN, "network": lstm}, fisher_every=2, entropy_cost=0.01)
    moved, new, metrics = step_of(learner, state, rollout)
    assert all(np.isfinite(float(value)) for value in metrics.values())
    assert 1e-3 < float(metrics["kl"]) < 3e-2
    assert np.abs(moved).max() > 0
    assert int(new.updates) == 3


@pytest.mark.parametrize(
    "wrong",
    [
        {"kl_step": 0.0},
        {"kl_step": -1.0},
        {"learning_rate": 0.0},
        {"damping": -0.1},
        {"cg_iterations": 0},
        {"fisher_every": 0},
        {"value_epochs": 0},
    ],
)
def test_what_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        NPG(**wrong)


def test_numbers_may_be_schedules():
    learner = NPG(network=small, kl_step=rtg.ops.Linear(0.02, 0.0, 10))
    _, new, metrics = step_of(learner, *played())
    assert 0 < float(metrics["kl"]) < 0.02
    assert jnp.isfinite(actor_parameters(new.network)[0]).all()
