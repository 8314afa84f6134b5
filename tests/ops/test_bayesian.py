"""Bayesian linear regression, against integrals on a grid, samples, and the derivative of the log posterior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from rewardtogo.ops import (
    FullGaussian,
    MatrixNormalInverseWishart,
    NormalInverseGamma,
    RegressionMoments,
    linear_posterior,
    linear_prediction,
)

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


def matrix_law(seed: int, freedom: float = 7.0) -> MatrixNormalInverseWishart:
    rng = np.random.default_rng(seed)
    square = lambda n: (lambda a: jnp.asarray(a @ a.T + np.eye(n)))(rng.normal(size=(n, n)))  # noqa: E731
    return MatrixNormalInverseWishart.of(jnp.asarray(rng.normal(size=(2, 3))), square(3), square(2), freedom)


def drawn(law: MatrixNormalInverseWishart, count: int) -> tuple[np.ndarray, np.ndarray]:
    """W and Sigma by scipy's laws."""
    sigma = scipy.stats.invwishart(float(law.freedom), np.asarray(law.scale)).rvs(count, random_state=0)
    z = np.random.default_rng(1).normal(size=(count, 2, 3))
    root = np.linalg.cholesky(np.linalg.inv(law.seen.xx))
    return np.asarray(law.mean) + np.linalg.cholesky(sigma) @ z @ root.T, sigma


def log_density(law: MatrixNormalInverseWishart, w: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    wishart = scipy.stats.invwishart(float(law.freedom), np.asarray(law.scale)).logpdf(np.moveaxis(sigma, 0, -1))
    gap = w - np.asarray(law.mean)
    square = np.einsum("nij,njk,kl,nil->n", np.linalg.inv(sigma), gap, np.asarray(law.seen.xx), gap)
    log_det = 2 * np.linalg.slogdet(law.seen.xx)[1] - 3 * np.linalg.slogdet(sigma)[1]
    return wishart + 0.5 * (log_det - square - 6 * np.log(2 * np.pi))


def test_several_outputs_of_one_are_the_regression_with_unknown_noise():
    """D = 1 is the normal inverse gamma: means, rates and evidence of two portions of data."""
    x, y = data(30)
    small = NormalInverseGamma(
        jnp.asarray([0.5, -1.0]), jnp.diag(jnp.asarray([2.0, 3.0])), jnp.asarray(2.0), jnp.asarray(0.7)
    )
    law = MatrixNormalInverseWishart.of(
        small.mean[None], small.precision, 2.0 * small.rate[None, None], 2.0 * small.shape
    )
    portions = [(x[:10], y[:10]), (x[10:], y[10:])]
    for part_x, part_y in portions:
        moments = RegressionMoments.of(part_x, part_y[:, None])
        assert float(law.log_evidence(moments)) == pytest.approx(float(small.log_evidence(part_x, part_y)), rel=1e-9)
        small, law = small.observe(part_x, part_y), law.observe(moments)
    assert np.allclose(law.mean[0], small.mean) and np.allclose(law.scale[0, 0], 2.0 * small.rate)
    assert float(law.freedom) == pytest.approx(2.0 * float(small.shape))


def test_several_outputs_against_samples(item):
    """E[log N(y; W x, Sigma)], E[log |Sigma|], the KL divergence and the evidence, by scipy's draws of W and Sigma."""
    law, other = matrix_law(0), matrix_law(1, 9.0)
    w, sigma = drawn(law, 200_000)
    off = lambda samples, exact: abs(samples.mean() - float(exact)) / (samples.std() / len(samples) ** 0.5)  # noqa: E731
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(4, 3)), rng.normal(size=(4, 2))
    error = y[None] - np.einsum("ndf,kf->nkd", w, x)
    square = np.einsum("nkd,nde,nke->nk", error, np.linalg.inv(sigma), error)
    log_det = np.linalg.slogdet(sigma)[1]
    log_prob = -0.5 * (square + log_det[:, None] + 2 * np.log(2 * np.pi))
    gaps = [off(log_prob[:, k], law.expected_log_prob(jnp.asarray(x[k]), jnp.asarray(y[k]))) for k in range(4)]
    ratio = log_density(law, w, sigma) - log_density(other, w, sigma)
    evidence = np.log(np.exp(log_prob.sum(1)).mean())
    moments = RegressionMoments.of(jnp.asarray(x), jnp.asarray(y))
    with item("8.71") as check:
        check(max(gaps), "<=", 4, "matrix normal inverse Wishart: E[log p(y | x)] against draws, standard errors")
        check(off(log_det, law.expected_log_det()), "<=", 4, "its E[log |Sigma|], likewise")
        check(off(ratio, law.kl(other)), "<=", 4, "its KL divergence, likewise")
        check(abs(evidence - float(law.log_evidence(moments))), "<=", 0.05, "its evidence of 4 samples")
    assert float(law.kl(law)) == pytest.approx(0.0, abs=1e-9)
    best = np.linalg.inv(law.noise)
    assert np.allclose(best, np.linalg.inv(sigma).mean(0), rtol=0.02, atol=0.02)


def test_several_outputs_whatever_the_portions():
    """All at once is one after the other, and a sample that counts twice is two."""
    rng = np.random.default_rng(0)
    x, y = jnp.asarray(rng.normal(size=(20, 3))), jnp.asarray(rng.normal(size=(20, 2)))
    law = matrix_law(0)
    whole = law.observe(RegressionMoments.of(x, y))
    parts = law.observe(RegressionMoments.of(x[:7], y[:7])).observe(RegressionMoments.of(x[7:], y[7:]))
    twice = law.observe(RegressionMoments.of(jnp.tile(x, (2, 1)), jnp.tile(y, (2, 1))))
    scaled = law.observe(RegressionMoments.of(x, y).scaled(2.0))
    for one, other in ((whole, parts), (twice, scaled)):
        assert np.allclose(one.mean, other.mean) and np.allclose(one.scale, other.scale)
        assert float(one.freedom) == float(other.freedom)
    flat = MatrixNormalInverseWishart.of(jnp.zeros((2, 3)), 1e-9 * jnp.eye(3), jnp.eye(2), 3.0)
    least = np.linalg.lstsq(np.asarray(x), np.asarray(y), rcond=None)[0].T
    assert np.allclose(flat.observe(RegressionMoments.of(x, y)).mean, least, atol=1e-6)
