"""The filter and the smoother against the Gaussian of all states and observations at once, written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.ops import LinearGaussian, kalman_filter, kalman_smoother, simulate_linear

X, U, O, T = 3, 2, 2, 5
KEY = jax.random.key(0)


def spread(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.2 * np.eye(size)


def system_of(seed: int) -> LinearGaussian:
    """A random system that changes with time."""
    rng = np.random.default_rng(seed)
    stack = lambda size: np.stack([spread(rng, size) for _ in range(T)])  # noqa: E731
    return LinearGaussian(
        0.6 * rng.normal(size=(T, X, X + U)), stack(X), rng.normal(size=(T, O, X)), stack(O),
        rng.normal(size=X), spread(rng, X), rng.normal(size=(T, X)), rng.normal(size=(T, O)),
    )  # fmt: skip


def joint(system: LinearGaussian, actions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Mean and covariance of all states; H, the covariance of all observations, and h with o = H x + h + noise."""
    mean, root = [np.asarray(system.mean)], np.zeros((T, X, T, X))
    root[0, :, 0] = np.eye(X)
    covariances = [np.asarray(system.covariance)]
    for t in range(T - 1):
        F, f, noise = (np.asarray(p) for p in system.dynamics_at(t))
        mean.append(F @ np.concatenate([mean[-1], actions[t]]) + f)
        root[t + 1] = np.einsum("xy,ysz->xsz", F[:, :X], root[t])
        root[t + 1, :, t + 1] = np.eye(X)
        covariances.append(noise)
    covariance = np.einsum("txsy,syz,uwsz->txuw", root, np.stack(covariances), root)
    H, R, h = np.zeros((T, O, T, X)), np.zeros((T, O, T, O)), np.zeros((T, O))
    for t in range(T):
        H[t, :, t], h[t], R[t, :, t] = (np.asarray(p) for p in system.sensor_at(t))
    flat = covariance.reshape(T * X, T * X)
    H, R = H.reshape(T * O, T * X), R.reshape(T * O, T * O)
    return np.concatenate(mean), flat, H, H @ flat @ H.T + R, h.ravel()


def test_against_the_gaussian_of_everything(item, x64):
    gaps = {"filter": 0.0, "smoother": 0.0, "pairs": 0.0, "likelihood": 0.0}
    for seed in range(5):
        system, rng = system_of(seed), np.random.default_rng(seed)
        actions, seen = rng.normal(size=(T - 1, U)), rng.normal(size=(T, O))
        mean, covariance, H, spread_seen, h = joint(system, actions)
        error = seen.ravel() - H @ mean - h
        known = kalman_filter(system, jnp.asarray(seen), jnp.asarray(actions))
        smooth, likelihood = kalman_smoother(system, jnp.asarray(seen), jnp.asarray(actions))
        for t in range(T):
            n, own = (t + 1) * O, slice(t * X, (t + 1) * X)
            gain = covariance[own] @ H[:n].T @ np.linalg.inv(spread_seen[:n, :n])
            gaps["filter"] = max(
                gaps["filter"],
                np.abs(known.mean[t] - mean[own] - gain @ error[:n]).max(),
                np.abs(known.covariance[t] - covariance[own, own] + gain @ H[:n] @ covariance[:, own]).max(),
            )
        gain = covariance @ H.T @ np.linalg.inv(spread_seen)
        posterior_mean = (mean + gain @ error).reshape(T, X)
        posterior = (covariance - gain @ H @ covariance).reshape(T, X, T, X)
        for t in range(T):
            gaps["smoother"] = max(
                gaps["smoother"],
                np.abs(smooth.mean[t] - posterior_mean[t]).max(),
                np.abs(smooth.covariance[t] - posterior[t, :, t]).max(),
            )
        for t in range(T - 1):
            gaps["pairs"] = max(gaps["pairs"], np.abs(smooth.cross[t] - posterior[t, :, t + 1]).max())
        log_det = np.linalg.slogdet(2 * np.pi * spread_seen)[1]
        exact = -0.5 * (error @ np.linalg.solve(spread_seen, error) + log_det)
        gaps["likelihood"] = max(
            gaps["likelihood"], abs(float(likelihood) - exact), abs(float(known.log_likelihood.sum()) - exact)
        )
    with item("8.67") as check:
        check(gaps["filter"], "<=", 1e-9, "filter against conditioning the joint Gaussian, 5 systems")
        check(gaps["smoother"], "<=", 1e-9, "smoother against the same")
        check(gaps["pairs"], "<=", 1e-9, "covariances of neighbours against the same")
    with item("8.63") as check:
        check(gaps["likelihood"], "<=", 1e-9, "log-likelihood against the joint Gaussian")


def test_what_is_simulated_has_these_laws(x64):
    """Mean and covariance of simulated observations against the joint Gaussian."""
    system, actions = system_of(1), np.random.default_rng(1).normal(size=(T - 1, U))
    mean, _, H, covariance, h = joint(system, actions)
    draw = jax.jit(jax.vmap(lambda k: simulate_linear(system, jnp.asarray(actions), k)[1]))
    seen = np.asarray(draw(jax.random.split(KEY, 40_000))).reshape(-1, T * O)
    error = np.abs(seen.mean(0) - H @ mean - h) / np.sqrt(np.diag(covariance) / len(seen))
    assert error.max() < 4.5
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert (np.abs(np.cov(seen.T) - covariance) / scale).max() < 0.03


def test_refusals():
    eye = np.eye(2)
    with pytest.raises(ValueError, match="noise has shape"):
        LinearGaussian(eye, np.eye(3), eye, eye, np.zeros(2), eye)
    with pytest.raises(ValueError, match="maps a state and an action"):
        LinearGaussian(np.ones((2, 1)), eye, eye, eye, np.zeros(2), eye)
    with pytest.raises(ValueError, match="4 actions between them, not 2"):
        kalman_filter(LinearGaussian(eye, eye, eye, eye, np.zeros(2), eye), jnp.zeros((5, 2)), jnp.zeros((2, 0)))
