r"""A mixture of Gaussians, and nodes for expectations that have no closed form.

$$p(a) = \sum_k w_k\, N(a; \mu_k, \sigma_k^2), \qquad w_k \ge 0, \quad \sum_k w_k = 1.$$

It is the densities that are summed with weights (erratum E2.8): a weighted sum of Gaussian random variables would be one
Gaussian again. A sample chooses a component and draws from it.

Source: notes, section 2.3.2; Bishop 1994 (mixture density networks).
"""

import functools
import statistics

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from .distributions import HALF_LOG_2PI, Distribution

NODES = 64
"""Points per component of an estimated expectation."""


@functools.cache
def normal_nodes(count: int, size: int) -> Float[np.ndarray, "M Z"]:
    """`count` points spread like N(0, I) in `size` dimensions, the same at every call; their mean is exactly 0.

    A lattice of irrational steps (Roberts 2018) through the inverse distribution function, each point with its mirror image.
    """
    ratio = 2.0
    for _ in range(64):
        ratio = (1.0 + ratio) ** (1.0 / (size + 1))
    half = np.arange(1, count // 2 + 1)[:, None]
    uniform = (0.5 + half * ratio ** -np.arange(1.0, size + 1)) % 1.0
    points = np.vectorize(statistics.NormalDist().inv_cdf)(uniform)
    return np.concatenate([points, -points]).astype(np.float32)


class GaussianMixture(Distribution):
    """K diagonal Gaussians with weights softmax(logits).

    `entropy` and `kl` have no closed form: both are means of log p over `NODES` fixed points of each component, right to a few
    hundredths where there are few dimensions, and differentiable.
    """

    logits: Float[Array, "K"]
    mean: Float[Array, "K *A"]
    log_std: Float[Array, "K *A"]

    @property
    def weights(self) -> Float[Array, "K"]:
        """The weights of the components."""
        return jax.nn.softmax(self.logits)

    def sample(self, key: Key[Array, ""]) -> Float[Array, "*A"]:
        choice_key, noise_key = jax.random.split(key)
        k = jax.random.categorical(choice_key, self.logits)
        noise = jax.random.normal(noise_key, self.mean.shape[1:], self.mean.dtype)
        return self.mean[k] + jnp.exp(self.log_std[k]) * noise

    def log_prob(self, value: Float[Array, "*A"]) -> Float[Array, ""]:
        standard = (value[None] - self.mean) * jnp.exp(-self.log_std)
        terms = -0.5 * jnp.square(standard) - self.log_std - HALF_LOG_2PI
        by_component = terms.reshape(len(self.logits), -1).sum(-1)
        return jax.nn.logsumexp(jax.nn.log_softmax(self.logits) + by_component)

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Float[Array, "*A"], Float[Array, ""]]:
        value = self.sample(key)
        return value, self.log_prob(value)

    def entropy(self) -> Float[Array, ""]:
        return -self._expect(self)

    def mode(self) -> Float[Array, "*A"]:
        """The mean of the component that has the highest density there: the mode, where components lie apart."""
        return self.mean[jnp.argmax(jax.vmap(self.log_prob)(self.mean))]

    def kl(self, other: "GaussianMixture") -> Float[Array, ""]:
        return self._expect(self) - self._expect(other)

    def _expect(self, other: "GaussianMixture") -> Float[Array, ""]:
        """E[log q(a)] under this mixture, for `other` = q."""
        shape = self.mean.shape[1:]
        nodes = jnp.asarray(normal_nodes(NODES, max(self.mean[0].size, 1))).reshape(NODES, 1, *shape)
        points = self.mean[None] + jnp.exp(self.log_std)[None] * nodes
        found = jax.vmap(jax.vmap(lambda a: other.log_prob(a)))(points)
        return jnp.dot(self.weights, found.mean(0))
