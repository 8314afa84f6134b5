import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo import ops


def scalars(*values):
    return tuple(jnp.asarray(value) for value in values)


def test_targets_by_hand():
    r, discount = scalars(1.0, 0.5)
    target, online = jnp.array([2.0, 6.0, 4.0]), jnp.array([0.0, 1.0, 3.0])
    assert float(ops.td_error(*scalars(3.0, 1.0, 0.5, 8.0))) == 2.0
    assert float(ops.q_target(r, discount, target)) == 4.0
    assert float(ops.double_q_target(r, discount, target, online)) == 3.0
    assert float(ops.q_target(r, jnp.asarray(0.0), target)) == 1.0


def test_double_q_of_two_equal_networks_is_q():
    q = jax.random.normal(jax.random.key(0), (50, 4))
    r, discount = jnp.ones(50), jnp.full(50, 0.9)
    single = jax.vmap(ops.q_target)(r, discount, q)
    assert np.array_equal(jax.vmap(ops.double_q_target)(r, discount, q, q), single)


def test_n_step_transition_by_hand():
    r, discount = jnp.array([1.0, 2.0, 4.0]), jnp.full(3, 0.5)
    for cut, discount_t, expected in (
        ([False, False, False], discount, (3.0, 0.125, 2)),
        ([False, True, False], discount, (2.0, 0.25, 1)),  # truncated: the value of its next observation counts
        ([False, True, False], jnp.array([0.5, 0.0, 0.5]), (2.0, 0.0, 1)),  # terminated
        ([True, True, True], discount, (1.0, 0.5, 0)),
    ):
        total, product, last = ops.n_step_transition(r, discount_t, jnp.array(cut))
        assert (float(total), float(product), int(last)) == expected
        assert last.dtype == jnp.int32


@pytest.mark.parametrize("n", [1, 2, 6])
def test_n_step_transition_is_the_n_step_return(n, x64):
    rng = np.random.default_rng(n)
    for _ in range(20):
        terminated, truncated = rng.random(n) < 0.2, rng.random(n) < 0.2
        r, v = jnp.asarray(rng.normal(size=n)), jnp.asarray(rng.normal(size=n))
        discount, cut = jnp.asarray(0.9 * (1.0 - terminated)), jnp.asarray(terminated | truncated)
        total, product, last = ops.n_step_transition(r, discount, cut)
        whole = ops.n_step_returns(r, discount, v, n, cut)[0]
        assert abs(float(total + product * v[last] - whole)) <= 1e-12


def test_huber_is_quadratic_inside_and_linear_outside():
    x = jnp.array([-3.0, -2.0, -1.0, 0.0, 0.5, 2.0, 5.0])
    assert np.allclose(ops.huber(x, 2.0), [4.0, 2.0, 0.5, 0.0, 0.125, 2.0, 8.0])
    slope = jax.vmap(jax.grad(lambda x: ops.huber(x, 2.0)))(x)
    assert np.allclose(slope, np.clip(x, -2.0, 2.0))
    assert np.array_equal(ops.huber(x), ops.huber(x, 1.0))
    assert np.isfinite(ops.huber(jnp.asarray(1e30)))
