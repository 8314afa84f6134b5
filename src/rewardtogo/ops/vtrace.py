r"""V-trace: values and advantages of a policy from the actions of an older one (notes 4.7, staleness; Espeholt et al. 2018).

With $\rho_t = \min(\bar\rho, \pi / \mu)$ and $c_t = \lambda \min(\bar c, \pi / \mu)$ of the policy $\pi$ that learns and $\mu$ that acted,

$$v_t = V(s_t) + \delta_t + \gamma_t c_t (v_{t+1} - V(s_{t+1})), \qquad \delta_t = \rho_t (r_t + \gamma_t V(s_{t+1}) - V(s_t)),$$

and the policy gradient is weighted by $\rho_t (r_t + \gamma_t v_{t+1} - V(s_t))$. Where $\mu = \pi$ this is the lambda-return. The ratio is
cut from above so that its variance stays bounded; the fixed point is then the value of a policy between $\mu$ and $\pi$.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from .returns import backward


def vtrace(
    r_t: Float[Array, "T"],
    discount_t: Float[Array, "T"],
    v_tm1: Float[Array, "T"],
    v_t: Float[Array, "T"],
    ratio_t: Float[Array, "T"],
    lambda_: ScalarLike,
    cut_t: Bool[Array, "T"],
    limit: ScalarLike = 1.0,
) -> tuple[Float[Array, "T"], Float[Array, "T"]]:
    """Value targets v, and what the advantages are taken of: r_t + discount_t v_{t+1}, V(s_{t+1}) where the trajectory is cut.

    `ratio_t` is pi / mu of the actions, `limit` both bounds on it; values as in `gae`.
    """
    rho = jnp.minimum(ratio_t, limit)
    delta = rho * (r_t + discount_t * v_t - v_tm1)
    trace = jnp.where(cut_t, 0.0, lambda_ * rho).astype(r_t.dtype)
    excess = backward(delta, discount_t * trace)
    after = jnp.where(cut_t.at[-1].set(True), 0.0, jnp.roll(excess, -1))
    return v_tm1 + excess, r_t + discount_t * (v_t + after)
