r"""Corrected returns of several steps for Q-learning from other policies' actions (notes 6.3.2; Munos et al. 2016).

Of a policy $\pi$ that is to be valued and the policy $\mu$ that acted, with $\delta_t = r_t + \gamma_t \sum_a \pi(a|s_{t+1}) Q(s_{t+1},
a) - Q(s_t, a_t)$,

$$y_t = Q(s_t, a_t) + \sum_{k \ge t} \Big(\prod_{i=t+1}^{k} \gamma_{i-1} c_i\Big)\, \delta_k,$$

| trace | $c_t$ | |
|---|---|---|
| importance | $\lambda\, \pi / \mu$ | right, of unbounded variance |
| tree backup | $\lambda\, \pi$ | right, needs no $\mu$; cuts even where $\pi = \mu$ |
| Retrace | $\lambda \min(1, \pi / \mu)$ | right, bounded, and long where the policies agree |

Each has $Q^\pi$ as its fixed point and contracts by at most $\gamma$ where $c_t \le \pi / \mu$. The first action may be anything; those
after it must be the target policy's, or be corrected (erratum E6.5): plain n-step returns are not.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from .returns import backward

Trace = Literal["importance", "tree_backup", "retrace"]
TRACES = ("retrace", "tree_backup", "importance")
"""Names of the coefficients that `trace_coefficients` knows."""


def retrace(
    r_t: Float[Array, "T"],
    discount_t: Float[Array, "T"],
    q_tm1: Float[Array, "T"],
    v_t: Float[Array, "T"],
    trace_t: Float[Array, "T"],
    cut_t: Bool[Array, "T"],
) -> Float[Array, "T"]:
    """The targets y of Q(s_t, a_t).

    - `discount_t`: gamma (1 - terminated).
    - `q_tm1`: Q of each step's observation and action; `v_t`: the expectation of Q under pi where the step led to.
    - `trace_t`: c of each step's own action. The first one has no part in anything: the action taken there is a given.
    - `cut_t`: terminated or truncated; what follows belongs to another episode.
    """
    delta = r_t + discount_t * v_t - q_tm1
    following = jnp.where(cut_t.at[-1].set(True), 0.0, jnp.roll(trace_t, -1)).astype(r_t.dtype)
    return q_tm1 + backward(delta, discount_t * following)


def trace_coefficients(
    kind: Trace, lambda_: ScalarLike, pi_t: Float[Array, "*S"], mu_t: Float[Array, "*S"]
) -> Float[Array, "*S"]:
    """The c of actions that pi takes with probability `pi_t` and mu took with `mu_t`."""
    if kind == "tree_backup":
        return pi_t * lambda_
    ratio = pi_t / mu_t
    return (jnp.minimum(ratio, 1.0) if kind == "retrace" else ratio) * lambda_
