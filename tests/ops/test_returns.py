import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo import ops

T, GAMMA, LAMBDA = 40, 0.97, 0.8


def random_trajectory(seed):
    """Rewards, discounts, values before and after each step, and cuts: terminations and truncations mixed."""
    rng = np.random.default_rng(seed)
    terminated, truncated = rng.random(T) < 0.08, rng.random(T) < 0.08
    discount = GAMMA * (1.0 - terminated)
    return rng.normal(size=T), discount, rng.normal(size=T), rng.normal(size=T), terminated | truncated


def plain_n_step(r, discount, v, n, cut):
    """The definition, O(T n)."""
    out = np.zeros(T)
    for t in range(T):
        weight, last = 1.0, t
        for k in range(t, min(t + n, T)):
            out[t] += weight * r[k]
            weight, last = weight * discount[k], k
            if cut[k]:
                break
        out[t] += weight * v[last]
    return out


def plain_lambda(r, discount, v, lam, cut):
    """The definition: n-step returns weighted by (1 - lambda) lambda^(n-1), the rest of the weight on the last."""
    n_step = np.stack([plain_n_step(r, discount, v, n, cut) for n in range(1, T + 1)])
    out = np.zeros(T)
    for t in range(T):
        ends = np.flatnonzero(cut[t:])
        left = ends[0] + 1 if ends.size else T - t
        weights = (1.0 - lam) * lam ** np.arange(left)
        weights[-1] = lam ** (left - 1)
        out[t] = weights @ n_step[:left, t]
    return out


def test_total_return_and_reward_to_go_by_hand():
    reward = jnp.array([1.0, 2.0, 4.0])
    assert float(ops.total_return(reward, 0.5)) == 3.0
    assert np.array_equal(ops.reward_to_go(reward, jnp.full(3, 0.5)), [3.0, 4.0, 4.0])
    assert np.array_equal(ops.reward_to_go(reward, jnp.full(3, 0.5), 8.0), [4.0, 6.0, 8.0])
    # A termination in the middle stops the sum, and the value at the end does not pass it.
    assert np.array_equal(ops.reward_to_go(reward, jnp.array([0.5, 0.0, 0.5]), 8.0), [2.0, 2.0, 8.0])


@pytest.mark.parametrize("seed", range(3))
def test_reward_to_go_is_the_double_sum(seed, x64):
    r, discount, _, v, _ = random_trajectory(seed)
    products = [[np.prod(discount[t:k]) for k in range(T + 1)] for t in range(T)]
    plain = [sum(products[t][k] * r[k] for k in range(t, T)) + products[t][T] * v[-1] for t in range(T)]
    ours = ops.reward_to_go(jnp.asarray(r), jnp.asarray(discount), v[-1])
    assert np.max(np.abs(ours - np.array(plain))) <= 1e-12
    total = ops.total_return(jnp.asarray(r), GAMMA)
    assert abs(float(total) - np.sum(GAMMA ** np.arange(T) * r)) <= 1e-12


@pytest.mark.parametrize("n", [1, 2, 5, 12, T, 3 * T])
def test_n_step_returns_are_their_definition(n, x64):
    for seed in range(3):
        r, discount, _, v, cut = random_trajectory(seed)
        ours = ops.n_step_returns(jnp.asarray(r), jnp.asarray(discount), jnp.asarray(v), n, jnp.asarray(cut))
        assert np.max(np.abs(ours - plain_n_step(r, discount, v, n, cut))) <= 1e-12


@pytest.mark.parametrize("lam", [0.0, 0.3, LAMBDA, 1.0])
def test_lambda_returns_are_their_definition(lam, x64):
    for seed in range(3):
        r, discount, _, v, cut = random_trajectory(seed)
        ours = ops.lambda_returns(jnp.asarray(r), jnp.asarray(discount), jnp.asarray(v), lam, jnp.asarray(cut))
        assert np.max(np.abs(ours - plain_lambda(r, discount, v, lam, cut))) <= 1e-12


def test_lambda_zero_is_one_step_and_lambda_one_is_all_steps(x64):
    r, discount, _, v, cut = map(jnp.asarray, random_trajectory(0))
    one = ops.n_step_returns(r, discount, v, 1, cut)
    every = ops.n_step_returns(r, discount, v, T, cut)
    assert np.max(np.abs(ops.lambda_returns(r, discount, v, 0.0, cut) - one)) <= 1e-12
    assert np.max(np.abs(ops.lambda_returns(r, discount, v, 1.0, cut) - every)) <= 1e-12


def test_a_terminal_value_is_zero_and_a_truncated_one_is_not():
    # Erratum E1.5, first example: one step, reward 1. The target is 1 whatever is believed of the terminal state;
    # without the mask its fixed point is 100.
    one, cut = jnp.ones(1), jnp.ones(1, bool)
    believed = jnp.full(1, 100.0)
    assert float(ops.lambda_returns(one, jnp.zeros(1), believed, 0.9, cut)[0]) == 1.0
    assert float(ops.lambda_returns(one, jnp.full(1, 0.99), believed, 0.9, cut)[0]) == pytest.approx(100.0)
    # Second example: a loop of reward 1, cut after 10 steps.
    g, r, v, cut = 0.99, jnp.ones(10), jnp.full(10, 100.0), jnp.arange(10) == 9
    truncated, terminated = jnp.full(10, g), jnp.where(cut, 0.0, g)
    for lam in (0.0, 0.5, 1.0):
        assert np.allclose(ops.lambda_returns(r, truncated, v, lam, cut), 100.0, rtol=1e-5)
    finite = (1.0 - g**10) / (1.0 - g)
    assert float(ops.lambda_returns(r, terminated, v, 1.0, cut)[0]) == pytest.approx(finite, rel=1e-5)
    assert float(ops.n_step_returns(r, terminated, v, 10, cut)[0]) == pytest.approx(finite, rel=1e-5)
    assert float(ops.n_step_returns(r, truncated, v, 10, cut)[0]) == pytest.approx(100.0, rel=1e-5)


def test_returns_map_over_environments_and_keep_float32():
    r, discount, _, v, cut = (
        jnp.stack([jnp.asarray(x) for x in xs], 1) for xs in zip(*map(random_trajectory, range(3)), strict=True)
    )
    r, discount, v = (x.astype(jnp.float32) for x in (r, discount, v))
    both = jax.vmap(ops.lambda_returns, in_axes=(1, 1, 1, None, 1), out_axes=1)(r, discount, v, LAMBDA, cut)
    one = ops.lambda_returns(r[:, 1], discount[:, 1], v[:, 1], LAMBDA, cut[:, 1])
    assert both.dtype == jnp.float32 and both.shape == (T, 3)
    assert np.allclose(both[:, 1], one, atol=1e-6)
    steps = jax.vmap(lambda r, d, v, cut: ops.n_step_returns(r, d, v, 4, cut), in_axes=1, out_axes=1)(
        r, discount, v, cut
    )
    assert steps.dtype == jnp.float32 and steps.shape == (T, 3)


def test_zero_steps_are_refused():
    with pytest.raises(ValueError, match="give n of at least 1"):
        ops.n_step_returns(jnp.ones(3), jnp.ones(3), jnp.ones(3), 0, jnp.zeros(3, bool))
