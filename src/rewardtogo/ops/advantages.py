r"""Advantages along one trajectory, time-major `[T]`.

With $\delta_t = r_t + \gamma_t V(s_{t+1}) - V(s_t)$,

$$A^{(n)}_t = \sum_{k<n} \gamma^k \delta_{t+k}, \qquad
A^\lambda_t = \delta_t + \gamma_t \lambda (1 - \text{cut}_t) A^\lambda_{t+1}
= (1 - \lambda) \sum_n \lambda^{n-1} A^{(n)}_t.$$

Here lambda is the chance of going on for another step, not of being cut (erratum E4.11). `discount_t` is
gamma (1 - terminated); `cut_t` is terminated or truncated; a truncated step ends the trace and keeps the value of
where it led (erratum E1.5).

Source: notes 4.9 (errata E4.9, E4.10, E4.11); Schulman et al. 2016, Generalized Advantage Estimation.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from .returns import backward, n_step_returns


def gae(
    r_t: Float[Array, "T"],
    discount_t: Float[Array, "T"],
    v_tm1: Float[Array, "T"],
    v_t: Float[Array, "T"],
    lambda_: ScalarLike,
    cut_t: Bool[Array, "T"],
) -> Float[Array, "T"]:
    """Generalized advantage estimates.

    `v_tm1` are the values of where the actions were chosen, `v_t` of where they led, before any reset.
    """
    delta_t = r_t + discount_t * v_t - v_tm1
    return backward(delta_t, discount_t * jnp.where(cut_t, 0.0, jnp.asarray(lambda_, r_t.dtype)))


def gae_weights(lambda_: ScalarLike, length: int) -> Float[Array, "T"]:
    """What `gae` gives the 1-step, 2-step, ... advantages when `length` steps are left.

    w_n = (1 - lambda) lambda^(n-1), and lambda^(length-1) for the last, which stands for all longer ones: the sum is 1.
    """
    chance, steps = jnp.asarray(lambda_, float), jnp.arange(length)
    return chance ** steps.astype(chance.dtype) * jnp.where(steps == length - 1, 1.0, 1.0 - chance)


def n_step_advantages(
    r_t: Float[Array, "T"],
    discount_t: Float[Array, "T"],
    v_tm1: Float[Array, "T"],
    v_t: Float[Array, "T"],
    n: int,
    cut_t: Bool[Array, "T"],
) -> Float[Array, "T"]:
    """The n-step return minus the value of where it began; fewer steps where the trajectory is cut or ends."""
    return n_step_returns(r_t, discount_t, v_t, n, cut_t) - v_tm1


def normalise(advantages: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """Mean 0 and standard deviation 1 over all entries; zeros where all entries are equal."""
    # Measured from the first entry: a constant array is then exactly 0, not rounding noise blown up to size 1.
    centred = advantages - jnp.ravel(advantages)[0]
    centred = centred - jnp.mean(centred)
    variance = jnp.mean(jnp.square(centred))
    return centred / jnp.sqrt(jnp.where(variance > 0.0, variance, 1.0))
