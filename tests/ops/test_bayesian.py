"""Bayesian linear regression, against integrals on a grid, samples, and the derivative of the log posterior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from rewardtogo.ops import FullGaussian, NormalInverseGamma, linear_posterior, linear_prediction

NOISE = 0.3


@pytest.fixture(autouse=True)
def double(x64):
    yield


def data(size: int, seed: int = 0) -> tuple[jax.Array, jax.Array]:
    """y = 1 - 2 x and noise, with the features 1 and x."""
    rng = np.random.default_rng(seed)
    x = np.stack([np.ones(size), rng.uniform(-1, 1, size)], 1)
    return jnp.asarray(x), jnp.asarray(x @ np.array([1.0, -2.0]) + np.sqrt(NOISE) * rng.normal(size=size))


def log_joint(theta: jax.Array, x: jax.Array, y: jax.Array, prior: FullGaussian | None) -> jax.Array:
    """log p(D | theta) + log p(theta), written out as densities."""
    likelihood = jax.scipy.stats.norm.logpdf(y, x @ theta, jnp.sqrt(NOISE)).sum()
    return likelihood + (0.0 if prior is None else prior.log_prob(theta))


def grid(posterior: FullGaussian, points: int = 241) -> tuple[jax.Array, float]:
    """Points of the plane of two weights out to eight deviations, and the area of a cell."""
    sd = np.sqrt(np.diagonal(posterior.covariance))
    axes = [np.linspace(m - 8 * s, m + 8 * s, points) for m, s in zip(np.asarray(posterior.mean), sd, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    return jnp.asarray(cells), float(np.prod([a[1] - a[0] for a in axes]))


def test_likelihood_map_and_posterior(item):
    x, y = data(12)
    ridge = FullGaussian(jnp.zeros(2), jnp.sqrt(0.5) * jnp.eye(2))
    flat, bent = linear_posterior(x, y, NOISE), linear_posterior(x, y, NOISE, ridge)
    least_squares = np.linalg.lstsq(np.asarray(x), np.asarray(y), rcond=None)[0]
    by_hand = np.linalg.solve(np.asarray(x.T @ x) + NOISE / 0.5 * np.eye(2), np.asarray(x.T @ y))
    slope = lambda theta, prior: float(jnp.abs(jax.grad(log_joint)(theta, x, y, prior)).max())  # noqa: E731
    cells, area = grid(bent)
    joint = jax.jit(jax.vmap(lambda t: log_joint(t, x, y, ridge)))(cells)
    density = jnp.exp(joint - joint.max())
    density = density / (density.sum() * area)
    closed = jnp.exp(jax.jit(jax.vmap(bent.log_prob))(cells))
    entropy = -float(jnp.where(density > 0, density * jnp.log(jnp.maximum(density, 1e-300)), 0.0).sum() * area)
    entropies = [float(linear_posterior(*data(n), NOISE).entropy()) for n in (3, 10, 30, 100, 300)]
    with item("8.56") as check:
        check(np.abs(flat.mean - least_squares).max(), "<=", 1e-12, "flat prior: mode of the posterior, least squares")
        check(slope(flat.mean, None), "<=", 1e-10, "flat prior: gradient of the log likelihood at the mode")
        check(np.abs(bent.mean - by_hand).max(), "<=", 1e-12, "Gaussian prior: mode, ridge regression")
        check(slope(bent.mean, ridge), "<=", 1e-10, "Gaussian prior: gradient of the log posterior at the mode")
        check(slope(bent.mean, None), ">=", 1.0, "Gaussian prior: gradient of the log likelihood there (E8.13)")
        check(float(jnp.abs(density - closed).max() / closed.max()), "<=", 1e-6, "density, normalised on a grid")
        check(abs(entropy - float(bent.entropy())), "<=", 1e-6, "entropy of p(theta | D), integrated on the grid")
        check(np.diff(entropies).max(), "<", 0, "it falls with every threefold of data")
        by_rule = 0.5 * np.linalg.slogdet(2 * np.pi * np.e * np.asarray(bent.covariance))[1]
        check(abs(float(bent.entropy()) - by_rule), "<=", 1e-12, "1/2 log det(2 pi e S)")


def test_predictive_law_with_known_noise(item):
    x, y = data(8)
    prior = FullGaussian(jnp.zeros(2), jnp.eye(2))
    posterior = linear_posterior(x, y, NOISE, prior)
    at = jnp.asarray([1.0, 2.0])
    said = linear_prediction(posterior, at, NOISE)
    values = np.linspace(float(said.mean) - 4, float(said.mean) + 4, 21)
    cells, area = grid(posterior)
    weights = np.exp(np.asarray(jax.vmap(posterior.log_prob)(cells))) * area
    means = np.asarray(cells @ at)
    integral = np.array([(scipy.stats.norm.pdf(v, means, np.sqrt(NOISE)) * weights).sum() for v in values])
    closed = scipy.stats.norm.pdf(values, float(said.mean), np.sqrt(float(said.variance)))
    keys = jax.random.split(jax.random.key(0), 200_000)
    drawn = np.asarray(jax.jit(jax.vmap(lambda k: posterior.sample(k) @ at))(keys))
    with item("8.57") as check:
        check(np.abs(integral - closed).max(), "<=", 1e-8, "Gaussian: integral over theta on a grid")
        check(abs(drawn.var() / float(said.epistemic) - 1), "<=", 0.02, "epistemic variance, 200,000 draws of theta")
        check(abs(drawn.mean() - float(said.mean)), "<=", 0.01, "mean, the same draws")
        check(abs(float(said.aleatoric) - NOISE), "==", 0, "aleatoric variance less that of the noise")


def test_predictive_law_with_unknown_noise(item):
    x, y = data(8)
    before = NormalInverseGamma(jnp.zeros(2), 0.5 * jnp.eye(2), jnp.asarray(1.5), jnp.asarray(0.7))
    after = before.observe(x, y)
    at = jnp.asarray([1.0, 2.0])
    law = after.predict(at)
    values = np.linspace(float(law.location) - 5, float(law.location) + 5, 41)
    theirs = scipy.stats.t(float(law.freedom), float(law.location), float(law.scale))
    ours = np.asarray(jax.vmap(law.log_prob)(jnp.asarray(values)))
    keys = jax.random.split(jax.random.key(1), 100_000)
    theta, noise = jax.jit(jax.vmap(after.sample))(keys)
    mixture = np.array([scipy.stats.norm.pdf(v, theta @ at, np.sqrt(noise)).mean() for v in values])
    one_by_one, belief = 0.0, before
    for row, value in zip(x, y, strict=True):
        one_by_one += float(belief.predict(row).log_prob(value))
        belief = belief.observe(row[None], value[None])
    drawn = np.asarray(jax.jit(jax.vmap(law.sample))(keys))
    with item("8.57") as check:
        check(np.abs(ours - theirs.logpdf(values)).max(), "<=", 1e-12, "Student's density")
        check(abs(float(law.entropy()) - theirs.entropy()), "<=", 1e-10, "and its entropy")
        check(abs(float(law.variance()) - theirs.var()), "<=", 1e-10, "and its variance")
        check(np.abs(mixture / theirs.pdf(values) - 1)[10:-10].max(), "<=", 0.03, "mixture over 100,000 draws of theta")
        check(abs(one_by_one - float(before.log_evidence(x, y))), "<=", 1e-10, "evidence, sample by sample")
        check(float(jnp.abs(belief.mean - after.mean).max()), "<=", 1e-12, "one sample at a time, all at once")
        check(abs(float(belief.rate - after.rate)), "<=", 1e-12, "the same, rate")
        check(scipy.stats.kstest(drawn, theirs.cdf).statistic, "<=", 0.006, "draws of y against Student's law")
    assert np.isinf(float(NormalInverseGamma.vague(2).predict(at).variance()))


def test_what_is_not_known_falls_as_one_over_n(item):
    """The noise stays, the variance of the mean falls: in closed form, at one place."""
    at = jnp.asarray([1.0, 0.7])
    spread = {n: linear_prediction(linear_posterior(*data(n, 3), NOISE), at, NOISE).epistemic for n in (200, 800, 3200)}
    with item("8.54") as check:
        for n in (200, 800):
            check(abs(float(spread[n] / spread[4 * n]) / 4 - 1), "<=", 0.3, f"epistemic variance, {n} and {4 * n}")


def test_samples_that_do_not_determine_the_weights_are_refused():
    x, y = data(1)
    with pytest.raises(ValueError, match="do not determine 2 weights"):
        linear_posterior(x, y, NOISE)
    many, more = data(50)
    with pytest.raises(ValueError, match="do not determine 2 weights"):
        linear_posterior(many[:, [1, 1]], more, NOISE)
    assert linear_posterior(x, y, NOISE, FullGaussian(jnp.zeros(2), jnp.eye(2))).mean.shape == (2,)
