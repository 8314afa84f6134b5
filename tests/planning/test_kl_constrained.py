"""Regulators near another: the bound met exactly, against constrained optimisation of all numbers, and against sampled trajectories."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from rewardtogo.planning import (
    LinearController,
    LQProblem,
    adapted_step,
    expected_cost,
    kl_constrained_lqr,
    riccati,
    state_laws,
    trajectory_kl,
)

X, U, H = 2, 2, 6


def spread_of(rng: np.random.Generator, size: int) -> np.ndarray:
    root = 0.5 * rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


def problem_of(seed: int, x: int = X, u: int = U, horizon: int = H) -> tuple[LQProblem, LinearController, Any, Any]:
    """A random problem that changes with time, a random controller with noise, and a law of first states."""
    rng = np.random.default_rng(seed)
    many = lambda size: np.stack([spread_of(rng, size) for _ in range(horizon)])  # noqa: E731
    problem = LQProblem(
        0.7 * rng.normal(size=(horizon, x, x + u)), many(x + u), horizon, 0.2 * rng.normal(size=(horizon, x)),
        rng.normal(size=(horizon, x + u)), spread_of(rng, x), rng.normal(size=x), many(x),
    )  # fmt: skip
    roots = np.linalg.cholesky(many(u))
    old = LinearController(
        *(jnp.asarray(a) for a in (0.3 * rng.normal(size=(horizon, u, x)), rng.normal(size=(horizon, u)), roots))
    )
    return problem, old, jnp.asarray(rng.normal(size=x)), jnp.asarray(spread_of(rng, x))


def root(controller: LinearController) -> jax.Array:
    assert controller.spread is not None
    return controller.spread


def numbers(controller: LinearController) -> np.ndarray:
    """Gains, offsets and the logarithms of deviations, of one action."""
    parts = (controller.K, controller.k, jnp.log(root(controller)))
    return np.concatenate([np.ravel(part) for part in parts])


def test_the_bound_is_met_and_more_is_saved_with_more(x64):
    """KL = epsilon from 1e-4 to 100 nats; costs fall; Q is not asked to be positive definite."""
    problem, old, mean, covariance = problem_of(0)
    costs = [float(expected_cost(problem, old, mean, covariance))]
    for epsilon in (1e-4, 0.01, 1.0, 10.0, 100.0):
        solution = kl_constrained_lqr(problem, old, mean, covariance, epsilon)
        assert bool(solution.converged) and float(solution.stats["cost_before"]) == pytest.approx(costs[0])
        kl = float(trajectory_kl(problem, solution.value, old, mean, covariance))
        assert kl == pytest.approx(epsilon, rel=1e-5) and kl == pytest.approx(float(solution.stats["kl"]), rel=1e-6)
        costs.append(float(expected_cost(problem, solution.value, mean, covariance)))
    assert np.all(np.diff(costs) < 0), costs
    best = riccati(problem).value.controller()
    assert costs[-1] >= float(expected_cost(problem, best, mean, covariance))
    concave = LQProblem(problem.F, problem.C - 2.0 * jnp.eye(X + U)[None], H, problem.f, problem.c, noise=problem.noise)
    with pytest.raises(ValueError, match="positive definite"):
        riccati(concave)
    solution = kl_constrained_lqr(concave, old, mean, covariance, 2.0)
    assert float(solution.stats["kl"]) == pytest.approx(2.0, rel=1e-5)
    assert float(solution.stats["cost"]) < float(solution.stats["cost_before"])


def test_constrained_optimisation_finds_the_same(x64, item):
    """Every gain, offset and deviation of a small problem as a free number, by sequential quadratic programming."""
    problem, old, mean, covariance = problem_of(3, 1, 1, 3)
    epsilon = 0.7
    start = numbers(old)

    def unpack(z: jax.Array) -> LinearController:
        return LinearController(z[:3].reshape(3, 1, 1), z[3:6].reshape(3, 1), jnp.exp(z[6:]).reshape(3, 1, 1))

    cost = jax.jit(jax.value_and_grad(lambda z: expected_cost(problem, unpack(z), mean, covariance)))
    left = jax.jit(lambda z: epsilon - trajectory_kl(problem, unpack(z), old, mean, covariance))
    slope = jax.jit(jax.grad(left))
    found = scipy.optimize.minimize(
        lambda z: tuple(np.asarray(v) for v in cost(z)), start, jac=True, method="SLSQP",
        constraints={"type": "ineq", "fun": lambda z: float(left(z)), "jac": lambda z: np.asarray(slope(z))},
        options={"ftol": 1e-13, "maxiter": 500},
    )  # fmt: skip
    assert found.success and float(left(found.x)) > -1e-8
    solution = kl_constrained_lqr(problem, old, mean, covariance, epsilon)
    ours = numbers(solution.value)
    multiplier = np.linalg.lstsq(np.asarray(slope(found.x))[:, None], np.asarray(cost(found.x)[1]), rcond=None)[0][0]
    with item("8.71") as check:
        check(
            abs(float(solution.stats["cost"]) - found.fun), "<=", 1e-7, "KL-constrained regulator: cost, against SLSQP"
        )
        check(np.abs(ours - found.x).max(), "<=", 1e-3, "its gains, offsets and log-deviations, likewise")
        check(
            abs(multiplier / float(solution.stats["multiplier"]) - 1), "<=", 1e-3, "its multiplier, against Lagrange's"
        )
        check(abs(float(solution.stats["kl"]) / epsilon - 1), "<=", 1e-5, "its divergence over the bound, less 1")


def test_much_freedom_gives_the_regulator(x64):
    problem, old, mean, covariance = problem_of(1)
    free = kl_constrained_lqr(problem, old, mean, covariance, 300.0).value
    best = riccati(problem).value
    assert np.allclose(free.K, best.K, atol=1e-6) and np.allclose(free.k, best.k, atol=1e-6)
    assert float(jnp.abs(root(free)).max()) < 1e-3


def test_no_freedom_changes_nothing(x64):
    problem, old, mean, covariance = problem_of(2)
    near = kl_constrained_lqr(problem, old, mean, covariance, 1e-10).value
    assert np.allclose(near.K, old.K, atol=1e-4) and np.allclose(root(near), root(old), atol=1e-4)
    free = LQProblem(problem.F, jnp.zeros((X + U, X + U)), H)
    solution = kl_constrained_lqr(free, old, mean, covariance, 1.0)
    assert not bool(solution.converged) and float(solution.stats["kl"]) == pytest.approx(0.0, abs=1e-9)
    assert np.allclose(solution.value.K, old.K) and np.allclose(root(solution.value), root(old))


def test_sampled_trajectories_agree():
    """Laws of states, costs and the ratio of densities, of 20,000 trajectories in single precision."""
    problem, old, mean, covariance = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), problem_of(4))
    new = kl_constrained_lqr(problem, old, mean, covariance, 1.5).value
    first = jnp.linalg.cholesky(covariance)

    def log_prob(p: LinearController, t: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
        e = jnp.linalg.solve(root(p)[t], u - p.K[t] @ x - p.k[t])
        return -0.5 * e @ e - jnp.log(jnp.abs(jnp.diagonal(root(p)[t]))).sum()

    @jax.jit
    @jax.vmap
    def episode(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        start, rest = jax.random.split(key)

        def step(x, now):
            t, k = now
            act, move = jax.random.split(k)
            u = new(t, x, act)[1]
            after, cost = problem.step(x, u, t, move)
            return after, (after, cost, log_prob(new, t, x, u) - log_prob(old, t, x, u))

        x = mean + first @ jax.random.normal(start, (X,))
        _, (states, costs, ratios) = jax.lax.scan(step, x, (jnp.arange(H), jax.random.split(rest, H)))
        return jnp.concatenate([x[None], states]), costs.sum() + problem.final_cost(states[-1]), ratios.sum()

    states, costs, ratios = (np.asarray(a, float) for a in episode(jax.random.split(jax.random.key(0), 20_000)))
    off = lambda samples, exact: abs(samples.mean() - float(exact)) / (samples.std() / len(samples) ** 0.5)  # noqa: E731
    assert off(costs, expected_cost(problem, new, mean, covariance)) < 4
    assert off(ratios, trajectory_kl(problem, new, old, mean, covariance)) < 4
    laws = state_laws(problem, new, mean, covariance)
    assert np.abs(states.mean(0) - laws.mean).max() < 0.1
    gap = np.cov(states[:, -1].T) - np.asarray(laws.covariance[-1])
    assert np.abs(gap).max() < 0.05 * np.abs(laws.covariance[-1]).max()


def test_single_precision_keeps_the_bound():
    problem, old, mean, covariance = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), problem_of(5))
    for epsilon in (0.01, 1.0, 30.0):
        kl = float(kl_constrained_lqr(problem, old, mean, covariance, epsilon).stats["kl"])
        assert kl <= epsilon and kl == pytest.approx(epsilon, rel=1e-2)


def test_the_step_follows_what_was_saved():
    """A parabola is believed: as promised 5 times as long; half of it the same again; none or a loss shorter."""
    assert float(adapted_step(1.0, 2.0, 2.0)) == 5.0 and float(adapted_step(4.0, 2.0, 2.0)) == 10.0
    assert float(adapted_step(1.0, 2.0, 1.0)) == pytest.approx(1.0)
    assert float(adapted_step(1.0, 2.0, 0.0)) == pytest.approx(0.5)
    assert float(adapted_step(1.0, 2.0, -100.0)) == pytest.approx(0.1) and float(
        adapted_step(0.2, 2.0, -2.0)
    ) == pytest.approx(0.1)


def test_refusals():
    problem, old, mean, covariance = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), problem_of(0))
    with pytest.raises(ValueError, match="no spread"):
        kl_constrained_lqr(problem, LinearController(old.K, old.k), mean, covariance, 1.0)
    with pytest.raises(ValueError, match="gains"):
        kl_constrained_lqr(problem_of(0, X, U, 3)[0], old, mean, covariance, 1.0)
    with pytest.raises(ValueError, match="above 0"):
        kl_constrained_lqr(problem, old, mean, covariance, 0.0)
