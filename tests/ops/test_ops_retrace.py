import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.ops import lambda_returns, retrace, trace_coefficients

R, D = np.array([1.0, 2.0, -1.0]), np.array([0.5, 0.5, 0.0])
Q, V = np.array([3.0, 1.0, 4.0]), np.array([2.0, 6.0, 9.0])
NONE = np.zeros(3, bool)


def f32(*arrays):
    return tuple(jnp.asarray(a, jnp.float32 if a.dtype != bool else bool) for a in arrays)


def test_by_hand(item):
    """Errors are -1, 4 and -5; y_2 = -1, y_1 = 1 + 4 + .5 (.6) (-5) = 3.5, y_0 = 3 - 1 + .5 (.8) (4 + .3 (-5)) = 3."""
    trace = np.array([9.0, 0.8, 0.6])
    found = retrace(*f32(R, D, Q, V, trace, NONE))
    with item("6.19") as check:
        check(np.abs(np.asarray(found) - [3.0, 3.5, -1.0]).max(), "<=", 1e-6, "three steps by hand")
    cut = np.array([True, False, False])
    np.testing.assert_allclose(retrace(*f32(R, D, Q, V, trace, cut))[0], 2.0, rtol=1e-6)  # r + .5 V, whatever follows


def test_coefficients(item):
    pi, mu = f32(np.array([0.5, 0.2, 0.0]), np.array([0.25, 0.4, 0.5]))
    found = [trace_coefficients(kind, 0.5, pi, mu) for kind in ("retrace", "tree_backup", "importance")]
    expected = [[0.5, 0.25, 0.0], [0.25, 0.1, 0.0], [1.0, 0.25, 0.0]]
    with item("6.19") as check:
        check(np.abs(np.asarray(found) - expected).max(), "<=", 1e-6, "min(1, pi / mu), pi and pi / mu")


@pytest.mark.parametrize("decay", [0.0, 0.7, 1.0])
def test_on_policy_it_is_the_lambda_return(decay):
    """With c = lambda and Q(s, a) = V(s), both are the same sum."""
    rng = np.random.default_rng(0)
    r, v = rng.normal(size=6), rng.normal(size=7)
    cut = np.array([False, False, True, False, False, False])
    v_t = np.where(cut, 0.3, v[1:])
    r, q, v_t, cut = f32(r, v[:-1], v_t, cut)
    discount = jnp.full(6, 0.9)
    found = retrace(r, discount, q, v_t, jnp.full(6, decay), cut)
    np.testing.assert_allclose(found, lambda_returns(r, discount, v_t, decay, cut), rtol=1e-5, atol=1e-6)
