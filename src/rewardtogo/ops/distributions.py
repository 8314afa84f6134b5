r"""What a policy samples from: categorical, Gaussian, squashed Gaussian and factored laws over one action.

Each class is the law of a single action, without a batch axis (`vmap` it), and knows `sample`, `log_prob`, `entropy`,
`mode` and the exact `kl`. The Gaussians follow

$$\log \pi(a \mid s) = -\tfrac12 (a - f)^\top \Sigma^{-1} (a - f) - \tfrac12 \log\det(2\pi\Sigma),$$

and a squashed action $a = c + h \tanh(u)$, $u \sim N(\mu, \sigma^2)$, has
$\log p(a) = \log N(u) - \sum_i [\log h_i + 2(\log 2 - u_i - \mathrm{softplus}(-2u_i))]$, which takes no logarithm of a
rounded $1 - \tanh^2 u$. Continuous samples are differentiable with respect to the parameters (reparametrised).

Source: notes 3.3 (Gaussian policy, errata E3.1 and E3.2), 3.9.1 (KL, erratum E3.11); Haarnoja et al. 2018, appendix C
(squashing).
"""

import math
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int8, Int32, Integer, Key

from .quadrature import log_det_tanh, mean_log_det_tanh

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Distribution(eqx.Module):
    """The law of one action. `kl` compares two laws of the same class."""

    @abstractmethod
    def sample(self, key: Key[Array, ""]) -> Array:
        """One draw."""

    @abstractmethod
    def log_prob(self, value: Array) -> Float[Array, ""]:
        """Logarithm of the probability (or density) of one value."""

    @abstractmethod
    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Array, Float[Array, ""]]:
        """One draw, and its log-probability, without going through the inverse of a squashing."""

    @abstractmethod
    def entropy(self) -> Float[Array, ""]:
        """E[-log p], in nats."""

    @abstractmethod
    def mode(self) -> Array:
        """The likeliest value; for a squashed Gaussian the squashed mean."""

    @abstractmethod
    def kl(self, other: Any) -> Float[Array, ""]:
        """KL(self || other), exact."""


def _mask_logits(logits: Array, mask: Array) -> Array:
    # Finite, so that 0 * log 0 is 0 and not NaN; half the least number, so that differences of two do not overflow.
    return jnp.where(mask, logits, 0.5 * jnp.finfo(logits.dtype).min)


def _plogp(log_p: Array, log_of: Array) -> Array:
    return jnp.sum(jnp.exp(log_p) * log_of)


class Categorical(Distribution):
    """One of A choices, with probabilities softmax(logits). Samples are int32 scalars."""

    logits: Float[Array, "A"]

    @staticmethod
    def masked(logits: Float[Array, "A"], mask: Bool[Array, "A"] | Integer[Array, "A"]) -> "Categorical":
        """The law restricted to the choices where `mask` is true; the others have probability exactly 0.

        The log-probability of a forbidden choice is a huge negative number instead of minus infinity, so that no NaN
        arises. At least one choice must be allowed.
        """
        return Categorical(_mask_logits(logits, mask.astype(bool)))

    @property
    def log_probs(self) -> Float[Array, "A"]:
        """Log-probabilities of all choices."""
        return jax.nn.log_softmax(self.logits)

    @property
    def probs(self) -> Float[Array, "A"]:
        """Probabilities of all choices."""
        return jax.nn.softmax(self.logits)

    def sample(self, key: Key[Array, ""]) -> Int32[Array, ""]:
        return jax.random.categorical(key, self.logits).astype(jnp.int32)

    def log_prob(self, value: Integer[Array, ""]) -> Float[Array, ""]:
        return self.log_probs[value]

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Int32[Array, ""], Float[Array, ""]]:
        value = self.sample(key)
        return value, self.log_prob(value)

    def entropy(self) -> Float[Array, ""]:
        log_p = self.log_probs
        return -_plogp(log_p, log_p)

    def mode(self) -> Int32[Array, ""]:
        return jnp.argmax(self.logits).astype(jnp.int32)

    def kl(self, other: "Categorical") -> Float[Array, ""]:
        log_p = self.log_probs
        return _plogp(log_p, log_p - other.log_probs)


class MultiCategorical(Distribution):
    """Independent entries, `counts[i]` choices for entry i, logits one after another. Samples are int32 of `shape`."""

    logits: Float[Array, "L"]
    counts: tuple[int, ...] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    def __check_init__(self) -> None:
        if not self.counts or min(self.counts) < 1 or math.prod(self.shape) != len(self.counts):
            raise ValueError(
                f"MultiCategorical got counts {self.counts} for the shape {self.shape}: give a positive one per entry"
            )
        if self.logits.shape != (sum(self.counts),):
            raise ValueError(
                f"MultiCategorical got {self.logits.size} logits for the counts {self.counts}: give {sum(self.counts)}"
            )

    @property
    def table(self) -> Float[Array, "N A"]:
        """The logits as one row per entry, padded to the greatest count with forbidden choices."""
        widest = max(self.counts)
        if min(self.counts) == widest:
            return self.logits.reshape(-1, widest)
        column = np.arange(widest)
        valid = column < np.asarray(self.counts)[:, None]
        start = np.concatenate([[0], np.cumsum(self.counts)[:-1]])
        return _mask_logits(self.logits[np.where(valid, start[:, None] + column, 0)], jnp.asarray(valid))

    @property
    def log_probs(self) -> Float[Array, "N A"]:
        """Log-probabilities, one row per entry, padded to the greatest count."""
        return jax.nn.log_softmax(self.table, axis=-1)

    def sample(self, key: Key[Array, ""]) -> Int32[Array, "..."]:
        return jax.random.categorical(key, self.table).astype(jnp.int32).reshape(self.shape)

    def log_prob(self, value: Integer[Array, "..."]) -> Float[Array, ""]:
        return jnp.sum(jnp.take_along_axis(self.log_probs, value.reshape(-1, 1), axis=1))

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Int32[Array, "..."], Float[Array, ""]]:
        value = self.sample(key)
        return value, self.log_prob(value)

    def entropy(self) -> Float[Array, ""]:
        log_p = self.log_probs
        return -_plogp(log_p, log_p)

    def mode(self) -> Int32[Array, "..."]:
        return jnp.argmax(self.table, axis=-1).astype(jnp.int32).reshape(self.shape)

    def kl(self, other: "MultiCategorical") -> Float[Array, ""]:
        log_p = self.log_probs
        return _plogp(log_p, log_p - other.log_probs)


class Bernoulli(Distribution):
    """Independent bits, each 1 with probability sigmoid(logit). Samples are int8, in the shape of the logits."""

    logits: Float[Array, "..."]

    @property
    def probs(self) -> Float[Array, "..."]:
        """Probability of a 1."""
        return jax.nn.sigmoid(self.logits)

    def sample(self, key: Key[Array, ""]) -> Int8[Array, "..."]:
        return jax.random.bernoulli(key, self.probs).astype(jnp.int8)

    def log_prob(self, value: Integer[Array, "..."] | Bool[Array, "..."]) -> Float[Array, ""]:
        return -jnp.sum(jax.nn.softplus(jnp.where(value.astype(bool), -self.logits, self.logits)))

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Int8[Array, "..."], Float[Array, ""]]:
        value = self.sample(key)
        return value, self.log_prob(value)

    def entropy(self) -> Float[Array, ""]:
        return self._cross_entropy(self.logits)

    def mode(self) -> Int8[Array, "..."]:
        return (self.logits > 0).astype(jnp.int8)

    def kl(self, other: "Bernoulli") -> Float[Array, ""]:
        return self._cross_entropy(other.logits) - self._cross_entropy(self.logits)

    def _cross_entropy(self, logits: Array) -> Array:
        return jnp.sum(
            jax.nn.sigmoid(self.logits) * jax.nn.softplus(-logits)
            + jax.nn.sigmoid(-self.logits) * jax.nn.softplus(logits)
        )


def _normal_log_prob(value: Array, mean: Array, log_std: Array) -> Array:
    return jnp.sum(-0.5 * jnp.square((value - mean) * jnp.exp(-log_std)) - log_std - HALF_LOG_2PI)


def _normal_kl(mean: Array, log_std: Array, other_mean: Array, other_log_std: Array) -> Array:
    # expm1, because the KL of two close policies is what gets compared to small thresholds.
    log_ratio = 2.0 * (log_std - other_log_std)
    shift = jnp.square((mean - other_mean) * jnp.exp(-other_log_std))
    return 0.5 * jnp.sum(jnp.expm1(log_ratio) - log_ratio + shift)


class DiagGaussian(Distribution):
    """Independent Gaussian entries of standard deviation exp(log_std), in any shape; sums over all axes."""

    mean: Float[Array, "*A"]
    log_std: Float[Array, "*A"]

    @property
    def std(self) -> Float[Array, "*A"]:
        """Standard deviation of each entry."""
        return jnp.exp(self.log_std)

    def sample(self, key: Key[Array, ""]) -> Float[Array, "..."]:
        return self.mean + self.std * jax.random.normal(key, self.mean.shape, self.mean.dtype)

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, ""]:
        return _normal_log_prob(value, self.mean, self.log_std)

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Float[Array, "..."], Float[Array, ""]]:
        value = self.sample(key)
        return value, self.log_prob(value)

    def entropy(self) -> Float[Array, ""]:
        return jnp.sum(self.log_std + (0.5 + HALF_LOG_2PI))

    def mode(self) -> Float[Array, "..."]:
        return self.mean

    def kl(self, other: "DiagGaussian") -> Float[Array, ""]:
        return _normal_kl(self.mean, self.log_std, other.mean, other.log_std)


class FullGaussian(Distribution):
    """A Gaussian of covariance `scale @ scale.T`; `scale` is lower triangular with a positive diagonal (Cholesky)."""

    mean: Float[Array, "A"]
    scale: Float[Array, "A A"]

    @staticmethod
    def of_covariance(mean: Float[Array, "A"], covariance: Float[Array, "A A"]) -> "FullGaussian":
        """The Gaussian with this covariance, which must be positive definite."""
        return FullGaussian(mean, jnp.linalg.cholesky(covariance))

    @property
    def covariance(self) -> Float[Array, "A A"]:
        """Sigma."""
        return self.scale @ self.scale.T

    def sample(self, key: Key[Array, ""]) -> Float[Array, "A"]:
        return self.mean + self.scale @ jax.random.normal(key, self.mean.shape, self.mean.dtype)

    def log_prob(self, value: Float[Array, "A"]) -> Float[Array, ""]:
        standard = solve_triangular(self.scale, value - self.mean, lower=True)
        return -0.5 * jnp.sum(jnp.square(standard)) - self._log_det() - HALF_LOG_2PI * self.mean.size

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Float[Array, "A"], Float[Array, ""]]:
        value = self.sample(key)
        return value, self.log_prob(value)

    def entropy(self) -> Float[Array, ""]:
        return self._log_det() + (0.5 + HALF_LOG_2PI) * self.mean.size

    def mode(self) -> Float[Array, "A"]:
        return self.mean

    def kl(self, other: "FullGaussian") -> Float[Array, ""]:
        ratio = solve_triangular(other.scale, self.scale, lower=True)
        shift = solve_triangular(other.scale, self.mean - other.mean, lower=True)
        squares = jnp.sum(jnp.square(ratio)) + jnp.sum(jnp.square(shift)) - self.mean.size
        return 0.5 * squares + other._log_det() - self._log_det()

    def _log_det(self) -> Array:
        return jnp.sum(jnp.log(jnp.diagonal(self.scale)))


class TanhGaussian(Distribution):
    """A Gaussian squashed into the box: a = centre + half * tanh(u), u ~ N(mean, exp(log_std)^2), sums over all axes.

    `low` and `high` are scalars or have the shape of `mean`. At the bounds themselves, where u is infinite, `log_prob`
    gives the finite value of a point just inside.
    """

    mean: Float[Array, "*A"]
    log_std: Float[Array, "*A"]
    low: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    high: Float[Array, "..."] = eqx.field(converter=jnp.asarray)

    def sample(self, key: Key[Array, ""]) -> Float[Array, "..."]:
        return self._squash(self._sample_before(key))

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, ""]:
        edge = 1.0 - float(jnp.finfo(self.mean.dtype).eps)
        return self._log_prob_before(jnp.arctanh(jnp.clip((value - self._centre()) / self._half(), -edge, edge)))

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Float[Array, "..."], Float[Array, ""]]:
        before = self._sample_before(key)
        return self._squash(before), self._log_prob_before(before)

    def entropy(self) -> Float[Array, ""]:
        """By quadrature with fixed nodes, since there is no closed form; the error is below 1e-5 per entry."""
        log_half = jnp.broadcast_to(jnp.log(self._half()), self.mean.shape)
        gaussian = self.log_std + (0.5 + HALF_LOG_2PI)
        return jnp.sum(gaussian + log_half + mean_log_det_tanh(self.mean, jnp.exp(self.log_std)))

    def mode(self) -> Float[Array, "..."]:
        return self._squash(self.mean)

    def kl(self, other: "TanhGaussian") -> Float[Array, ""]:
        """Equal to the KL of the Gaussians, as the squashing cancels; both laws must have the same bounds."""
        for mine, theirs in ((self.low, other.low), (self.high, other.high)):
            known = not isinstance(mine, Tracer) and not isinstance(theirs, Tracer)
            if known and np.any(np.asarray(mine) != np.asarray(theirs)):
                raise ValueError(
                    f"the KL of squashed Gaussians needs equal bounds, not {mine} and {theirs}: use one action space"
                )
        return _normal_kl(self.mean, self.log_std, other.mean, other.log_std)

    def _sample_before(self, key: Array) -> Array:
        return self.mean + jnp.exp(self.log_std) * jax.random.normal(key, self.mean.shape, self.mean.dtype)

    def _squash(self, before: Array) -> Array:
        # The product can round to one unit outside the box.
        return jnp.clip(self._centre() + self._half() * jnp.tanh(before), self.low, self.high)

    def _log_prob_before(self, before: Array) -> Array:
        log_half = jnp.broadcast_to(jnp.log(self._half()), self.mean.shape)
        return _normal_log_prob(before, self.mean, self.log_std) - jnp.sum(log_half + log_det_tanh(before))

    def _centre(self) -> Array:
        return 0.5 * (self.low + self.high)

    def _half(self) -> Array:
        return 0.5 * (self.high - self.low)
