import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats
from jax.flatten_util import ravel_pytree

from rewardtogo import ops

SAMPLES = 100_000


def normal(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def full_gaussian(seed):
    return ops.FullGaussian(normal(seed, 3), jnp.tril(0.4 * normal(seed + 1, 3, 3)) + jnp.eye(3))


# Each family with random parameters, in the precision of the moment.
FAMILIES = {
    "categorical": lambda seed: ops.Categorical(2.0 * normal(seed, 4)),
    "masked": lambda seed: ops.Categorical.masked(2.0 * normal(seed, 5), jnp.array([1, 0, 1, 1, 0])),
    "multi_categorical": lambda seed: ops.MultiCategorical(normal(seed, 9), (2, 4, 3), (3,)),
    "multi_categorical_equal": lambda seed: ops.MultiCategorical(normal(seed, 12), (3, 3, 3, 3), (2, 2)),
    "bernoulli": lambda seed: ops.Bernoulli(normal(seed, 2, 3)),
    "diag_gaussian": lambda seed: ops.DiagGaussian(normal(seed, 2, 2), 0.5 * normal(seed + 1, 2, 2)),
    "scalar_gaussian": lambda seed: ops.DiagGaussian(normal(seed), normal(seed + 1)),
    "full_gaussian": full_gaussian,
    "tanh_gaussian": lambda seed: ops.TanhGaussian(
        normal(seed, 3), 0.5 * normal(seed + 1, 3), jnp.array([-1.0, -2.0, 0.0]), jnp.array([1.0, 4.0, 0.5])
    ),
    "tanh_scalar_bounds": lambda seed: ops.TanhGaussian(normal(seed, 2), normal(seed + 1, 2), -2.0, 3.0),
}
families = pytest.mark.parametrize("make", FAMILIES.values(), ids=FAMILIES.keys())


@families
def test_samples_agree_with_log_prob_entropy_and_kl(make):
    law, other = (jax.tree.map(lambda x: x.astype(jnp.float32), make(seed)) for seed in (0, 7))

    @jax.jit
    def draw(key):
        value, log_p = law.sample_and_log_prob(key)
        return value, law.sample(key), log_p, law.log_prob(value), other.log_prob(value)

    values, same, log_p, again, log_q = jax.vmap(draw)(jax.random.split(jax.random.key(1), SAMPLES))
    assert np.array_equal(values, same) and values.dtype == law.mode().dtype and values.shape[1:] == law.mode().shape
    assert log_p.dtype == law.entropy().dtype == law.kl(other).dtype == jnp.float32
    if not isinstance(law, ops.TanhGaussian):  # the inverse of a rounded, nearly saturated tanh is not exact in float32
        assert np.allclose(log_p, again, atol=1e-5)
        log_p = again
    log_p, log_q = np.asarray(log_p, np.float64), np.asarray(log_q, np.float64)
    assert abs(-log_p.mean() - float(law.entropy())) <= 4.0 * log_p.std() / np.sqrt(SAMPLES) + 1e-5
    ratio = log_p - log_q
    assert abs(ratio.mean() - float(law.kl(other))) <= 4.0 * ratio.std() / np.sqrt(SAMPLES) + 1e-5
    assert float(law.kl(law)) == pytest.approx(0.0, abs=1e-6)


@families
def test_gradients_are_finite_differences(make, x64):
    law, other = make(0), make(7)
    value = law.sample(jax.random.key(2))
    flat, rebuild = ravel_pytree(law)

    def everything(flat):
        law = rebuild(flat)
        bounded = isinstance(law, ops.TanhGaussian)
        kl = law.kl(ops.TanhGaussian(other.mean, other.log_std, law.low, law.high)) if bounded else law.kl(other)
        return law.log_prob(value) + 2.0 * law.entropy() + 3.0 * kl

    gradient, jitted = jax.jit(jax.grad(everything))(flat), jax.jit(everything)
    big = np.abs(flat) > 1e300  # the filling of forbidden logits
    for i in np.flatnonzero(~big):
        step = np.zeros(flat.size)
        step[i] = 1e-5
        slope = (jitted(flat + step) - jitted(flat - step)) / 2e-5
        assert abs(float(gradient[i] - slope)) <= 1e-6 * max(1.0, abs(float(slope)))
    assert np.all(np.asarray(gradient)[big] == 0.0)


@families
def test_laws_map_and_compile(make):
    laws = jax.vmap(lambda shift: jax.tree.map(lambda x: x + shift, make(0)))(jnp.linspace(0.0, 0.5, 3))
    keys = jax.random.split(jax.random.key(0), 3)
    values, log_p = jax.jit(jax.vmap(lambda law, key: law.sample_and_log_prob(key)))(laws, keys)
    one = jax.tree.map(lambda x: x[1], laws)
    assert np.allclose(values[1], one.sample(keys[1]), atol=1e-6)
    assert np.allclose(log_p[1], one.sample_and_log_prob(keys[1])[1], atol=1e-5)


def all_values(law):
    if isinstance(law, ops.Categorical):
        return [jnp.asarray(i) for i in range(law.logits.size)]
    if isinstance(law, ops.Bernoulli):
        bits = itertools.product((0, 1), repeat=law.logits.size)
        return [jnp.asarray(b, jnp.int8).reshape(law.logits.shape) for b in bits]
    return [jnp.asarray(v).reshape(law.shape) for v in itertools.product(*(range(n) for n in law.counts))]


@pytest.mark.parametrize("name", ["categorical", "masked", "multi_categorical", "multi_categorical_equal", "bernoulli"])
def test_discrete_laws_sum_to_one_and_match_enumeration(name, x64):
    law, other = FAMILIES[name](0), FAMILIES[name](7)
    values = all_values(law)
    log_p, log_q = (np.array(jax.vmap(d.log_prob)(jnp.stack(values))) for d in (law, other))
    p = np.exp(log_p)
    assert abs(p.sum() - 1.0) <= 1e-12
    assert float(law.entropy()) == pytest.approx(-np.sum(p * np.where(p > 0, log_p, 0.0)), abs=1e-12)
    assert float(law.kl(other)) == pytest.approx(np.sum(p * np.where(p > 0, log_p - log_q, 0.0)), abs=1e-12)
    assert np.array_equal(law.mode(), values[int(np.argmax(p))])


def test_categorical_is_scipys_softmax(x64):
    logits = np.array([0.3, -1.0, 2.0])
    law = ops.Categorical(jnp.asarray(logits))
    assert np.allclose(law.probs, scipy.special.softmax(logits), atol=1e-15)
    assert float(law.entropy()) == pytest.approx(scipy.stats.entropy(scipy.special.softmax(logits)), abs=1e-14)
    assert law.sample(jax.random.key(0)).dtype == jnp.int32 and int(law.mode()) == 2


def test_sample_frequencies():
    law = ops.MultiCategorical(jnp.log(jnp.array([0.2, 0.8, 0.5, 0.3, 0.2])), (2, 3), (2,))
    draws = np.asarray(jax.vmap(law.sample)(jax.random.split(jax.random.key(0), SAMPLES)))
    for column, p in ((0, [0.2, 0.8]), (1, [0.5, 0.3, 0.2])):
        frequency = np.bincount(draws[:, column], minlength=len(p)) / SAMPLES
        assert np.all(np.abs(frequency - p) <= 4.0 * np.sqrt(np.array(p) * (1.0 - np.array(p)) / SAMPLES))
    together = np.mean((draws[:, 0] == 1) & (draws[:, 1] == 0))
    assert abs(together - 0.4) <= 4.0 * np.sqrt(0.24 / SAMPLES)


def test_forbidden_choices_have_probability_zero():
    mask = jnp.array([True, False, True])
    law = ops.Categorical.masked(jnp.array([1.0, 50.0, 2.0]), mask)
    assert (
        np.allclose(law.probs, [1.0 / (1.0 + np.e), 0.0, np.e / (1.0 + np.e)], atol=1e-6) and float(law.probs[1]) == 0.0
    )
    draws = jax.vmap(law.sample)(jax.random.split(jax.random.key(0), 10_000))
    assert set(np.unique(draws)) == {0, 2} and int(law.mode()) == 2

    def everything(logits):
        law = ops.Categorical.masked(logits, mask)
        other = ops.Categorical.masked(-logits, mask)
        return law.log_prob(jnp.asarray(0)) + law.entropy() + law.kl(other)

    gradient = jax.grad(everything)(jnp.array([1.0, 50.0, 2.0]))
    assert np.all(np.isfinite(gradient)) and float(gradient[1]) == 0.0
    only = ops.Categorical.masked(jnp.array([1.0, 50.0, 2.0]), jnp.array([False, True, False]))
    assert float(only.entropy()) == 0.0 and float(only.log_prob(jnp.asarray(1))) == 0.0
    assert np.isfinite(only.log_prob(jnp.asarray(0))) and float(jnp.exp(only.log_prob(jnp.asarray(0)))) == 0.0


def test_bits_of_a_bernoulli():
    law = ops.Bernoulli(jnp.array([0.0, 2.0]))
    expected = scipy.stats.bernoulli.logpmf([1, 0], scipy.special.expit([0.0, 2.0])).sum()
    assert float(law.log_prob(jnp.array([1, 0], jnp.int8))) == pytest.approx(expected, rel=1e-6)
    assert float(law.log_prob(jnp.array([True, False]))) == pytest.approx(expected, rel=1e-6)
    assert law.sample(jax.random.key(0)).dtype == jnp.int8


def extreme_laws():
    big = jnp.array([1e4, -1e4, 0.0])
    for sign in (1.0, -1.0):
        yield ops.Categorical(sign * big), ops.Categorical(-sign * big), [jnp.asarray(i) for i in range(3)]
        masked = [ops.Categorical.masked(s * big, jnp.array([True, True, False])) for s in (sign, -sign)]
        yield *masked, [jnp.asarray(i) for i in range(3)]
        multi = [ops.MultiCategorical(s * jnp.concatenate([big, big[:2]]), (3, 2), (2,)) for s in (sign, -sign)]
        yield *multi, [jnp.array([0, 1]), jnp.array([1, 0])]
        bits = [jnp.ones(3, jnp.int8), jnp.zeros(3, jnp.int8)]
        yield ops.Bernoulli(sign * big), ops.Bernoulli(-sign * big), bits
        for log_std in (-10.0, 0.0, 2.0):
            spread = jnp.full(3, log_std)
            values = [jnp.zeros(3), sign * big]
            yield ops.DiagGaussian(sign * big, spread), ops.DiagGaussian(-sign * big, spread), values
            low, high = jnp.full(3, -1.5), jnp.full(3, 2.5)
            squashed = [ops.TanhGaussian(s * big, spread, low, high) for s in (sign, -sign)]
            yield *squashed, [low, high, jnp.nextafter(high, low), high + 1.0, jnp.zeros(3)]


def test_extreme_parameters_and_actions_at_the_bounds_stay_finite():
    def measures(law, other, value, key):
        sampled = law.sample_and_log_prob(key)[1]
        return jnp.stack([law.log_prob(value), sampled, law.entropy(), law.kl(other)])

    check = jax.jit(lambda *args: (measures(*args), jax.jacrev(measures)(*args[:3], args[3])))
    check_value = jax.jit(jax.grad(lambda value, law: law.log_prob(value)))
    for law, other, values in extreme_laws():
        for value in values:
            found, gradients = check(law, other, value, jax.random.key(0))
            assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((found, gradients))), (law, value, found)
            if jnp.issubdtype(value.dtype, jnp.floating):
                assert np.all(np.isfinite(check_value(value, law))), (law, value)


def test_gaussian(item, x64):
    mean, log_std, value = normal(0, 3), 0.4 * normal(1, 3), normal(2, 3)
    root = np.tril(np.asarray(normal(3, 3, 3)), -1) + np.diag([0.5, 1.0, 2.0])
    laws = {
        "diagonal": (ops.DiagGaussian(mean, log_std), np.diag(np.exp(2.0 * np.asarray(log_std)))),
        "full": (ops.FullGaussian.of_covariance(mean, jnp.asarray(root @ root.T)), root @ root.T),
    }
    with item("3.8") as check:
        for name, (law, covariance) in laws.items():
            gap = np.asarray(value - mean)
            log_det = np.log(np.linalg.det(2.0 * np.pi * covariance))
            formula = -0.5 * gap @ np.linalg.inv(covariance) @ gap - 0.5 * log_det
            check(abs(float(law.log_prob(value)) - formula), "<=", 1e-12, f"{name}: density against the formula")
            check(
                abs(float(law.entropy()) - (1.5 + 0.5 * log_det)), "<=", 1e-12, f"{name}: entropy against the formula"
            )
        grid = jnp.stack(jnp.meshgrid(*[jnp.linspace(-12.0, 12.0, 161)] * 2), axis=-1).reshape(-1, 2)
        covariance = jnp.array([[1.0, 0.8], [0.8, 1.5]])
        for name, law in (
            ("diagonal", ops.DiagGaussian(jnp.array([0.3, -0.5]), jnp.log(jnp.array([0.7, 1.4])))),
            ("full", ops.FullGaussian.of_covariance(jnp.array([0.3, -0.5]), covariance)),
        ):
            integral = jnp.sum(jnp.exp(jax.vmap(law.log_prob)(grid))) * 0.15**2
            check(abs(float(integral) - 1.0), "<=", 1e-6, f"{name}: quadrature integral minus 1")
    assert np.allclose(laws["full"][0].covariance, root @ root.T, atol=1e-12)


def test_gaussian_samples_have_the_standard_deviation_not_the_variance():
    law = ops.DiagGaussian(jnp.array([1.0, -2.0]), jnp.log(jnp.array([0.5, 3.0])))
    draws = np.asarray(jax.vmap(law.sample)(jax.random.split(jax.random.key(0), SAMPLES)))
    assert np.allclose(draws.std(axis=0), [0.5, 3.0], rtol=4.0 / np.sqrt(2 * SAMPLES))
    assert np.all(np.abs(draws.mean(axis=0) - [1.0, -2.0]) <= 4.0 * np.array([0.5, 3.0]) / np.sqrt(SAMPLES))
    full = full_gaussian(0)
    draws = np.asarray(jax.vmap(full.sample)(jax.random.split(jax.random.key(0), SAMPLES)))
    assert np.allclose(np.cov(draws.T), full.covariance, atol=0.05)
    assert np.array_equal(law.std, jnp.exp(law.log_std)) and np.array_equal(law.mode(), law.mean)


def test_small_kl_keeps_its_digits_in_float32():
    # 1/2 (r^2 - 1 - log r^2) with r = 1 + 1e-3 is 1e-6, where float32 rounds r^2 - 1 - log r^2 to multiples of 6e-8.
    one, two = ops.DiagGaussian(jnp.zeros(1), jnp.array([1e-3])), ops.DiagGaussian(jnp.zeros(1), jnp.zeros(1))
    assert float(one.kl(two)) == pytest.approx(0.5 * (np.expm1(2e-3) - 2e-3), rel=2e-4)


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (-1.2, 0.3), (2.0, 1.5)])
def test_squashed_density_integrates_to_one_and_is_the_change_of_variables(mean, std, x64):
    law = ops.TanhGaussian(jnp.asarray(mean), jnp.log(jnp.asarray(std)), -1.0, 3.0)
    density = jax.jit(jax.vmap(lambda a: jnp.exp(law.log_prob(a))))
    # Panels that narrow towards the bounds, where the density is steep.
    nodes, weights = np.polynomial.legendre.leggauss(20)
    edges = np.tanh(np.linspace(-12.0, 12.0, 161))
    middle, half = 0.5 * (edges[1:] + edges[:-1])[:, None], 0.5 * np.diff(edges)[:, None]
    integral = np.sum(
        density(jnp.asarray((1.0 + 2.0 * (middle + half * nodes)).ravel())) * (2.0 * half * weights).ravel()
    )
    assert float(integral) == pytest.approx(1.0, abs=1e-6)
    u = np.linspace(mean - 3.0 * std, mean + 3.0 * std, 41)
    change = scipy.stats.norm.logpdf(u, mean, std) - np.log(2.0 / np.cosh(u) ** 2)
    assert np.allclose(jax.vmap(law.log_prob)(jnp.asarray(1.0 + 2.0 * np.tanh(u))), change, atol=1e-9)
    assert float(law.mode()) == pytest.approx(1.0 + 2.0 * np.tanh(mean), abs=1e-12)


def test_squashed_entropy_is_the_integral(x64):
    worst = 0.0
    entropy = jax.jit(lambda mean, log_std: ops.TanhGaussian(mean, log_std, -1.0, 1.0).entropy())
    for mean, std in itertools.product((0.0, 0.5, -2.0, 8.0, -30.0), (1e-3, 0.1, 0.7, 1.0, 1.001, 2.0, 7.4, 50.0)):

        def integrand(u, mean=mean, std=std):
            log_det = 2.0 * (np.log(2.0) - np.abs(u) - np.log1p(np.exp(-2.0 * np.abs(u))))
            return scipy.stats.norm.pdf(u, mean, std) * log_det

        reach = mean + std * np.array([-10.0, -3.0, 0.0, 3.0, 10.0])
        edges = np.unique(np.concatenate([reach, np.clip([-5.0, 0.0, 5.0], reach[0], reach[-1])]))
        pieces = sum(scipy.integrate.quad(integrand, a, b, epsabs=1e-10)[0] for a, b in itertools.pairwise(edges))
        exact = scipy.stats.norm.entropy(mean, std) + pieces
        worst = max(worst, abs(float(entropy(jnp.asarray(mean), jnp.log(jnp.asarray(std)))) - exact))
    assert worst <= 1e-5


def test_squashed_log_prob_agrees_with_the_one_of_sampling(x64):
    law = FAMILIES["tanh_gaussian"](3)
    values, log_p = jax.vmap(law.sample_and_log_prob)(jax.random.split(jax.random.key(0), 1000))
    assert np.allclose(jax.vmap(law.log_prob)(values), log_p, atol=1e-6)
    assert np.all(np.asarray(values) >= np.asarray(law.low)) and np.all(np.asarray(values) <= np.asarray(law.high))


def test_squashing_leaves_the_kl_unchanged(x64):
    one, two = (
        ops.TanhGaussian(normal(0, 3), normal(1, 3), -1.0, 1.0),
        ops.TanhGaussian(normal(2, 3), normal(3, 3), -1.0, 1.0),
    )
    gaussians = ops.DiagGaussian(one.mean, one.log_std).kl(ops.DiagGaussian(two.mean, two.log_std))
    assert float(one.kl(two)) == float(gaussians)
    assert float(jax.jit(lambda: one.kl(two))()) == pytest.approx(float(gaussians), rel=1e-12)
    with pytest.raises(ValueError, match="needs equal bounds"):
        one.kl(ops.TanhGaussian(one.mean, one.log_std, -1.0, 2.0))


def test_samples_stay_in_the_box_in_float32():
    law = ops.TanhGaussian(jnp.full(3, 20.0), jnp.zeros(3), jnp.full(3, -0.1), jnp.array([0.3, 0.7, 1e3]))
    values = jax.vmap(law.sample)(jax.random.split(jax.random.key(0), 1000))
    assert np.all(np.asarray(values) <= np.asarray(law.high)) and np.all(np.asarray(values) >= np.asarray(law.low))


def test_numpy_bounds_are_accepted():
    law = ops.TanhGaussian(jnp.zeros(2), jnp.zeros(2), np.full(2, -1.0, np.float32), np.full(2, 1.0, np.float32))
    assert law.sample(jax.random.key(0)).dtype == jnp.float32


def test_wrong_counts_are_refused():
    with pytest.raises(ValueError, match="give 5"):
        ops.MultiCategorical(jnp.zeros(4), (2, 3), (2,))
    with pytest.raises(ValueError, match="one per entry"):
        ops.MultiCategorical(jnp.zeros(5), (2, 3), (3,))
