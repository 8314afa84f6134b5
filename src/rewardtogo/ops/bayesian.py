r"""Bayesian linear regression in closed form: what a posterior over the parameters of a model is, where it can be written down.

$$y = \theta^\top x + \epsilon, \qquad \epsilon \sim N(0, \sigma^2), \qquad
p(\theta \mid D) \propto p(D \mid \theta)\, p(\theta), \qquad
p(y \mid x, D) = \int p(y \mid x, \theta)\, p(\theta \mid D)\, d\theta.$$

**Known noise**, prior $\theta \sim N(m_0, S_0)$: the posterior is $N(m, S)$ with

$$S^{-1} = S_0^{-1} + \tfrac{1}{\sigma^2} X^\top X, \qquad m = S \left( S_0^{-1} m_0 + \tfrac{1}{\sigma^2} X^\top y \right),$$

and the predictive law $N(m^\top x,\; \sigma^2 + x^\top S x)$: aleatoric and epistemic variance. With a flat prior $m$ maximises the
likelihood; with $m_0 = 0$, $S_0 = \tau^2 I$ it is ridge regression with the weight $\sigma^2 / \tau^2$. So $\arg\max_\theta
p(\theta \mid D)$ and $\arg\max_\theta p(D \mid \theta)$ are the same for a flat prior only; the notes equate them (erratum E8.13).

**Unknown noise**, prior $\sigma^2 \sim \mathrm{IG}(a, b)$, $\theta \mid \sigma^2 \sim N(m, \sigma^2 \Lambda^{-1})$ (normal inverse
gamma, conjugate): the predictive law is Student's, with $2a$ degrees of freedom, about $m^\top x$, of squared scale
$\tfrac{b}{a} (1 + x^\top \Lambda^{-1} x)$.

**Several outputs** y with a full covariance: matrix normal inverse Wishart, likewise conjugate.

Source: notes 8.3.3 (items 8.56 and 8.57); Gelman et al. 2013, chapter 14; Murphy 2012, section 7.6.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.linalg import cho_solve, solve_triangular
from jax.scipy.special import betaln, digamma, gammaln, multigammaln
from jaxtyping import Array, Float, Key, ScalarLike

from .distributions import FullGaussian


class LinearPrediction(eqx.Module):
    """Mean of y at one x, and its variance in two parts: that of the noise, and that of not knowing the weights."""

    mean: Float[Array, ""]
    aleatoric: Float[Array, ""]
    epistemic: Float[Array, ""]

    @property
    def variance(self) -> Float[Array, ""]:
        """Of y."""
        return self.aleatoric + self.epistemic


def linear_posterior(
    x: Float[Array, "N F"], y: Float[Array, "N"], noise: ScalarLike, prior: FullGaussian | None = None
) -> FullGaussian:
    """p(theta | D) where the noise has the known *variance* `noise`; its `entropy` says how much is not known of theta (item 8.56).

    Without a prior it is flat. Raises `ValueError` where the data and the prior together leave a direction of theta open.
    """
    noise = jnp.asarray(noise, x.dtype)
    precision, pull = x.T @ x / noise, x.T @ y / noise
    if prior is not None:
        before = cho_solve((prior.scale, True), jnp.eye(prior.mean.size, dtype=x.dtype))
        precision, pull = precision + before, pull + before @ prior.mean
    root = jnp.linalg.cholesky(precision)
    # A pivot that rounding has made positive counts as none.
    pivots = jnp.diagonal(root) ** 2 / jnp.diagonal(precision)
    if not isinstance(pivots, Tracer) and not np.all(np.asarray(pivots) > 10 * jnp.finfo(x.dtype).eps):
        raise ValueError(
            f"{len(x)} samples do not determine {x.shape[1]} weights, and the prior is flat: give more samples, or a prior"
        )
    mean = cho_solve((root, True), pull)
    covariance = cho_solve((root, True), jnp.eye(len(pull), dtype=x.dtype))
    return FullGaussian.of_covariance(mean, 0.5 * (covariance + covariance.T))


def linear_prediction(posterior: FullGaussian, x: Float[Array, "F"], noise: ScalarLike) -> LinearPrediction:
    """p(y | x, D), a Gaussian, where the noise has the variance `noise` (item 8.57)."""
    spread = posterior.scale.T @ x
    return LinearPrediction(posterior.mean @ x, jnp.asarray(noise, x.dtype), spread @ spread)


class StudentT(eqx.Module):
    """Student's law about a location, with a scale (not a deviation) and degrees of freedom."""

    location: Float[Array, ""]
    scale: Float[Array, ""]
    freedom: Float[Array, ""]

    def log_prob(self, value: Float[Array, ""]) -> Float[Array, ""]:
        """Logarithm of the density."""
        z, nu = (value - self.location) / self.scale, self.freedom
        # B(nu/2, 1/2) in place of two gamma functions, whose difference loses digits where nu is large.
        shape = -betaln(0.5 * nu, 0.5) - 0.5 * jnp.log(nu) - jnp.log(self.scale)
        return shape - 0.5 * (nu + 1.0) * jnp.log1p(z**2 / nu)

    def variance(self) -> Float[Array, ""]:
        """The variance, infinite for 2 degrees of freedom and less."""
        large = self.freedom > 2.0
        return jnp.where(large, self.scale**2 * self.freedom / jnp.where(large, self.freedom - 2.0, 1.0), jnp.inf)

    def entropy(self) -> Float[Array, ""]:
        """E[-log p], in nats."""
        nu = self.freedom
        half = 0.5 * (nu + 1.0)
        spread = half * (digamma(half) - digamma(0.5 * nu))
        return spread + 0.5 * jnp.log(nu) + betaln(0.5 * nu, 0.5) + jnp.log(self.scale)

    def sample(self, key: Key[Array, ""]) -> Float[Array, ""]:
        """One draw."""
        return self.location + self.scale * jax.random.t(key, self.freedom, dtype=self.location.dtype)


class NormalInverseGamma(eqx.Module):
    """What is believed of weights and noise: sigma^2 ~ IG(shape, rate), theta | sigma^2 ~ N(mean, sigma^2 precision^-1)."""

    mean: Float[Array, "F"]
    precision: Float[Array, "F F"]
    shape: Float[Array, ""]
    rate: Float[Array, ""]

    @staticmethod
    def vague(features: int, prior: float = 1e-3) -> "NormalInverseGamma":
        """Hardly any belief: weights around 0, shape and rate and precision `prior`."""
        small = jnp.asarray(prior, jnp.zeros(()).dtype)
        return NormalInverseGamma(jnp.zeros(features), small * jnp.eye(features), small, small)

    def observe(self, x: Float[Array, "N F"], y: Float[Array, "N"]) -> "NormalInverseGamma":
        """After N more samples, in whatever portions they come."""
        precision = self.precision + x.T @ x
        pull = self.precision @ self.mean + x.T @ y
        mean = cho_solve((jnp.linalg.cholesky(precision), True), pull)
        # As squares, which cannot become negative by rounding: b + (|y - X m|^2 + (m - m_0)' Lambda_0 (m - m_0)) / 2.
        moved = mean - self.mean
        rate = self.rate + 0.5 * (((y - x @ mean) ** 2).sum() + moved @ self.precision @ moved)
        return NormalInverseGamma(mean, precision, self.shape + 0.5 * len(y), rate)

    def predict(self, x: Float[Array, "F"]) -> StudentT:
        """p(y | x, D)."""
        spread = solve_triangular(jnp.linalg.cholesky(self.precision), x, lower=True)
        scale = jnp.sqrt(self.rate / self.shape * (1.0 + spread @ spread))
        return StudentT(self.mean @ x, scale, 2.0 * self.shape)

    def sample(self, key: Key[Array, ""]) -> tuple[Float[Array, "F"], Float[Array, ""]]:
        """One draw of theta and sigma^2."""
        noise_key, weight_key = jax.random.split(key)
        noise = self.rate / jax.random.gamma(noise_key, self.shape, dtype=self.rate.dtype)
        z = jax.random.normal(weight_key, self.mean.shape, self.mean.dtype)
        root = jnp.linalg.cholesky(self.precision)
        return self.mean + jnp.sqrt(noise) * solve_triangular(root, z, lower=True, trans=1), noise

    def log_evidence(self, x: Float[Array, "N F"], y: Float[Array, "N"]) -> Float[Array, ""]:
        """The logarithm of p(y | X), theta and sigma^2 integrated out: what models can be compared by."""
        after = self.observe(x, y)
        log_det = lambda a: 2.0 * jnp.log(jnp.diagonal(jnp.linalg.cholesky(a))).sum()  # noqa: E731
        return (
            0.5 * (log_det(self.precision) - log_det(after.precision)) - 0.5 * len(y) * jnp.log(2.0 * jnp.pi)
            + self.shape * jnp.log(self.rate) - after.shape * jnp.log(after.rate)
            + gammaln(after.shape) - gammaln(self.shape)
        )  # fmt: skip


class RegressionMoments(eqx.Module):
    """Sums over samples of x x', y x', y y' and 1: all that a linear regression of y `[D]` on x `[F]` needs to know. They add."""

    xx: Float[Array, "*N F F"]
    yx: Float[Array, "*N D F"]
    yy: Float[Array, "*N D D"]
    count: Float[Array, "*N"]

    @staticmethod
    def of(x: Float[Array, "N F"], y: Float[Array, "N D"]) -> "RegressionMoments":
        """Of samples."""
        return RegressionMoments(x.T @ x, y.T @ x, y.T @ y, jnp.asarray(len(x), x.dtype))

    def __add__(self, other: "RegressionMoments") -> "RegressionMoments":
        return jax.tree.map(jnp.add, self, other)

    def scaled(self, factor: ScalarLike) -> "RegressionMoments":
        """As if each sample counted `factor` times."""
        return jax.tree.map(lambda a: a * jnp.asarray(factor, a.dtype), self)


class MatrixNormalInverseWishart(eqx.Module):
    r"""What is known of W `[D, F]` and Sigma `[D, D]` in y = W x + N(0, Sigma): $\Sigma \sim \mathrm{IW}(\Psi, \nu)$,
    $W \mid \Sigma \sim \mathrm{MN}(M, \Sigma, \Lambda^{-1})$, conjugate.

    Held by the moments that have been seen, a prior's as if seen: $\Lambda$, $M \Lambda$, $\Psi + M \Lambda M^\top$, and a count
    $\nu - D - 1$, so that data are added and nothing else. For D = 1 it is `NormalInverseGamma` with $a = \nu / 2$, $b = \Psi / 2$.
    """

    seen: RegressionMoments

    @staticmethod
    def of(
        mean: Float[Array, "D F"], precision: Float[Array, "F F"], scale: Float[Array, "D D"], freedom: ScalarLike
    ) -> "MatrixNormalInverseWishart":
        """From M, Lambda, Psi and nu > D - 1."""
        weighted = mean @ precision
        count = jnp.asarray(freedom, mean.dtype) - len(mean) - 1.0
        return MatrixNormalInverseWishart(RegressionMoments(precision, weighted, scale + weighted @ mean.T, count))

    @property
    def mean(self) -> Float[Array, "D F"]:
        """M, the mean of W."""
        return cho_solve((jnp.linalg.cholesky(self.seen.xx), True), self.seen.yx.T).T

    @property
    def scale(self) -> Float[Array, "D D"]:
        """Psi."""
        explained = self.mean @ self.seen.yx.T
        left = self.seen.yy - 0.5 * (explained + explained.T)
        return 0.5 * (left + left.T)

    @property
    def freedom(self) -> Float[Array, ""]:
        """The degrees of freedom nu."""
        return self.seen.count + len(self.seen.yy) + 1.0

    @property
    def noise(self) -> Float[Array, "D D"]:
        """The inverse of E[Sigma^-1], Psi / nu: the covariance of the Gaussian that E[log p(y | x, W, Sigma)] is made of."""
        return self.scale / self.freedom

    def observe(self, moments: RegressionMoments) -> "MatrixNormalInverseWishart":
        """After more samples, in whatever portions they come."""
        return MatrixNormalInverseWishart(self.seen + moments)

    def expected_log_det(self) -> Float[Array, ""]:
        """E[log |Sigma|]."""
        size = len(self.seen.yy)
        steps = jnp.arange(size, dtype=self.seen.yy.dtype)
        return _log_det(self.scale) - size * jnp.log(2.0) - digamma(0.5 * (self.freedom - steps)).sum()

    def expected_log_prob(self, x: Float[Array, "F"], y: Float[Array, "D"]) -> Float[Array, ""]:
        """E[log N(y; W x, Sigma)]: that of a Gaussian of covariance `noise`, less D x' Lambda^-1 x / 2 for not knowing W."""
        error, size = y - self.mean @ x, len(y)
        square = error @ cho_solve((jnp.linalg.cholesky(self.noise), True), error)
        spread = solve_triangular(jnp.linalg.cholesky(self.seen.xx), x, lower=True)
        return -0.5 * (square + size * (spread @ spread) + self.expected_log_det() + size * jnp.log(2.0 * jnp.pi))

    def log_normaliser(self) -> Float[Array, ""]:
        """Of the density in its natural parameters; of differences of it the evidence is made."""
        size, features = self.seen.yx.shape
        nu = self.freedom
        return (
            multigammaln(0.5 * nu, size) + 0.5 * nu * size * jnp.log(2.0)
            - 0.5 * nu * _log_det(self.scale) - 0.5 * size * _log_det(self.seen.xx)
            + 0.5 * size * features * jnp.log(2.0 * jnp.pi)
        )  # fmt: skip

    def log_evidence(self, moments: RegressionMoments) -> Float[Array, ""]:
        """The logarithm of p(Y | X), W and Sigma integrated out."""
        size = len(self.seen.yy)
        after = self.observe(moments)
        constant = 0.5 * size * moments.count * jnp.log(2.0 * jnp.pi)
        return after.log_normaliser() - self.log_normaliser() - constant

    def kl(self, other: "MatrixNormalInverseWishart") -> Float[Array, ""]:
        """KL(self || other) in nats, of laws of the same shape."""
        size, features = self.seen.yx.shape
        nu, theirs = self.freedom, other.freedom
        steps = jnp.arange(size, dtype=nu.dtype)
        inverse = cho_solve((jnp.linalg.cholesky(self.scale), True), jnp.eye(size, dtype=nu.dtype))
        wishart = (
            0.5 * theirs * (_log_det(self.scale) - _log_det(other.scale))
            + 0.5 * nu * ((inverse * other.scale).sum() - size)
            + multigammaln(0.5 * theirs, size) - multigammaln(0.5 * nu, size)
            + 0.5 * (nu - theirs) * digamma(0.5 * (nu - steps)).sum()
        )  # fmt: skip
        gap = self.mean - other.mean
        ratio = cho_solve((jnp.linalg.cholesky(self.seen.xx), True), other.seen.xx)
        shifted = nu * (inverse * (gap @ other.seen.xx @ gap.T)).sum()
        weights = size * (jnp.trace(ratio) - features) + shifted
        weights = weights + size * (_log_det(self.seen.xx) - _log_det(other.seen.xx))
        return wishart + 0.5 * weights


def _log_det(a: Float[Array, "N N"]) -> Float[Array, ""]:
    return 2.0 * jnp.log(jnp.diagonal(jnp.linalg.cholesky(a))).sum()
