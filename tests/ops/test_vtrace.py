import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.ops import lambda_returns, vtrace

RNG = np.random.default_rng(0)
T = 12


def numbers():
    r, v, following = (jnp.asarray(RNG.normal(size=T)) for _ in range(3))
    terminated = jnp.zeros(T, bool).at[4].set(True)
    cut = terminated.at[8].set(True)
    # Inside a trajectory the value of where a step led is that of the next step.
    inside = jnp.where(cut.at[-1].set(True), following, jnp.roll(v, -1))
    return r, jnp.where(terminated, 0.0, 0.9), v, inside, cut


@pytest.mark.parametrize("lambda_", [0.0, 0.7, 1.0])
def test_on_policy_it_is_the_lambda_return(item, x64, lambda_):
    r, discount, v, following, cut = numbers()
    found, ahead = vtrace(r, discount, v, following, jnp.ones(T), lambda_, cut)
    expected = lambda_returns(r, discount, following, lambda_, cut)
    after = jnp.where(cut.at[-1].set(True), following, jnp.roll(expected, -1))
    with item("4.27") as check:
        check(float(jnp.abs(found - expected).max()), "<=", 1e-12, f"V-trace, ratio 1, lambda {lambda_}: lambda-return")
        check(float(jnp.abs(ahead - (r + discount * after)).max()), "<=", 1e-12, "its advantages look one step ahead")


def test_the_definition_as_a_double_sum(item, x64):
    r, discount, v, following, cut = numbers()
    ratio = jnp.asarray(np.exp(RNG.normal(size=T)))
    found, _ = vtrace(r, discount, v, following, ratio, 0.8, cut, 1.3)
    rho = np.minimum(ratio, 1.3)
    expected = np.array(v)
    for t in range(T):
        weight = 1.0
        for k in range(t, T):
            expected[t] += weight * rho[k] * (r[k] + discount[k] * following[k] - v[k])
            if cut[k]:
                break
            weight *= float(discount[k]) * 0.8 * rho[k]
    with item("4.27") as check:
        check(np.abs(np.asarray(found) - expected).max(), "<=", 1e-12, "V-trace: the sum over later steps")


def test_it_compiles_once_for_every_bound():
    count = []
    traced = jax.jit(lambda limit: (count.append(0), vtrace(*[jnp.ones(3)] * 5, 1.0, jnp.zeros(3, bool), limit))[1])
    traced(jnp.asarray(1.0)), traced(jnp.asarray(2.0))
    assert len(count) == 1
