r"""Importance sampling: expectations under p from samples of q.

$$\mathbb{E}_p[f] = \mathbb{E}_q\!\left[\tfrac{p}{q} f\right] \approx \tfrac1N \sum_i w_i f_i, \qquad
\text{self-normalised: } \frac{\sum_i w_i f_i}{\sum_i w_i}, \qquad
\text{ESS} = \frac{(\sum_i w_i)^2}{\sum_i w_i^2}.$$

Weights stay logarithms until the end, so that products over long trajectories neither overflow nor vanish.

Source: notes 3.8.1; Kong 1992 (effective sample size).
"""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.nn import logsumexp, softmax
from jaxtyping import Array, Float


def log_ratio(log_p: Float[Array, "*S"], log_q: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """log(p / q) at samples of q; minus infinity where p is 0.

    Raises `ValueError` where q is 0 and p is not: no weight can make up for what q never visits. Traced values cannot
    be looked at, and give infinity there.
    """
    if not isinstance(log_p, Tracer) and not isinstance(log_q, Tracer):
        missed = int(np.sum(np.isneginf(np.asarray(log_q)) & ~np.isneginf(np.asarray(log_p))))
        if missed:
            raise ValueError(
                f"the proposal has probability 0 at {missed} of {log_p.size} values that the target can take: "
                "sample from a law that covers the target"
            )
    impossible = jnp.isneginf(log_p)
    return jnp.where(impossible, -jnp.inf, jnp.where(impossible, 0.0, log_p) - jnp.where(impossible, 0.0, log_q))


def importance_weights(log_p: Float[Array, "N"], log_q: Float[Array, "N"]) -> Float[Array, "N"]:
    """Ratios p / q at N samples of q. Raises `ValueError` as `log_ratio` does."""
    return jnp.exp(log_ratio(log_p, log_q))


def normalised_weights(log_w: Float[Array, "N"]) -> Float[Array, "N"]:
    """Weights that sum to 1."""
    return softmax(log_w)


def effective_sample_size(log_w: Float[Array, "N"]) -> Float[Array, ""]:
    """How many equally weighted samples are worth as much: N where p = q, 1 where one weight dwarfs the rest."""
    return jnp.exp(2.0 * logsumexp(log_w) - logsumexp(2.0 * log_w))


def importance_mean(f: Float[Array, "N"], log_w: Float[Array, "N"]) -> Float[Array, ""]:
    """The plain estimate of E_p[f]: unbiased."""
    return jnp.mean(jnp.exp(log_w) * f)


def self_normalised_mean(f: Float[Array, "N"], log_w: Float[Array, "N"]) -> Float[Array, ""]:
    """The self-normalised estimate of E_p[f]: biased by O(1/N), exact for constant f, steadier for unequal weights."""
    return jnp.sum(normalised_weights(log_w) * f)
