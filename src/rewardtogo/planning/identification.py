r"""System identification: the unknown numbers of a known model, from transitions (notes, section 8; item 8.2).

$$\min_\theta \sum_i \big\lVert W \, (x'_i - f_\theta(x_i, u_i)) \big\rVert^2$$

by Gauss and Newton's method, damped as by Levenberg and Marquardt; W weighs the entries of the state by the inverse of their spread. The
residuals' covariance gives standard errors of the parameters.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..core import Solution
from ..ops.linalg import definite_solve
from .problem import CONVERGED, MAX_ITERS


def identify(
    dynamics: Callable[..., Array],
    guess: Any,
    states: Float[Array, "N X"],
    actions: Float[Array, "N U"],
    following: Float[Array, "N X"],
    *,
    iterations: int = 100,
    tolerance: float = 1e-6,
) -> Solution:
    """The parameters of `dynamics(parameters, x, u) -> x'` that explain the transitions best.

    - `guess`: parameters to begin with, a number or any tree of them; what comes back has the same structure.

    `stats`: `iterations`, `reason`, `loss` (mean squared weighted residual), `standard_errors` (in the structure of the guess). Raises
    `ValueError`
    where there are fewer numbers in the data than parameters, where shapes do not fit, and where the data do not tell the parameters apart.
    """
    flat, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, float), guess))
    shape = jnp.shape(states)
    if jnp.shape(following) != shape or len(actions) != len(states):
        raise ValueError(
            f"states {shape}, actions {jnp.shape(actions)} and next states {jnp.shape(following)} must be of the same transitions"
        )
    if np.size(following) < flat.size:
        raise ValueError(f"{np.size(following)} numbers cannot tell {flat.size} parameters: give more transitions")
    predict = lambda theta, x, u: dynamics(unravel(theta), x, u)  # noqa: E731
    found = _levenberg_marquardt(
        predict,
        flat,
        jnp.asarray(states),
        jnp.asarray(actions),
        jnp.asarray(following),
        iterations,
        jnp.asarray(tolerance),
    )
    theta, covariance, loss, count, settled = found
    if not np.all(np.isfinite(covariance)):
        raise ValueError("these transitions do not tell the parameters apart: give some in which each of them matters")
    errors = unravel(jnp.sqrt(jnp.diagonal(covariance)))
    reason = jnp.where(settled, CONVERGED, MAX_ITERS)
    stats = {"iterations": count, "reason": reason, "loss": loss, "standard_errors": errors}
    return Solution(unravel(theta), settled, stats)


@partial(jax.jit, static_argnums=(0, 5))
def _levenberg_marquardt(
    predict: Callable[..., Array],
    theta: Array,
    states: Array,
    actions: Array,
    following: Array,
    iterations: int,
    tolerance: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Parameters, their covariance, the loss, iterations, whether they settled."""
    spread = jnp.std(following - states, axis=0)
    weights = 1.0 / jnp.where(spread > 0, spread, 1.0)

    def residuals(theta: Array) -> Array:
        predicted = jax.vmap(lambda x, u: predict(theta, x, u))(states, actions)
        return ((following - predicted) * weights[None, :]).ravel()

    def step(loop: tuple[Array, ...]) -> tuple[Array, ...]:
        theta, square, damping, count, _ = loop
        r, J = residuals(theta), jax.jacfwd(residuals)(theta)
        normal = J.T @ J
        # Marquardt's scaling: parameters have units of their own.
        move, _ = definite_solve(normal + damping * jnp.diag(jnp.diagonal(normal) + 1e-12), -(J.T @ r)[:, None])
        tried = theta + move[:, 0]
        after = (residuals(tried) ** 2).sum()
        better = after < square
        small = jnp.max(jnp.abs(move[:, 0]) / (jnp.abs(theta) + 1e-6)) <= tolerance
        damping = jnp.where(better, damping / 10.0, damping * 10.0)
        return (
            jnp.where(better, tried, theta), jnp.where(better, after, square), damping, count + 1, small | (damping > 1e8)
        )  # fmt: skip

    start = (theta, (residuals(theta) ** 2).sum(), jnp.asarray(1e-3), jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    going = lambda loop: (loop[3] < iterations) & ~loop[4]  # noqa: E731
    theta, square, _, count, settled = jax.lax.while_loop(going, step, start)
    J = jax.jacfwd(residuals)(theta)
    freedom = jnp.maximum(len(J) - len(theta), 1)
    scale = jnp.sqrt(jnp.diagonal(J.T @ J))
    normal = (J.T @ J) / (scale[:, None] * scale[None, :])
    inverse, pivot = definite_solve(normal, jnp.eye(len(theta)))
    bad = ~(pivot > 1e3 * jnp.finfo(theta.dtype).eps)
    covariance = jnp.where(bad, jnp.nan, inverse / (scale[:, None] * scale[None, :]) * square / freedom)
    return theta, covariance, square / len(J), count, settled
