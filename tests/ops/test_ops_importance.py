import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo import ops

P, Q, F = np.array([0.5, 0.3, 0.2]), np.array([0.2, 0.2, 0.6]), np.array([1.0, -2.0, 3.0])


def test_importance_sampling(item, x64):
    log_p, log_q, f = jnp.log(jnp.asarray(P)), jnp.log(jnp.asarray(Q)), jnp.asarray(F)
    log_w = ops.log_ratio(log_p, log_q)
    # The mean over all 27 samples of three values, by their probabilities.
    samples = np.array(list(itertools.product(range(3), repeat=3)))
    chance = np.prod(Q[samples], axis=1)
    plain = jax.vmap(ops.importance_mean)(f[samples], log_w[samples])
    normalised = jax.vmap(ops.self_normalised_mean)(f[samples], log_w[samples])
    with item("3.27") as check:
        check(abs(chance @ np.asarray(plain) - P @ F), "<=", 1e-12, "bias of the plain estimate, by enumeration")
        check(
            abs(chance @ np.asarray(normalised) - P @ F), ">", 1e-3, "bias of the self-normalised one, which is known"
        )
        many = np.asarray(jax.random.categorical(jax.random.key(0), log_q, shape=(100_000,)))
        terms = np.asarray(jnp.exp(log_w) * f)[many]
        error = abs(float(ops.importance_mean(f[many], log_w[many])) - P @ F)
        check(error / (terms.std() / np.sqrt(many.size)), "<=", 4.0, "standard errors of the plain estimate")
        spread = np.sqrt(np.mean((np.asarray(jnp.exp(log_w))[many] * (F[many] - P @ F)) ** 2) / many.size)
        error = abs(float(ops.self_normalised_mean(f[many], log_w[many])) - P @ F)
        check(error / spread, "<=", 4.0, "standard errors of the self-normalised estimate")
        same = ops.effective_sample_size(ops.log_ratio(log_q[many], log_q[many]))
        check(abs(float(same) - many.size) / many.size, "<=", 1e-12, "relative error of ESS = N where p = q")
        with pytest.raises(ValueError, match="probability 0 at 1 of 3 values"):
            ops.importance_weights(log_p, jnp.array([0.0, -jnp.inf, 0.0]))
        refused = ops.log_ratio(jnp.array([0.0, -jnp.inf]), jnp.array([0.0, -jnp.inf]))
        check(float(refused[1]), "==", -np.inf, "neither law takes the value: weight 0, no error")


def test_weights_by_hand(x64):
    log_p, log_q = jnp.log(jnp.asarray(P)), jnp.log(jnp.asarray(Q))
    weights = ops.importance_weights(log_p, log_q)
    assert np.allclose(weights, P / Q, atol=1e-15)
    assert np.allclose(ops.normalised_weights(jnp.log(weights)), (P / Q) / np.sum(P / Q))
    size = np.sum(P / Q) ** 2 / np.sum((P / Q) ** 2)
    assert float(ops.effective_sample_size(jnp.log(weights))) == pytest.approx(size, rel=1e-12)


def test_logarithms_survive_where_weights_do_not():
    log_w = jnp.array([-1e4, -1e4, -1e4 - 100.0])
    assert float(ops.effective_sample_size(log_w)) == pytest.approx(2.0, rel=1e-3)
    assert float(ops.effective_sample_size(-log_w)) == pytest.approx(1.0, rel=1e-3)
    assert np.allclose(ops.normalised_weights(log_w), [0.5, 0.5, 0.0], atol=1e-6)
    assert float(ops.self_normalised_mean(jnp.full(3, 7.0), log_w)) == pytest.approx(7.0)


def test_impossible_values_keep_gradients_finite():
    log_q = jnp.array([-1.0, -2.0])
    gradient = jax.grad(lambda log_p: jnp.sum(ops.importance_weights(log_p, log_q)))(jnp.array([-1.0, -jnp.inf]))
    assert np.array_equal(gradient, [1.0, 0.0])


def test_under_jit_a_missing_support_is_infinite():
    log_p, log_q = jnp.array([0.0, 0.0]), jnp.array([0.0, -jnp.inf])
    assert np.array_equal(jax.jit(ops.importance_weights)(log_p, log_q), [1.0, np.inf])
    assert np.array_equal(jax.jit(lambda: ops.importance_weights(log_p, log_p))(), [1.0, 1.0])
