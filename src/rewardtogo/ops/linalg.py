r"""Linear systems without their matrix: conjugate gradients (Hestenes and Stiefel 1952).

For a symmetric positive definite $A$, known only through the product $v \mapsto A v$,

$$\alpha = \frac{r^\top r}{p^\top A p}, \quad x \leftarrow x + \alpha p, \quad r \leftarrow r - \alpha A p, \quad
p \leftarrow r + \frac{r_{\text{new}}^\top r_{\text{new}}}{r^\top r} p$$

starts at $x = 0$, $r = p = b$ and ends, up to rounding, at the solution of $A x = b$ after as many iterations as $A$ has
different eigenvalues; before that, $x$ is the point of its Krylov space that is nearest in the norm of $A$.

Source: notes 7.2.4 (the "nice techniques" for F^-1 g); Schulman et al. 2015, appendix C.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

Vector = TypeVar("Vector")
"""An array, or a tree of arrays that stands for one long vector."""


def conjugate_gradients(
    multiply: Callable[[Vector], Vector], b: Vector, iterations: int, tolerance: ScalarLike = 1e-6
) -> tuple[Vector, Vector]:
    """About the x with A x = b, and the residual b - A x, in at most `iterations` products with A.

    - `multiply`: v -> A v, linear, symmetric and positive definite.
    - `tolerance`: stops once |b - A x| is at most this much of |b|. It also stops at the first direction that A has no positive
      curvature in, as a singular or indefinite matrix can have.

    Raises `ValueError` for less than one iteration.
    """
    if iterations < 1:
        raise ValueError(f"conjugate gradients cannot take {iterations} iterations: ask for at least 1")
    start = inner(b, b)
    enough = jnp.square(jnp.asarray(tolerance, start.dtype)) * start

    def unfinished(loop: tuple[Array, Vector, Vector, Vector, Array]) -> Array:
        count, _, _, _, square = loop
        return (count < iterations) & (square > enough)

    def iterate(
        loop: tuple[Array, Vector, Vector, Vector, Array],
    ) -> tuple[Array, Vector, Vector, Vector, Array]:
        count, x, r, p, square = loop
        product = multiply(p)
        curvature = inner(p, product)
        positive = curvature > 0
        alpha = jnp.where(positive, square / jnp.where(positive, curvature, 1.0), 0.0)
        x, r = _add(x, alpha, p), _add(r, -alpha, product)
        after = jnp.where(positive, inner(r, r), 0.0)
        return count + 1, x, r, _add(r, after / square, p), after

    zero = jax.tree.map(jnp.zeros_like, b)
    _, x, residual, _, _ = jax.lax.while_loop(unfinished, iterate, (jnp.zeros((), jnp.int32), zero, b, b, start))
    return x, residual


def inner(x: Vector, y: Vector) -> Float[Array, ""]:
    """Inner product of two vectors, arrays or trees of them."""
    products = jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(a * b), x, y))
    return jnp.sum(jnp.stack(products))


def _add(x: Vector, scale: Array, y: Vector) -> Vector:
    return jax.tree.map(lambda a, b: a + scale * b, x, y)


SMALL = 32
"""Sizes up to which a product is faster as a sum of products, where many are taken side by side."""


def small_product(a: Float[Array, "N K"], b: Float[Array, "K M"]) -> Float[Array, "N M"]:
    """A B. Of small matrices as products and their sum: mapped over many, that is one loop over all of them, where a matrix product is a
    call for each (2 to 3 times as long for a thousand of 12x16 on a CPU).
    """
    if max(*a.shape, *b.shape) > SMALL:
        return a @ b
    return (a[:, :, None] * b[None, :, :]).sum(1)


def definite_solve(a: Float[Array, "N N"], b: Float[Array, "N M"]) -> tuple[Float[Array, "N M"], Float[Array, ""]]:
    """The X with A X = B for a symmetric A, and the least pivot of the elimination: positive if and only if A is positive definite.

    Where it is not, X means nothing. Gauss and Jordan's elimination, which for a definite matrix needs no exchange of rows. Written out
    because LAPACK's factorisations of many small matrices, one call each, take several times as long.
    """
    size = len(a)

    def eliminate(i: Array | int, loop: tuple[Array, Array]) -> tuple[Array, Array]:
        table, least = loop
        column = table[:, i]
        pivot = column[i]
        row = table[i] / jnp.where(pivot == 0, 1.0, pivot)
        table = (table - column[:, None] * row[None, :]).at[i].set(row)
        return table, jnp.minimum(least, pivot)

    loop = (jnp.concatenate([a, b], 1), jnp.asarray(jnp.inf, a.dtype))
    if size <= 6:
        for i in range(size):
            loop = eliminate(i, loop)
    else:
        loop = jax.lax.fori_loop(0, size, eliminate, loop)
    return loop[0][:, size:], loop[1]
