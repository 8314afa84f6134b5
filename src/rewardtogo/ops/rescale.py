r"""A compressed scale for values of any size, so that rewards need not be clipped (Pohlen et al. 2018; Kapturowski et al. 2019).

$$h(x) = \mathrm{sign}(x)\, (\sqrt{|x| + 1} - 1) + \epsilon x, \qquad y = h\big(r + \gamma\, h^{-1}(Q(s', a'))\big).$$

The term $\epsilon x$ makes the inverse Lipschitz-continuous. $h$ is not linear, so the expectation of what is learned is not $h$ of the
expected return where returns are random: their order, not their value, is what may be trusted then.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

EPSILON = 1e-3


def compress(x: Float[Array, "*S"], epsilon: float = EPSILON) -> Float[Array, "*S"]:
    """h(x)."""
    # The difference sqrt(|x| + 1) - 1, without losing the digits of a small x.
    return x / (jnp.sqrt(jnp.abs(x) + 1.0) + 1.0) + epsilon * x


def expand(x: Float[Array, "*S"], epsilon: float = EPSILON) -> Float[Array, "*S"]:
    """The inverse of `compress`."""
    # With u = sqrt(|y| + 1) - 1, |x| = u + epsilon (u^2 + 2 u); the root, written without a difference of nearly equal numbers.
    size, linear = jnp.abs(x), 1.0 + 2.0 * epsilon
    above = 2.0 * size / (linear + jnp.sqrt(linear**2 + 4.0 * epsilon * size))
    return jnp.sign(x) * above * (above + 2.0)
