"""Objectives of latent models where all of them are exact: against the likelihood of the Kalman filter and closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.model_based.latent_linear import (
    evidence_bound,
    expectation_maximisation,
    expected_objective,
    filter_encoder,
    fit_dynamics,
    fit_linear_gaussian,
    fully_observed_objective,
    pairwise_encoder,
    posterior_entropy,
    prior_states,
    single_frame_encoder,
)
from rewardtogo.ops import LinearGaussian, kalman_filter, simulate_linear

KEY = jax.random.key(0)
T = 40


def truth() -> LinearGaussian:
    """A point on a line, pushed, with friction and a spring: position and velocity, of which the position is seen."""
    F = np.array([[1.0, 0.3, 0.0], [-0.2, 0.9, 0.3]])
    return LinearGaussian(
        F, np.diag([0.01, 0.02]), np.array([[1.0, 0.0]]), np.array([[0.05]]), np.zeros(2), 0.5 * np.eye(2)
    )


def episodes(system: LinearGaussian, count: int, seed: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """States, observations and actions of episodes."""
    actions = jnp.asarray(np.random.default_rng(seed).normal(size=(count, T - 1, 1)))
    keys = jax.random.split(jax.random.key(seed), count)
    states, seen = jax.jit(jax.vmap(lambda u, k: simulate_linear(system, u, k)))(actions, keys)
    return states, seen, actions


def per_observation(system: LinearGaussian, seen: jax.Array, actions: jax.Array) -> float:
    """Log-likelihood by the Kalman filter."""
    known = jax.jit(jax.vmap(lambda o, u: kalman_filter(system, o, u).log_likelihood))(seen, actions)
    return float(known.mean())


def test_fully_observed_is_maximum_likelihood(item, x64):
    """Least squares has no gradient left in the objective, and is worth more than the truth on its own data."""
    system = truth()
    states, _, actions = episodes(system, 1, 0)
    F, f, noise = fit_dynamics(states[0, :-1], actions[0], states[0, 1:])
    fitted = eqx.tree_at(lambda s: (s.F, s.f, s.noise), system, (F, f, noise))
    objective = lambda s: fully_observed_objective(s, states[0], actions[0])  # noqa: E731
    slope = jax.grad(objective)(fitted)
    with item("8.65") as check:
        most = max(float(jnp.abs(g).max()) for g in (slope.F, slope.f, slope.noise))
        check(most, "<=", 1e-8, "gradient of the mean log-likelihood at the closed form")
        check(float(objective(fitted) - objective(system)), ">=", 0, "its gain over the truth on its own data")
        # At the maximum the objective is minus the entropy of the noise.
        entropy = 0.5 * float(jnp.linalg.slogdet(2 * np.pi * np.e * noise)[1])
        check(abs(float(objective(fitted)) + entropy), "<=", 1e-9, "objective plus entropy of the noise")


def test_bounds_of_the_likelihood(item, x64):
    """Exact for the posterior; below it for the filter and for single frames; each encoder knows the velocity less well."""
    system = truth()
    states, seen, actions = episodes(system, 200, 1)

    def bounds(o: jax.Array, u: jax.Array) -> tuple[jax.Array, ...]:
        encoders = (
            pairwise_encoder(system, o, u),
            filter_encoder(system, o, u),
            single_frame_encoder(system, prior_states(system, u), o),
        )
        values = jnp.stack([evidence_bound(system, q, o, u) for q in encoders])
        return values, jnp.stack([q.mean for q in encoders]), kalman_filter(system, o, u).log_likelihood.sum()

    values, means, likelihood = jax.jit(jax.vmap(bounds))(seen, actions)
    gap = likelihood[:, None] - values
    error = np.asarray(((means - states[:, None]) ** 2)[..., 5:, 1].mean((0, 2)))
    with item("8.66") as check:
        check(
            float(jnp.abs(gap[:, 0]).max()), "<=", 1e-8, "objective and entropy of the posterior, from the likelihood"
        )
        check(float(gap[:, 1:].min()), ">=", 0.1, "what filter and single frames fall short of it, the least")
        check(float((gap[:, 2] - gap[:, 1]).mean()), ">=", 1, "single frames fall shorter than the filter, in the mean")
    with item("8.67") as check:
        check(error[1] / error[2], "<=", 0.5, "squared error of the velocity: the filter's over a single frame's")
        check(error[0] / error[1], "<=", 0.9, "the smoother's over the filter's")


def test_entropy_is_that_of_the_joint(x64):
    """That of pairs less that of the states between them, against the covariance of all states at once."""
    system, actions = truth(), jnp.ones((3, 1))
    prior = prior_states(system, actions)
    A, S = np.asarray(system.F)[:, :2], [np.asarray(system.covariance)] + [np.asarray(system.noise)] * 3
    root = np.zeros((4, 2, 4, 2))
    for t in range(4):
        for s in range(t + 1):
            root[t, :, s] = np.linalg.matrix_power(A, t - s)
    joint = np.einsum("txsy,syz,uwsz->txuw", root, np.stack(S), root).reshape(8, 8)
    assert float(posterior_entropy(prior)) == pytest.approx(0.5 * np.linalg.slogdet(2 * np.pi * np.e * joint)[1])


def test_a_latent_system_is_learned(item, x64):
    """From a wrong start, positions alone: likelihood on fresh data against that of the filter that knows the truth."""
    system = truth()
    _, seen, actions = episodes(system, 150, 2)
    _, fresh, fresh_actions = episodes(system, 150, 3)
    F = np.array([[0.8, 0.5, 0.2], [0.0, 0.7, 0.1]])
    start = LinearGaussian(F, np.eye(2), np.array([[0.7, 0.2]]), np.eye(1), np.zeros(2), np.eye(2))
    solution = fit_linear_gaussian(start, seen, actions, 400)
    history = np.asarray(solution.stats["log_likelihood"])
    best, learned = (per_observation(s, fresh, fresh_actions) for s in (system, solution.value))
    with item("8.63") as check:
        check(
            abs(learned / best - 1), "<=", 0.01, "log-likelihood of fresh data, from the true Kalman filter's, relative"
        )
        check(float(np.diff(history).min()), ">=", -1e-9, "least change of the likelihood in an iteration")
        poles = [np.sort_complex(np.linalg.eigvals(np.asarray(s.F)[:, :2])) for s in (system, solution.value)]
        check(float(np.abs(poles[0] - poles[1]).max()), "<=", 0.05, "eigenvalues of the dynamics, from the true ones")


def test_the_maximum_of_the_expected_objective(item, x64):
    """Closed form against the gradient: nothing is left to gain with the posterior held."""
    system = truth()
    _, seen, actions = episodes(system, 4, 4)
    fitted, _ = jax.jit(expectation_maximisation)(system, seen, actions)
    held = jax.vmap(lambda o, u: pairwise_encoder(system, o, u))(seen, actions)
    objective = lambda s: jax.vmap(lambda q, o, u: expected_objective(s, q, o, u))(held, seen, actions).mean()  # noqa: E731
    slope = jax.jit(jax.grad(objective))(fitted)
    with item("8.66") as check:
        most = max(float(jnp.abs(g).max()) for g in jax.tree.leaves(slope))
        check(most, "<=", 1e-6, "gradient of the expected objective at the M-step's system")


def test_refusals():
    system = truth()
    with pytest.raises(ValueError, match="at least one iteration"):
        fit_linear_gaussian(system, jnp.zeros((1, 3, 1)), jnp.zeros((1, 2, 1)), 0)
    timed = eqx.tree_at(lambda s: s.F, system, jnp.zeros((3, 2, 3)))
    with pytest.raises(ValueError, match="changes with time"):
        fit_linear_gaussian(timed, jnp.zeros((1, 3, 1)), jnp.zeros((1, 2, 1)), 2)
