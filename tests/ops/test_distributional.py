import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.ops import categorical_projection, compress, expand, huber, quantile_huber, quantile_levels

Z = jnp.linspace(0.0, 4.0, 5)


def test_projection_by_hand(item):
    """.5 at 1.25 is .375 at 1 and .125 at 2; .3 at -1 goes to 0; .2 at 9 goes to 4."""
    found = categorical_projection(jnp.asarray([1.25, -1.0, 9.0]), jnp.asarray([0.5, 0.3, 0.2]), Z)
    with item("6.28") as check:
        error = np.abs(np.asarray(found) - [0.3, 0.375, 0.125, 0.0, 0.2]).max()
        check(error, "<=", 1e-6, "C51's projection, by hand")


def test_projection_keeps_mass_and_mean():
    """Inside the support; onto itself it changes nothing."""
    rng = np.random.default_rng(0)
    p = jnp.asarray(rng.dirichlet(np.ones(5)), jnp.float32)
    moved = 0.3 + 0.5 * Z
    found = categorical_projection(moved, p, Z)
    np.testing.assert_allclose(found.sum(), 1.0, rtol=1e-6)
    np.testing.assert_allclose(found @ Z, p @ moved, rtol=1e-6)
    np.testing.assert_allclose(categorical_projection(Z, p, Z), p, rtol=1e-6)


def test_a_terminal_step_projects_onto_its_reward():
    found = categorical_projection(2.0 + 0.0 * Z, jnp.full(5, 0.2), Z)
    np.testing.assert_allclose(found, [0, 0, 1, 0, 0], atol=1e-6)


def test_quantile_loss_by_hand():
    """Levels 1/4 and 3/4, one sample 1: errors 1 and -1, of weights 1/4 and 1/4, each Huber 1/2."""
    found = quantile_huber(jnp.asarray([0.0, 2.0]), jnp.asarray([1.0]))
    np.testing.assert_allclose(found, 0.25, rtol=1e-6)
    # Above all samples the upper quantile pays little, the lower one much.
    np.testing.assert_allclose(
        quantile_huber(jnp.asarray([3.0, 3.0]), jnp.asarray([1.0])), 1.5 * (0.75 + 0.25), rtol=1e-6
    )


def test_minimum_of_the_quantile_loss_is_at_the_quantiles():
    """With a small kappa; samples 0 to 99 have the quantiles 1/6, 1/2 and 5/6 of their range."""
    samples = jnp.arange(100.0)
    gradient = jax.grad(lambda q: quantile_huber(q, samples, 1e-3))
    step = lambda q, i: (q - 40.0 / (1.0 + 0.05 * i) * gradient(q), None)  # noqa: E731
    found, _ = jax.jit(lambda q: jax.lax.scan(step, q, jnp.arange(2000.0)))(jnp.zeros(3))
    np.testing.assert_allclose(found, 100 * quantile_levels(3) - 0.5, atol=1.0)


def test_huber_gradient_is_clipped(item):
    errors = jnp.asarray([-3.0, -1.0, -0.25, 0.0, 0.5, 1.0, 7.0])
    gradient = jax.vmap(jax.grad(lambda x: huber(x, 1.0)))(errors)
    with item("6.29") as check:
        check(
            np.abs(gradient - jnp.clip(errors, -1.0, 1.0)).max(),
            "==",
            0.0,
            "gradient of Huber's loss: the error, clipped",
        )


@pytest.mark.usefixtures("x64")
def test_rescaling_and_its_inverse():
    x = jnp.asarray([-1e4, -3.0, -1e-6, 0.0, 1e-9, 8.0, 1e6])
    np.testing.assert_allclose(compress(jnp.asarray([3.0, -8.0])), [1.003, -2.008], rtol=1e-12)
    np.testing.assert_allclose(expand(compress(x)), x, rtol=1e-12)
