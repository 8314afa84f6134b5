r"""One-step and n-step targets of Q- and value learning, for one transition.

$$\delta = r + \gamma_t V(s') - V(s), \qquad y = r + \gamma_t \max_{a'} Q(s', a'), \qquad
y^\text{double} = r + \gamma_t Q_\text{target}(s', \arg\max_{a'} Q_\text{online}(s', a')).$$

`discount` is gamma (1 - terminated) (erratum E1.5). Nothing here stops a gradient: whoever takes one of a loss does.

Source: notes 4.6 (TD error), 5.4 (fitted Q), 6.3 (double Q, n steps); van Hasselt et al. 2016; Huber 1964.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, ScalarLike


def td_error(
    v_tm1: Float[Array, "*S"], r_t: Float[Array, "*S"], discount_t: Float[Array, "*S"], v_t: Float[Array, "*S"]
) -> Float[Array, "*S"]:
    """How much better a step turned out than the value of where it began said."""
    return r_t + discount_t * v_t - v_tm1


def q_target(r: Float[Array, ""], discount: Float[Array, ""], q_next: Float[Array, "A"]) -> Float[Array, ""]:
    """The reward and the discounted value of the best next action."""
    return r + discount * jnp.max(q_next)


def double_q_target(
    r: Float[Array, ""], discount: Float[Array, ""], q_next_target: Float[Array, "A"], q_next_online: Float[Array, "A"]
) -> Float[Array, ""]:
    """As `q_target`, but the online network chooses the next action and the target network values it."""
    return r + discount * q_next_target[jnp.argmax(q_next_online)]


def n_step_transition(
    r_t: Float[Array, "n"], discount_t: Float[Array, "n"], cut_t: Bool[Array, "n"]
) -> tuple[Float[Array, ""], Float[Array, ""], Int32[Array, ""]]:
    """Several steps as one: their discounted return, the product of their discounts, the index of the last one used.

    Steps after the first cut (terminated or truncated) belong to another episode and are left out. The target of the
    whole is `return + product * value(next_observation[last])`; the product is 0 after a terminal state.
    """
    last = jnp.where(jnp.any(cut_t), jnp.argmax(cut_t), r_t.shape[0] - 1).astype(jnp.int32)
    used_t = jnp.arange(r_t.shape[0], dtype=jnp.int32) <= last
    through_t = jnp.cumprod(jnp.where(used_t, discount_t, 1.0))
    before_t = jnp.concatenate([jnp.ones_like(through_t[:1]), through_t[:-1]])
    return jnp.sum(jnp.where(used_t, before_t * r_t, 0.0)), through_t[-1], last


def huber(x: Float[Array, "*S"], delta: ScalarLike = 1.0) -> Float[Array, "*S"]:
    """x^2 / 2 up to |x| = delta, then straight on with slope delta."""
    size = jnp.abs(x)
    inside = jnp.minimum(size, jnp.asarray(delta, x.dtype))
    return inside * (size - 0.5 * inside)
