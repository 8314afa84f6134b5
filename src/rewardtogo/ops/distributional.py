r"""Whole distributions of the return: C51's projection and the loss of quantile regression, for one state and action.

**Categorical** (Bellemare et al. 2017). Atoms $z_i$ with probabilities $p_i$ move to $r + \gamma z_i$ and share their mass between the
two fixed atoms beside them, in proportion to nearness; outside the support it goes to the end.

**Quantiles** (Dabney et al. 2018). $\theta_i$ is the quantile of level $\hat\tau_i = (i + 1/2) / N$. Their loss against samples $y_j$ is

$$\sum_i \frac{1}{M} \sum_j |\hat\tau_i - [y_j < \theta_i]|\, \frac{L_\kappa(y_j - \theta_i)}{\kappa},$$

with Huber's $L_\kappa$; without the division by $\kappa$, as in the paper's (10), the loss would vanish as $\kappa \to 0$ in place of
becoming that of quantile regression.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from .td import huber


def categorical_projection(
    from_z: Float[Array, "N"], probabilities: Float[Array, "N"], to_z: Float[Array, "M"]
) -> Float[Array, "M"]:
    """Probabilities on the atoms `to_z`, equally spaced and rising, of the distribution with `probabilities` on the atoms `from_z`.

    The mean stays what it was unless mass lies outside of `to_z`.
    """
    gap = to_z[1] - to_z[0]
    inside = jnp.clip(from_z, to_z[0], to_z[-1])
    share = jnp.clip(1.0 - jnp.abs(inside[None, :] - to_z[:, None]) / gap, 0.0, 1.0)
    return share @ probabilities


def quantile_levels(number: int) -> Float[Array, "N"]:
    """The midpoints (i + 1/2) / N: where the quantiles of N equally likely atoms are nearest to any distribution."""
    return (jnp.arange(number, dtype=jnp.float32) + 0.5) / number


def quantile_huber(
    quantiles: Float[Array, "N"], samples: Float[Array, "M"], kappa: ScalarLike = 1.0
) -> Float[Array, ""]:
    """How badly `quantiles`, at the levels (i + 1/2) / N, describe the `samples`: summed over levels, averaged over samples."""
    error = samples[None, :] - quantiles[:, None]
    level = quantile_levels(quantiles.shape[0])[:, None]
    weight = jnp.abs(level - (error < 0).astype(error.dtype))
    return (weight * huber(error, kappa) / kappa).mean(1).sum()
