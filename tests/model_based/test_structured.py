"""Structured inference in a linear chain: against the joint Gaussian of all states, known dynamics, and the bound that turns raise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithms_under_test import jit
from rewardtogo.model_based.structured import (
    ExpectedDynamics,
    Laws,
    believed,
    chain_kl,
    local_laws,
    smoothed_states,
    transition_moments,
    weighted_sum,
)
from rewardtogo.ops import LinearGaussian, RegressionMoments, kalman_smoother, simulate_linear
from rewardtogo.ops.distributions import DiagGaussian

X, U, H = 2, 1, 5
Z = X + U + 1
TURN = jit(local_laws, static_argnums=5)


@pytest.fixture(autouse=True)
def double(x64):
    yield


def law_of(seed: int, samples: float = 12.0) -> Laws:
    rng = np.random.default_rng(seed)
    precision = samples * (lambda a: a @ a.T / 4 + 0.5 * np.eye(Z))(rng.normal(size=(Z, Z)))
    scale = samples * np.asarray([[0.05, 0.01], [0.01, 0.08]])
    mean = np.concatenate([[[0.9, 0.3], [-0.2, 0.8]], 0.3 * rng.normal(size=(X, U + 1))], 1)
    return Laws.of(jnp.asarray(mean), jnp.asarray(precision), jnp.asarray(scale), samples + X + 1)


def seen_of(seed: int) -> tuple[DiagGaussian, jax.Array]:
    rng = np.random.default_rng(seed)
    potentials = DiagGaussian(
        jnp.asarray(rng.normal(size=(H + 1, X))), jnp.asarray(0.5 * rng.normal(size=(H + 1, X)) - 0.5)
    )
    return potentials, jnp.asarray(rng.normal(size=(H, U)))


def joint(laws: list[Laws], potentials: DiagGaussian, actions: jax.Array) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and covariance of all states under q as one vector, and the logarithm of its normaliser, term by term."""
    size = (H + 1) * X

    def log_weight(flat: jax.Array) -> jax.Array:
        s = flat.reshape(H + 1, X)
        total = -0.5 * s[0] @ s[0] - 0.5 * X * np.log(2 * np.pi)
        for t in range(H):
            total = total + laws[t].expected_log_prob(jnp.concatenate([s[t], actions[t], jnp.ones(1)]), s[t + 1])
        for t in range(H + 1):
            total = total + DiagGaussian(potentials.mean[t], potentials.log_std[t]).log_prob(s[t])
        return total

    zero = jnp.zeros(size)
    value, slope, curve = log_weight(zero), jax.grad(log_weight)(zero), jax.hessian(log_weight)(zero)
    covariance = np.linalg.inv(-np.asarray(curve))
    mean = covariance @ np.asarray(slope)
    normaliser = float(value) + 0.5 * float(slope @ mean) + 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
    return mean, covariance, normaliser


def test_states_against_the_joint_gaussian(item):
    """Means, covariances, cross covariances, normaliser, and KL divergence, with another law at each step."""
    laws = [law_of(t) for t in range(H)]
    potentials, actions = seen_of(0)
    mean, covariance, normaliser = joint(laws, potentials, actions)
    dynamics = ExpectedDynamics.of(jax.tree.map(lambda *a: jnp.stack(a), *laws), H)
    posterior, ours = smoothed_states(dynamics, potentials, actions)
    block = lambda i, j: covariance[i * X : (i + 1) * X, j * X : (j + 1) * X]  # noqa: E731
    gaps = [
        np.abs(np.asarray(posterior.mean).ravel() - mean).max(),
        max(np.abs(posterior.covariance[t] - block(t, t)).max() for t in range(H + 1)),
        max(np.abs(posterior.cross[t] - block(t, t + 1)).max() for t in range(H)),
    ]
    variance = np.diagonal(covariance).reshape(H + 1, X)
    potential = DiagGaussian(potentials.mean.ravel(), potentials.log_std.ravel()).log_prob(jnp.asarray(mean))
    expected = float(potential) - 0.5 * float((variance / np.asarray(potentials.std) ** 2).sum())
    kl = expected - normaliser
    with item("8.71") as check:
        check(max(gaps), "<=", 1e-9, "structured posterior against the joint Gaussian of all states")
        check(abs(float(ours) - normaliser), "<=", 1e-8, "logarithm of its normaliser")
        check(abs(float(chain_kl(posterior, potentials, ours)) - kl), "<=", 1e-8, "KL(q(s) || p(s))")
    assert kl > 0


def test_one_law_is_the_same_law_at_each_step():
    potentials, actions = seen_of(1)
    law = law_of(0)
    one = smoothed_states(ExpectedDynamics.of(law, H), potentials, actions)
    many = smoothed_states(ExpectedDynamics.of(jax.tree.map(lambda a: jnp.stack([a] * H), law), H), potentials, actions)
    assert all(np.allclose(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True))


def test_known_dynamics_are_kalmans():
    """A law of a million samples: potentials are observations, and the normaliser their likelihood."""
    potentials, actions = seen_of(2)
    law = law_of(0, 1e7)
    posterior, normaliser = smoothed_states(ExpectedDynamics.of(law, H), potentials, actions)
    system = ExpectedDynamics.of(law, H).system(potentials)
    theirs, likelihood = kalman_smoother(system, potentials.mean, actions)
    assert np.allclose(posterior.mean, theirs.mean, atol=1e-5)
    assert np.allclose(posterior.covariance, theirs.covariance, atol=1e-5)
    assert float(normaliser) == pytest.approx(float(likelihood), abs=1e-4)


def test_moments_are_those_of_samples():
    """In the mean over draws of the pair of states."""
    potentials, actions = seen_of(3)
    posterior, _ = smoothed_states(ExpectedDynamics.of(law_of(0), H), potentials, actions)
    moments = transition_moments(posterior, actions)
    t = 2
    both = np.block([
        [posterior.covariance[t], posterior.cross[t]], [posterior.cross[t].T, posterior.covariance[t + 1]]
    ])  # fmt: skip
    centre = np.concatenate([posterior.mean[t], posterior.mean[t + 1]])
    pairs = np.random.default_rng(0).multivariate_normal(centre, both, 400_000)
    x = np.concatenate([pairs[:, :X], np.tile([*np.asarray(actions[t]), 1.0], (len(pairs), 1))], 1)
    sampled = RegressionMoments.of(jnp.asarray(x), jnp.asarray(pairs[:, X:])).scaled(1 / len(pairs))
    for exact, mean in zip(jax.tree.leaves(moments), jax.tree.leaves(sampled), strict=True):
        assert np.allclose(exact[t], mean, atol=0.01)


def sequences(count: int) -> tuple[DiagGaussian, jax.Array, LinearGaussian]:
    """What potentials say of states of a system that changes with time."""
    rng = np.random.default_rng(0)
    F = np.stack([[[1.0, 0.3, 0.0], [0.1 * t - 0.3, 0.9, 0.5 - 0.1 * t]] for t in range(H)])
    system = LinearGaussian(F, 0.01 * np.eye(X), np.eye(X), 0.04 * np.eye(X), np.zeros(X), np.eye(X))
    actions = jnp.asarray(rng.normal(size=(count, H, U)))
    seen = jax.vmap(lambda a, k: simulate_linear(system, a, k)[1])(actions, jax.random.split(jax.random.key(0), count))
    return DiagGaussian(seen, jnp.full(seen.shape, np.log(0.2))), actions, system


def test_turns_raise_the_bound_and_find_the_local_dynamics(item):
    """The bound on the potentials' evidence, whole; and dynamics that differ from step to step."""
    count = 40
    potentials, actions, system = sequences(count)
    prior = Laws.of(jnp.asarray(np.eye(X, Z)), jnp.eye(Z), jnp.eye(X) * 0.1, X + 2.0)

    @jax.jit
    def bound(laws: Laws) -> jax.Array:
        dynamics = ExpectedDynamics.of(laws, H)
        normalisers = jax.vmap(lambda p, a: smoothed_states(dynamics, p, a)[1])(potentials, actions)
        return normalisers.sum() - jax.vmap(lambda law: law.kl(prior))(laws).sum()

    values, laws = [], jax.tree.map(lambda a: jnp.stack([a] * H), prior)
    for _ in range(20):
        laws, _ = TURN(prior, laws, potentials, actions, jnp.ones(count), 1)
        values.append(float(bound(laws)))
    found = jax.vmap(lambda law: law.mean)(laws)
    error = np.abs(np.asarray(found[..., :-1]) - np.asarray(system.F)).max()
    worse = eqx.tree_at(lambda w: w.seen.yx, laws, 0.95 * laws.seen.yx)
    with item("8.71") as check:
        check(np.diff(values).min(), ">=", -1e-9, "least rise of the bound in 19 turns of local inference")
        check(error, "<=", 0.2, "local dynamics from 40 sequences, each entry, from the true ones")
    assert float(bound(worse)) < values[-1]


def test_weights_and_belief():
    """A sequence of weight 0 was not there, one of weight 2 twice; belief keeps the means."""
    potentials, actions, _ = sequences(6)
    prior = law_of(0)
    pick = lambda rows: (jax.tree.map(lambda a: a[jnp.asarray(rows)], potentials), actions[jnp.asarray(rows)])  # noqa: E731
    weights = jnp.asarray([1.0, 0.0, 2.0, 0.0, 0.0, 0.0])
    one, _ = TURN(prior, prior, potentials, actions, weights, 2)
    other, _ = TURN(prior, prior, *pick([0, 2, 2]), jnp.ones(3), 2)
    assert all(np.allclose(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))
    total = weighted_sum(jax.tree.map(lambda a: a[None], prior.seen), jnp.asarray([3.0]))
    assert np.allclose(total.xx, 3.0 * prior.seen.xx)
    weaker = believed(prior, 2.0)
    assert float(weaker.seen.count) == pytest.approx(2.0) and np.allclose(weaker.mean, prior.mean)
