r"""The Fisher information of a policy, without its matrix, and the natural gradient step (notes 3.9.1 and 7.2.4).

With $\bar D(\theta', \theta)$ the KL divergence of two policies, averaged over states,

$$F = \mathbb{E}_{s,\, a \sim \pi_\theta}[\nabla \log \pi_\theta(a|s) \nabla \log \pi_\theta(a|s)^\top]
= \nabla^2_{\theta'} \bar D \big|_{\theta' = \theta}, \qquad
\bar D(\theta + d, \theta) = \tfrac12 d^\top F d + O(\|d\|^3) = \bar D(\theta, \theta + d) + O(\|d\|^3).$$

The best step of a linear objective with $\tfrac12 d^\top F d \le \epsilon$ is $d = \sqrt{2 \epsilon / (x^\top F x)}\, x$ with
$F x = g$, and there $x^\top F x = g^\top F^{-1} g$. The notes print $g^\top F g$ in its place (erratum E7.9), lack the factor 1/2 of
the KL in 3.9.1 (E3.12), and write the KL there with the wrong sign (E3.11).

$F v$ is computed as $J^\top (M (J v))$, averaged over states, with $J$ the Jacobian of the numbers that a distribution is made of
and $M$ the Hessian of its own KL, both linearised once for all products. This is the Hessian of the mean KL exactly, since the
gradient of a KL at equality is 0. $F$ is singular (softmax does not change when all logits shift, E7.10), so that
$F + \xi I$ takes its place.

Source: Kakade 2001; Schulman et al. 2015, appendix C.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree, ScalarLike

from ..ops.distributions import Distribution
from ..ops.linalg import conjugate_gradients, inner

Parameters = TypeVar("Parameters")
Laws = Callable[[Parameters], Distribution]
"""Parameters -> the distributions of the action in N states, one class with a leading axis `[N]`."""


def mean_kl(p: Distribution, q: Distribution) -> Float[Array, ""]:
    """KL(p || q), exact in each state, averaged over the N states."""
    return jax.vmap(lambda p, q: p.kl(q))(p, q).mean()


def fisher_vector_product(
    laws: Laws, parameters: Parameters, damping: ScalarLike = 0.0
) -> Callable[[Parameters], Parameters]:
    """The map v -> (F + damping I) v. What does not depend on v is computed here, once."""
    here, push = jax.linearize(laws, parameters)
    pull = jax.linear_transpose(push, parameters)
    _, curve = jax.linearize(jax.grad(lambda law: mean_kl(here, law)), here)

    def multiply(vector: Parameters) -> Parameters:
        (product,) = pull(curve(push(vector)))
        return jax.tree.map(lambda f, v: f + damping * v, product, vector)

    return multiply


def fisher_matrix(laws: Laws, parameters: PyTree[Array], damping: ScalarLike = 0.0) -> Float[Array, "P P"]:
    """F + damping I as a matrix, parameters in the order of `ravel_pytree`. For policies of few parameters."""
    flat, unravel = ravel_pytree(parameters)
    multiply = fisher_vector_product(lambda x: laws(unravel(x)), flat, damping)
    return jax.vmap(multiply)(jnp.eye(flat.size, dtype=flat.dtype))


def score_fisher(
    log_probs: Callable[[Parameters], Float[Array, "N"]], parameters: Parameters, weights: Float[Array, "N"]
) -> Float[Array, "P P"]:
    """The sum of w score score' over N pairs of state and action, by definition.

    With the probability d(s) pi(a|s) of every pair as its weight this is F; with 1/N for pairs that were sampled, an estimate of it.
    `log_probs` gives log pi(a|s) of all pairs.
    """
    flat, unravel = ravel_pytree(parameters)
    # Forwards: the other way would take a vector of N for each of the N pairs.
    scores = jax.jacfwd(lambda x: log_probs(unravel(x)))(flat)
    return scores.T @ (weights[:, None] * scores)


class NaturalGradient(eqx.Module):
    """Where a natural step begins and leads. `curvature` is x'(F + damping I)x of the direction x; `objective` is before the step."""

    objective: Float[Array, ""]
    gradient: Float[Array, "P"]
    direction: Float[Array, "P"]
    curvature: Float[Array, ""]


def natural_gradient(
    objective: Callable[[Float[Array, "P"]], Float[Array, ""]],
    laws: Laws,
    parameters: Float[Array, "P"],
    damping: ScalarLike,
    iterations: int,
) -> NaturalGradient:
    """The direction x = (F + damping I)^-1 g by conjugate gradients, g the gradient of the objective.

    `laws` may be those of a part of the states only.
    """
    value, gradient = jax.value_and_grad(objective)(parameters)
    multiply = fisher_vector_product(laws, parameters, damping)
    direction, residual = conjugate_gradients(multiply, gradient, iterations)
    # A x is g less the residual: no further product is needed.
    return NaturalGradient(value, gradient, direction, inner(direction, gradient - residual))


def step_size(curvature: Float[Array, ""], kl: ScalarLike) -> Float[Array, ""]:
    """sqrt(2 kl / x'Fx): how far along x the KL is `kl`, to second order. 0 where there is no way to go (erratum E7.9)."""
    uphill = curvature > 0
    return jnp.where(uphill, jnp.sqrt(2.0 * kl / jnp.where(uphill, curvature, 1.0)), 0.0)
