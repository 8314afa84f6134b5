r"""Distances between probability vectors and between Gaussians.

$$\mathrm{KL}(p \,\|\, q) = \mathbb{E}_p[\log p - \log q], \qquad
\mathrm{TV}(p, q) = \tfrac12 \sum_i |p_i - q_i| = \tfrac12 L_1,$$
$$\mathrm{KL}(N_1 \| N_2) = \tfrac12 \left[\mathrm{tr}(\Sigma_2^{-1} \Sigma_1)
+ (m_2 - m_1)^\top \Sigma_2^{-1} (m_2 - m_1) - k + \log \tfrac{\det \Sigma_2}{\det \Sigma_1}\right].$$

The notes print the KL with its logarithms swapped, which is minus a divergence (erratum E3.11), and call the L1
distance total variation (erratum E2.3); the names here say which is which.

Source: notes 2.4, 3.9.1.
"""

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, ScalarLike


def kl_categorical(p: Float[Array, "A"], q: Float[Array, "A"]) -> Float[Array, ""]:
    """KL(p || q) of two probability vectors; infinite where q is 0 and p is not."""
    possible = p > 0.0
    ratio = jnp.log(jnp.where(possible, p, 1.0)) - jnp.log(jnp.where(possible, q, 1.0))
    return jnp.sum(jnp.where(possible, p * ratio, 0.0))


def entropy(p: Float[Array, "A"]) -> Float[Array, ""]:
    """Entropy of a probability vector, in nats, with 0 log 0 = 0."""
    return -jnp.sum(p * jnp.log(jnp.where(p > 0.0, p, 1.0)))


def l1_distance(p: Float[Array, "A"], q: Float[Array, "A"]) -> Float[Array, ""]:
    """The sum of |p - q|, at most 2."""
    return jnp.sum(jnp.abs(p - q))


def tv_distance(p: Float[Array, "A"], q: Float[Array, "A"]) -> Float[Array, ""]:
    """Total variation: half the L1 distance, the greatest difference in the probability of any event, at most 1."""
    return 0.5 * l1_distance(p, q)


def kl_gaussian(
    m1: Float[Array, "A"], S1: Float[Array, "A A"], m2: Float[Array, "A"], S2: Float[Array, "A A"]
) -> Float[Array, ""]:
    """KL(N(m1, S1) || N(m2, S2)) with full, positive definite covariances."""
    root1, root2 = jnp.linalg.cholesky(S1), jnp.linalg.cholesky(S2)
    ratio = solve_triangular(root2, root1, lower=True)
    shift = solve_triangular(root2, m2 - m1, lower=True)
    log_dets = jnp.sum(jnp.log(jnp.diagonal(root2))) - jnp.sum(jnp.log(jnp.diagonal(root1)))
    return 0.5 * (jnp.sum(jnp.square(ratio)) + jnp.sum(jnp.square(shift)) - m1.size) + log_dets


def kl_sampled(log_p: Float[Array, "N"], log_q: Float[Array, "N"]) -> Float[Array, ""]:
    """The Monte Carlo estimate of KL(p || q): the mean of log p - log q at N samples of p."""
    return jnp.mean(log_p - log_q)


def survival(eps: ScalarLike, t: ScalarLike) -> Float[Array, ""]:
    """(1 - eps)^t, the chance of no mistake in t steps with a mistake of chance eps in each."""
    return (1.0 - jnp.asarray(eps, float)) ** jnp.asarray(t, float)


def survival_bound(eps: ScalarLike, t: ScalarLike) -> Float[Array, ""]:
    """1 - eps t, which is at most `survival(eps, t)` for eps in [0, 1] and t = 0 or t >= 1 (Bernoulli's inequality)."""
    return 1.0 - jnp.asarray(eps, float) * jnp.asarray(t, float)
