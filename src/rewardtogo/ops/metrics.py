"""Numbers that tell how training goes."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def explained_variance(value: Float[Array, "*S"], target: Float[Array, "*S"]) -> Float[Array, ""]:
    """1 - Var(target - value) / Var(target): 1 is a perfect critic, 0 one that knows nothing. 0 where targets do not vary."""
    spread = jnp.var(target)
    return jnp.where(spread > 0, 1.0 - jnp.var(target - value) / jnp.where(spread > 0, spread, 1.0), 0.0)
