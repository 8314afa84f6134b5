"""Conjugate gradients against direct solves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.ops.linalg import conjugate_gradients, inner


def positive_definite(seed: int, eigenvalues: np.ndarray) -> jax.Array:
    basis = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(eigenvalues),) * 2))[0]
    return jnp.asarray(basis @ np.diag(eigenvalues) @ basis.T)


def test_the_solution_and_its_residual(item, x64):
    rng = np.random.default_rng(0)
    matrices = jnp.stack([positive_definite(i, rng.uniform(0.1, 10.0, 12)) for i in range(20)])
    b = jnp.asarray(rng.normal(size=(20, 12)))
    x, residual = jax.jit(jax.vmap(lambda a, b: conjugate_gradients(lambda v: a @ v, b, 40, 1e-13)))(matrices, b)
    true = b - jnp.einsum("nij,nj->ni", matrices, x)
    direct = jnp.linalg.solve(matrices, b[..., None])[..., 0]
    norm = jnp.linalg.norm(b, axis=1)
    with item("7.25") as check:
        check(float(jnp.max(jnp.linalg.norm(true, axis=1) / norm)), "<=", 1e-6, "relative residual, 20 systems of 12")
        check(float(jnp.max(jnp.abs(x - direct))), "<=", 1e-10, "distance from the direct solution")
    assert float(jnp.max(jnp.abs(residual - true))) <= 1e-12
    # What a step size needs, without another product.
    curvature = jnp.einsum("ni,nij,nj->n", x, matrices, x)
    np.testing.assert_allclose(jax.vmap(inner)(x, b - residual), curvature, rtol=1e-12)


def test_as_many_iterations_as_there_are_eigenvalues(x64):
    matrix = positive_definite(1, np.repeat([0.5, 2.0, 7.0], 4))
    b = jnp.asarray(np.random.default_rng(2).normal(size=12))
    gap = lambda count: float(  # noqa: E731
        jnp.linalg.norm(b - matrix @ conjugate_gradients(lambda v: matrix @ v, b, count, 0.0)[0])
    )
    assert gap(2) > 1e-2
    assert gap(3) <= 1e-13


def test_a_tree_is_one_long_vector():
    matrix = jnp.asarray(positive_definite(3, np.linspace(0.5, 3.0, 5)), jnp.float32)
    b = jnp.arange(1.0, 6.0)
    split = lambda v: {"a": v[:2], "b": v[2:].reshape(3, 1)}  # noqa: E731
    join = lambda tree: jnp.concatenate([tree["a"], tree["b"].ravel()])  # noqa: E731
    flat, _ = conjugate_gradients(lambda v: matrix @ v, b, 4)
    tree, residual = conjugate_gradients(lambda t: split(matrix @ join(t)), split(b), 4)
    np.testing.assert_allclose(join(tree), flat, rtol=1e-5)
    assert tree["b"].shape == residual["b"].shape == (3, 1)


def test_it_stops_where_it_should():
    products = []

    def multiply(v: jax.Array) -> jax.Array:
        jax.debug.callback(lambda _: products.append(1), v)
        return 2.0 * v

    x, _ = jax.block_until_ready(conjugate_gradients(multiply, jnp.ones(3), 50))
    jax.effects_barrier()
    assert len(products) == 1
    np.testing.assert_array_equal(x, 0.5 * np.ones(3))


@pytest.mark.parametrize("matrix", [np.zeros((2, 2)), np.diag([1.0, 0.0]), np.diag([1.0, -3.0])])
def test_a_matrix_without_an_inverse_gives_no_nan(matrix):
    x, residual = conjugate_gradients(lambda v: jnp.asarray(matrix, jnp.float32) @ v, jnp.ones(2), 100, 0.0)
    assert bool(jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(residual)))


def test_nothing_asked_nothing_given():
    x, residual = conjugate_gradients(lambda v: 3.0 * v, jnp.zeros(3), 5)
    assert not x.any()
    assert not residual.any()
    with pytest.raises(ValueError, match="at least 1"):
        conjugate_gradients(lambda v: v, jnp.ones(3), 0)
