import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo import ops

T, GAMMA, LAMBDA = 30, 0.95, 0.9


def random_trajectory(seed):
    rng = np.random.default_rng(seed)
    terminated, truncated = rng.random(T) < 0.1, rng.random(T) < 0.1
    v = rng.normal(size=(2, T))
    # Inside an episode the value after a step is the value before the next one; at a cut it is not.
    cut = terminated | truncated
    v[1, :-1] = np.where(cut[:-1], v[1, :-1], v[0, 1:])
    return rng.normal(size=T), GAMMA * (1.0 - terminated), v[0], v[1], cut


def steps_left(cut, t):
    ends = np.flatnonzero(cut[t:])
    return int(ends[0]) + 1 if ends.size else T - t


def plain_n_step(r, discount, v_tm1, v_t, n, cut, t):
    weight, total, last = 1.0, 0.0, t + min(n, steps_left(cut, t)) - 1
    for k in range(t, last + 1):
        total, weight = total + weight * r[k], weight * discount[k]
    return total + weight * v_t[last] - v_tm1[t]


def plain_gae(r, discount, v_tm1, v_t, lam, cut):
    """(1 - lambda) sum_n lambda^(n-1) A^(n), the last one with all the weight that is left."""
    out = np.zeros(T)
    for t in range(T):
        left = steps_left(cut, t)
        for n in range(1, left + 1):
            weight = lam ** (n - 1) * (1.0 if n == left else 1.0 - lam)
            out[t] += weight * plain_n_step(r, discount, v_tm1, v_t, n, cut, t)
    return out


def test_gae_by_hand():
    r, v_tm1, v_t = jnp.array([1.0, 2.0]), jnp.array([4.0, 8.0]), jnp.array([8.0, 16.0])
    cut = jnp.array([False, True])
    # delta = (1 + 0.5 * 8 - 4, 2 + 0.5 * 16 - 8) = (1, 2); A_0 = 1 + 0.5 * 0.5 * 2.
    assert np.array_equal(ops.gae(r, jnp.full(2, 0.5), v_tm1, v_t, 0.5, cut), [1.5, 2.0])
    # Terminated at the end: delta_1 = 2 - 8.
    assert np.array_equal(ops.gae(r, jnp.array([0.5, 0.0]), v_tm1, v_t, 0.5, cut), [-0.5, -6.0])
    # Truncated after the first step: the trace stops, the value still counts.
    assert np.array_equal(ops.gae(r, jnp.full(2, 0.5), v_tm1, v_t, 0.5, jnp.array([True, True])), [1.0, 2.0])


def test_gae(item, x64):
    with item("4.33") as check:
        for seed in range(3):
            plain = random_trajectory(seed)
            r, discount, v_tm1, v_t, cut = map(jnp.asarray, plain)
            error = np.max(
                np.abs(ops.gae(r, discount, v_tm1, v_t, LAMBDA, cut) - plain_gae(*plain[:4], LAMBDA, plain[4]))
            )
            check(error, "<=", 1e-12, "GAE against the weighted sum of n-step advantages")
            error = np.max(np.abs(ops.gae(r, discount, v_tm1, v_t, 0.0, cut) - ops.td_error(v_tm1, r, discount, v_t)))
            check(error, "<=", 1e-12, "lambda 0 against the TD error")
            monte_carlo = np.array([plain_n_step(*plain[:4], T, plain[4], t) for t in range(T)])
            error = np.max(np.abs(ops.gae(r, discount, v_tm1, v_t, 1.0, cut) - monte_carlo))
            check(error, "<=", 1e-12, "lambda 1 against the return (with the value at a truncation) minus V")


def test_gae_is_the_lambda_return_minus_the_value(x64):
    r, discount, v_tm1, v_t, cut = map(jnp.asarray, random_trajectory(1))
    returns = ops.lambda_returns(r, discount, v_t, LAMBDA, cut)
    assert np.max(np.abs(ops.gae(r, discount, v_tm1, v_t, LAMBDA, cut) - (returns - v_tm1))) <= 1e-12


def test_unnormalised_weights_are_wrong_by_the_printed_factor(x64):
    # Erratum E4.10: without the factor 1 - lambda the sum over an endless trajectory is 1 / (1 - lambda) times too big.
    r, v = jnp.linspace(1.0, 2.0, 400), jnp.zeros(400)
    ours = float(ops.gae(r, jnp.full(400, GAMMA), v, v, 0.7, jnp.zeros(400, bool))[0])
    n_step = np.cumsum(GAMMA ** np.arange(400) * np.asarray(r))
    printed = np.sum(0.7 ** np.arange(400) * n_step)
    assert printed / ours == pytest.approx(1.0 / 0.3, rel=1e-10)


def test_n_step_advantage(item, x64):
    with item("4.30") as check:
        for n in (1, 3, 7, 2 * T):
            plain = random_trajectory(n)
            r, discount, v_tm1, v_t, cut = plain
            delta = r + discount * v_t - v_tm1
            sums = [
                sum(np.prod(discount[t:k]) * delta[k] for k in range(t, t + min(n, steps_left(cut, t))))
                for t in range(T)
            ]
            arrays = [jnp.asarray(x) for x in (r, discount, v_tm1, v_t)]
            ours = ops.n_step_advantages(arrays[0], arrays[1], arrays[2], arrays[3], n, jnp.asarray(cut))
            check(
                np.max(np.abs(ours - np.array(sums))), "<=", 1e-12, f"{n} steps against the sum of discounted TD errors"
            )
        n, value = 5, jnp.full(12, 1.0 / (1.0 - GAMMA))
        loop = ops.n_step_advantages(jnp.ones(12), jnp.full(12, GAMMA), value, value, n, jnp.zeros(12, bool))
        check(np.max(np.abs(loop)), "<=", 1e-12, "loop of reward 1 with its true value")
        printed = sum(GAMMA**k for k in range(n + 1)) + GAMMA**n * value[0] - value[0]
        check(abs(float(printed) - GAMMA**n), "<=", 1e-12, "the printed n + 1 rewards are wrong by g^n (E4.9)")


def test_weights_sum_to_one(item, x64):
    with item("4.34") as check:
        worst = 0.0
        for length in (1, 2, 3, 5, 10, 50, 200, 1000):
            weights = jax.vmap(lambda lam: ops.gae_weights(lam, length))(jnp.linspace(0.0, 1.0, 101))  # noqa: B023
            assert np.all(np.asarray(weights) >= 0.0)
            worst = max(worst, float(np.max(np.abs(np.asarray(weights, np.longdouble).sum(axis=1) - 1.0))))
        check(worst, "<=", 1e-15, "sum of the weights minus 1")
    assert np.array_equal(ops.gae_weights(0.5, 4), [0.5, 0.25, 0.125, 0.125])
    assert np.array_equal(ops.gae_weights(0.0, 3), [1.0, 0.0, 0.0]) and np.array_equal(
        ops.gae_weights(1.0, 3), [0.0, 0.0, 1.0]
    )


def test_lambda_is_the_chance_to_continue(item, x64):
    # Walk on while a coin of chance lambda says so; the mean n-step advantage of where it stops is the GAE.
    rng, length, lam, samples = np.random.default_rng(0), 12, 0.7, 100_000
    r, v = jnp.asarray(rng.normal(size=length)), jnp.asarray(rng.normal(size=length + 1))
    discount, going = jnp.full(length, GAMMA), jnp.zeros(length, bool)
    n_step = np.array([ops.n_step_advantages(r, discount, v[:-1], v[1:], n, going)[0] for n in range(1, length + 1)])
    coins = np.asarray(jax.random.uniform(jax.random.key(3), (samples, length - 1)))

    def stops_at(chance_to_go_on):
        return n_step[np.cumprod(coins < chance_to_go_on, axis=1).sum(axis=1)]

    drawn, exact = stops_at(lam), float(ops.gae(r, discount, v[:-1], v[1:], lam, going)[0])
    wrong = stops_at(1.0 - lam)
    with item("4.36") as check:
        errors = [abs(x.mean() - exact) / (x.std() / np.sqrt(samples)) for x in (drawn, wrong)]
        check(errors[0], "<=", 4.0, "standard errors between simulation and GAE")
        check(errors[1], ">", 4.0, "the same with lambda as the chance of being cut, as printed (E4.11)")


def test_normalised_advantages_have_mean_0_and_deviation_1(x64):
    x = jnp.asarray(np.random.default_rng(0).normal(5.0, 3.0, (7, 4)))
    y = ops.normalise(x)
    assert y.shape == x.shape
    assert abs(float(jnp.mean(y))) <= 1e-12 and abs(float(jnp.std(y)) - 1.0) <= 1e-12
    assert np.allclose(ops.normalise(2.0 * x + 7.0), y, atol=1e-12)


@pytest.mark.parametrize("value", [0.0, 0.1, -1e30, 1234.5678])
def test_normalising_a_constant_gives_zeros(value):
    x = jnp.full((13, 3), value)
    assert np.all(np.asarray(ops.normalise(x)) == 0.0)
    assert np.all(np.isfinite(jax.grad(lambda x: jnp.sum(jnp.sin(ops.normalise(x))))(x)))


def test_gae_maps_over_environments_and_keeps_float32():
    arrays = [np.stack(xs, 1) for xs in zip(*map(random_trajectory, range(2)), strict=True)]
    r, discount, v_tm1, v_t = (jnp.asarray(x, jnp.float32) for x in arrays[:4])
    both = jax.jit(jax.vmap(ops.gae, in_axes=(1, 1, 1, 1, None, 1), out_axes=1))(
        r, discount, v_tm1, v_t, LAMBDA, jnp.asarray(arrays[4])
    )
    assert both.dtype == jnp.float32
    r, discount, v_tm1, v_t, cut = (x[:, 1] for x in arrays)
    plain = plain_gae(r, discount, v_tm1, v_t, LAMBDA, cut)
    assert np.allclose(both[:, 1], plain, atol=1e-5)
