import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo import ops


def random_probabilities(key, number, size=5):
    return jax.nn.softmax(2.0 * jax.random.normal(key, (number, size)), axis=-1)


def random_gaussian(seed, size=3):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size))
    return jnp.asarray(rng.normal(size=size)), jnp.asarray(root @ root.T + 0.5 * np.eye(size))


def test_distances(item, x64):
    p, q = jnp.array([0.25, 0.75, 0.0, 0.0]), jnp.array([0.0, 0.0, 0.5, 0.5])
    eps, t = np.meshgrid(np.linspace(0.0, 1.0, 100), np.arange(1, 101), indexing="ij")
    gap = jax.vmap(lambda e, t: ops.survival(e, t) - ops.survival_bound(e, t))(eps.ravel(), t.ravel().astype(float))
    with item("2.29") as check:
        check(float(ops.tv_distance(p, q)), "==", 1.0, "total variation of disjoint laws")
        check(float(ops.l1_distance(p, q)), "==", 2.0, "L1 distance of disjoint laws")
        check(gap.size, "==", 10_000, "points of the grid")
        check(float(jnp.min(gap)), ">=", -1e-15, "least (1 - eps)^t - (1 - eps t)")
    assert float(ops.tv_distance(p, p)) == 0.0
    assert float(ops.l1_distance(jnp.array([0.5, 0.5]), jnp.array([0.25, 0.75]))) == 0.5


def test_kl(item, x64):
    ps, qs = (random_probabilities(jax.random.key(i), 200) for i in (0, 1))
    exact = jax.vmap(ops.kl_categorical)(ps, qs)
    printed = jnp.sum(ps * (jnp.log(qs) - jnp.log(ps)), axis=-1)
    with item("3.38") as check:
        check(float(jnp.min(exact)), ">=", 0.0, "least KL of 200 random pairs")
        check(float(jnp.max(printed)), "<", 0.0, "the printed sign makes every one negative (E3.11)")
        check(float(jnp.max(jnp.abs(printed + exact))), "<=", 1e-12, "the printed formula plus the KL")
        for seed in range(3):
            (m1, s1), (m2, s2) = random_gaussian(seed), random_gaussian(seed + 10)
            law, other = ops.FullGaussian.of_covariance(m1, s1), ops.FullGaussian.of_covariance(m2, s2)
            closed = float(ops.kl_gaussian(m1, s1, m2, s2))
            shift = np.asarray(m2 - m1)
            inverse = np.linalg.inv(s2)
            formula = 0.5 * (
                np.trace(inverse @ s1) + shift @ inverse @ shift - 3.0 + np.log(np.linalg.det(s2) / np.linalg.det(s1))
            )
            check(abs(closed - formula) / formula, "<=", 1e-12, "Gaussian, against the formula")
            check(closed, ">=", 0.0, "Gaussian")
            check(abs(closed - float(law.kl(other))) / closed, "<=", 1e-12, "Gaussian, against the distribution's own")
            values = jax.vmap(law.sample)(jax.random.split(jax.random.key(seed), 20_000))
            log_p, log_q = jax.vmap(law.log_prob)(values), jax.vmap(other.log_prob)(values)
            error = float(jnp.std(log_p - log_q)) / np.sqrt(20_000)
            check(
                abs(float(ops.kl_sampled(log_p, log_q)) - closed) / error, "<=", 4.0, "standard errors of Monte Carlo"
            )
        choices = jax.random.categorical(jax.random.key(5), jnp.log(ps[0]), shape=(20_000,))
        ratio = jnp.log(ps[0])[choices] - jnp.log(qs[0])[choices]
        estimate = ops.kl_sampled(jnp.log(ps[0])[choices], jnp.log(qs[0])[choices])
        error = float(jnp.std(ratio)) / np.sqrt(20_000)
        check(abs(float(estimate - exact[0])) / error, "<=", 4.0, "standard errors of Monte Carlo, categorical")
    same = random_gaussian(0)
    assert float(ops.kl_gaussian(*same, *same)) == pytest.approx(0.0, abs=1e-12)


def test_zeros_are_harmless():
    p, q = jnp.array([0.5, 0.5, 0.0]), jnp.array([0.25, 0.5, 0.25])
    assert float(ops.kl_categorical(p, q)) == pytest.approx(0.5 * np.log(2.0))
    assert float(ops.kl_categorical(q, p)) == np.inf
    assert float(ops.entropy(p)) == pytest.approx(np.log(2.0))
    assert float(ops.entropy(jnp.array([1.0, 0.0]))) == 0.0
    for function in (lambda p: ops.kl_categorical(p, q), ops.entropy):
        assert np.all(np.isfinite(jax.grad(function)(p)))


def test_pinsker(x64):
    ps, qs = (random_probabilities(jax.random.key(i), 200) for i in (2, 3))
    bound = jnp.sqrt(0.5 * jax.vmap(ops.kl_categorical)(ps, qs))
    assert np.all(np.asarray(jax.vmap(ops.tv_distance)(ps, qs)) <= bound)
