"""Scores of Gaussian policies, and what learning their spread leads to."""

from typing import Any

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import Environment, Timestep
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.ops import DiagGaussian, FullGaussian
from rewardtogo.ops.schedules import Linear

RNG = np.random.default_rng(0)


def difference(function: Any, at: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Central differences of a number with respect to every entry of an array."""
    found = np.zeros(at.size)
    for i in range(at.size):
        change = np.zeros(at.size)
        change[i] = step
        change = change.reshape(at.shape)
        found[i] = (function(at + change) - function(at - change)) / (2 * step)
    return found.reshape(at.shape)


def log_density(weight: np.ndarray, state: np.ndarray, action: np.ndarray, sigma: np.ndarray) -> float:
    error = action - weight @ state
    return float(-0.5 * error @ np.linalg.solve(sigma, error) - 0.5 * np.linalg.slogdet(2 * np.pi * sigma)[1])


def test_the_score_of_a_gaussian(item):
    """(df/dtheta)' Sigma^-1 (a - f), for f = W s: the outer product of Sigma^-1 (a - f) and s."""
    weight, state, action = RNG.normal(size=(2, 3)), RNG.normal(size=3), RNG.normal(size=2)
    root = RNG.normal(size=(2, 2)) + 2 * np.eye(2)
    sigma = root @ root.T
    formula = np.outer(np.linalg.solve(sigma, action - weight @ state), state)
    finite = difference(lambda w: log_density(w, state, action, sigma), weight)
    with jax.enable_x64(True):
        law = lambda w: FullGaussian(w @ jnp.asarray(state), jnp.linalg.cholesky(jnp.asarray(sigma)))  # noqa: E731
        ours = np.asarray(jax.grad(lambda w: law(w).log_prob(jnp.asarray(action)))(jnp.asarray(weight)))
    with item("3.9") as check:
        check(np.abs(ours - finite).max(), "<=", 1e-6, "autodiff against finite differences")
        check(np.abs(ours - formula).max(), "<=", 1e-12, "against (df/dtheta)' Sigma^-1 (a - f)")
        check(
            np.abs(finite / (0.5 * formula) - 2).max(),
            "<=",
            1e-4,
            "the printed form is half of it (E3.2): ratio from 2",
        )


def test_the_score_of_the_spread(item):
    mean, log_std, action = RNG.normal(size=3), RNG.normal(size=3), RNG.normal(size=3)
    formula = ((action - mean) / np.exp(log_std)) ** 2 - 1
    finite = difference(lambda x: log_density(np.eye(3), mean, action, np.diag(np.exp(2 * x))), log_std)
    with jax.enable_x64(True):
        found = jax.grad(lambda x: DiagGaussian(jnp.asarray(mean), x).log_prob(jnp.asarray(action)))(
            jnp.asarray(log_std)
        )
        found = np.asarray(found)
    with item("3.10") as check:
        check(np.abs(found - formula).max(), "<=", 1e-12, "autodiff against ((a - f) / sigma)^2 - 1")
        check(np.abs(found - finite).max(), "<=", 1e-6, "against finite differences")


class Regulator(Environment):
    """x' = x + u + noise, reward -(x^2 + u^2): the linear-quadratic problem in one dimension."""

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (1,), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        x = jax.random.normal(key, (1,))
        return x, x

    def step(self, state: Any, action: Any, key: jax.Array) -> tuple[Any, Timestep]:
        following = state + action + 0.1 * jax.random.normal(key, (1,))
        reward = -(state**2 + action**2).sum()
        no = jnp.zeros((), bool)
        return following, Timestep(following, reward, no, no, following, {})


def best_gain(gamma: float) -> float:
    """The gain of the linear-quadratic regulator, by iterating Riccati's equation."""
    cost = 1.0
    for _ in range(200):
        cost = 1.0 + gamma * cost - (gamma * cost) ** 2 / (1.0 + gamma * cost)
    return -gamma * cost / (1.0 + gamma * cost)


def test_the_regulator_is_found(item):
    gamma, steps = 0.8, 16
    learner = rtg.PolicyGradient(
        network=rtg.MLP(32),
        gamma=gamma,
        returns="gae",
        learning_rate=Linear(1e-2, 0.0),
        value_learning_rate=Linear(1e-2, 0.0),
        value_updates=5,
    )
    loop = rtg.OnPolicy(rtg.vectorize(TimeLimit(Regulator(), steps), 256), learner, unroll=steps).with_horizon(400)

    def train(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = jax.lax.fori_loop(0, 400, lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0], loop.init(key))
        policy = loop.policy(state)
        mean = lambda x: policy.inspect(policy.init(key), jnp.full(1, x))["mean"][0]  # noqa: E731
        return (mean(1.0) - mean(-1.0)) / 2, state.learner.network.head.log_std[0]

    gains, log_std = jax.device_get(jit(jax.vmap(train))(jax.random.split(jax.random.key(0), 5)))
    with item("3.10") as check:
        gap = abs(float(np.median(gains)) / best_gain(gamma) - 1)
        check(gap, "<=", 0.02, "gain of the learnt policy from the regulator's, median of five seeds")
        check(float(log_std.max()), "<", -1.0, "log of the learnt spread, which began at 0: certainty pays")
