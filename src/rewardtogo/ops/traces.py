r"""Eligibility traces: TD(lambda) for any differentiable value function, from one step at a time.

With $\delta_t = r_t + \gamma_t V_w(s_{t+1}) - V_w(s_t)$,

$$e_t = \gamma_{t-1} \lambda (1 - \text{cut}_{t-1})\, e_{t-1} + \nabla_w V_w(s_t), \qquad w \leftarrow w + \alpha\, \delta_t\, e_t.$$

Held at one w, the sum of these changes is that of the *forward view*, which has to wait for the lambda-return (`returns.lambda_returns`):

$$\sum_t \delta_t e_t = \sum_t (G^\lambda_t - V_w(s_t))\, \nabla_w V_w(s_t).$$

Lambda 0 is TD, lambda 1 Monte Carlo. With w changing at every step, `td_lambda`, the two agree to first order in alpha.

`discount` is gamma (1 - terminated); `cut`, terminated or truncated, empties the trace, and a truncated step keeps the value of
where it led (erratum E1.5). Both sums need steps that follow each other: inside an episode `next_observation[t]` is
`observation[t + 1]`.

Source: title of chapter 4 of the notes, which gives no equation for them (erratum E4.12); Sutton and Barto 2018, section 12.2.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree, ScalarLike

from .returns import lambda_returns

Parameters = TypeVar("Parameters")
"""A tree of arrays."""
Value = Callable[[Parameters, PyTree[Array]], Float[Array, ""]]
"""V: parameters and one observation to a number."""


class Experience(eqx.Module):
    """Steps of one environment in a row, `[T]`, or one of them, without the axis.

    - `r`, `discount`: reward, and gamma (1 - terminated);
    - `next_observation`: where the step led, before any reset;
    - `cut`: terminated or truncated.
    """

    observation: PyTree[Array]
    r: Float[Array, "*T"]
    discount: Float[Array, "*T"]
    next_observation: PyTree[Array]
    cut: Bool[Array, "*T"]


def no_trace(parameters: Parameters) -> Parameters:
    """The trace before the first step of an episode: zeros in the shape of the parameters."""
    return jax.tree.map(jnp.zeros_like, parameters)


def traced_change(
    value: Value[Parameters], parameters: Parameters, trace: Parameters, step: Experience, lambda_: ScalarLike
) -> tuple[Parameters, Parameters]:
    """What one step adds, delta e, and the trace that the next step begins with, gamma lambda e: 0 after a cut."""
    v, slope = jax.value_and_grad(value)(parameters, step.observation)
    delta = step.r + step.discount * value(parameters, step.next_observation) - v
    trace = jax.tree.map(jnp.add, trace, slope)
    left = step.discount * jnp.where(step.cut, 0.0, jnp.asarray(lambda_, step.r.dtype))
    return _scaled(delta, trace), _scaled(left, trace)


def backward_view(
    value: Value[Parameters], parameters: Parameters, experience: Experience, lambda_: ScalarLike
) -> Parameters:
    """The sum of delta_t e_t over steps `[T]`, all at the same parameters: add alpha times it to them."""

    def body(loop: tuple[Parameters, Parameters], step: Experience) -> tuple[tuple[Parameters, Parameters], None]:
        total, trace = loop
        change, trace = traced_change(value, parameters, trace, step, lambda_)
        return (jax.tree.map(jnp.add, total, change), trace), None

    start = (no_trace(parameters), no_trace(parameters))
    return jax.lax.scan(body, start, experience)[0][0]


def forward_view(
    value: Value[Parameters], parameters: Parameters, experience: Experience, lambda_: ScalarLike
) -> Parameters:
    """The same sum from lambda-returns: (G_t - V(s_t)) grad V(s_t), over steps `[T]`."""
    e = experience
    v_t = jax.vmap(lambda o: value(parameters, o))(e.next_observation)
    v_tm1, pull = jax.vjp(lambda w: jax.vmap(lambda o: value(w, o))(e.observation), parameters)
    return pull(lambda_returns(e.r, e.discount, v_t, lambda_, e.cut) - v_tm1)[0]


def td_lambda(
    value: Value[Parameters],
    parameters: Parameters,
    trace: Parameters,
    experience: Experience,
    lambda_: ScalarLike,
    rate: ScalarLike,
) -> tuple[Parameters, Parameters]:
    """Learn from steps `[T]` as they come, w <- w + rate delta e after each: the parameters and the trace after the last.

    Begin with `no_trace`, and give the trace back to go on where one call ended.
    """

    def body(loop: tuple[Parameters, Parameters], step: Experience) -> tuple[tuple[Parameters, Parameters], None]:
        parameters, trace = loop
        change, trace = traced_change(value, parameters, trace, step, lambda_)
        return (jax.tree.map(jnp.add, parameters, _scaled(rate, change)), trace), None

    return jax.lax.scan(body, (parameters, trace), experience)[0]


def _scaled(factor: ScalarLike, tree: Parameters) -> Parameters:
    return jax.tree.map(lambda x: jnp.asarray(factor, x.dtype) * x, tree)
