"""Heads with several peaks: exact densities, and laws that one Gaussian or independent bins cannot be."""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithms_under_test import jit
from rewardtogo.core import Spec, from_space
from rewardtogo.nn import Autoregressive, HeadRecipe, Latent, Mixture, Standard
from rewardtogo.nn.optimise import Optimiser
from rewardtogo.ops import GaussianMixture
from rewardtogo.ops.mixtures import normal_nodes

KEY = jax.random.key(0)
LINE = from_space(spaces.Box(-2.0, 2.0, (1,), np.float32))
PLANE = from_space(spaces.Box(np.array([-1.0, -2.0], np.float32), np.array([1.0, 3.0], np.float32)))
SWITCHES = from_space(spaces.MultiDiscrete([2, 2]))
RECIPES = {"mixture": Mixture(3), "autoregressive": Autoregressive(7, 8), "latent": Latent(1, 16)}
every = pytest.mark.parametrize("name", RECIPES)


def law_of(recipe: HeadRecipe, spec: Spec, stir: float = 0.5):
    """A law with parameters that are not the first ones."""
    head = recipe.build(4, spec, KEY)
    leaves, tree = jax.tree.flatten(head)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    leaves = [x + stir * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, leaves)(jnp.ones(4))


def fit(recipe: HeadRecipe, spec: Spec, actions, steps: int = 400, rate: float = 0.02, seed: int = 0):
    """The law that maximum likelihood gives a head without anything to observe."""

    @jit
    def train(key):
        init_key, loop_key = jax.random.split(key)
        optimiser, features = Optimiser(rate, 10.0), jnp.ones(1)
        head = recipe.build(1, spec, init_key)

        def loss(head, key):
            return jax.vmap(lambda a, k: head.loss(features, a, k))(actions, jax.random.split(key, len(actions))).mean()

        def step(loop, key):
            head, state = loop
            head, state = optimiser.step(head, jax.grad(loss)(head, key), state)
            return (head.with_least_std(0.01), state), None

        (head, _), _ = jax.lax.scan(step, (head, optimiser.init(head)), jax.random.split(loop_key, steps))
        return head(features)

    return train(jax.random.key(seed))


# --- densities ---------------------------------------------------------------------------------------------------------


@every
def test_a_density_integrates_to_one(name, item):
    law = jit(lambda: law_of(RECIPES[name], LINE))()
    # Far enough for what lies outside the box, where only bins have nothing.
    edge = 2.0 if name == "autoregressive" else 30.0
    points, width = np.linspace(-edge, edge, 40_001, retstep=True)
    middle = jnp.asarray(points[:-1] + width / 2, jnp.float32)
    total = float(np.exp(np.float64(jit(jax.vmap(law.log_prob))(middle[:, None]))).sum() * width)
    with item({"mixture": "2.20", "autoregressive": "2.22", "latent": "2.21"}[name]) as check:
        check(abs(total - 1.0), "<=", 1e-4, "quadrature of the density against 1")


@every
def test_the_sample_follows_the_density(name):
    law = jit(lambda: law_of(RECIPES[name], PLANE, 0.3))()
    draws, log_p = jit(jax.vmap(law.sample_and_log_prob))(jax.random.split(KEY, 4000))
    again, mode, height, entropy = jit(
        lambda law: (jax.vmap(law.log_prob)(draws), law.mode(), law.log_prob(law.mode()), law.entropy())
    )(law)
    assert draws.shape == (4000, 2) and mode.shape == (2,)
    assert -log_p.mean() == pytest.approx(float(entropy), abs=0.15 if name == "latent" else 0.06)
    np.testing.assert_allclose(log_p, again, rtol=1e-4, atol=1e-4)
    assert float(height) > np.quantile(log_p, 0.75)


def test_a_mixture_against_the_sum_of_its_densities(item):
    rng, worst = np.random.default_rng(0), 0.0
    with jax.enable_x64(True):
        for _ in range(20):
            logits, mean = rng.normal(size=3), rng.normal(size=(3, 2))
            log_std, value = 0.5 * rng.normal(size=(3, 2)), rng.normal(size=2)
            law = GaussianMixture(jnp.asarray(logits), jnp.asarray(mean), jnp.asarray(log_std))
            weights, std = np.exp(logits) / np.exp(logits).sum(), np.exp(log_std)
            density = np.exp(-0.5 * ((value - mean) / std) ** 2) / (std * np.sqrt(2 * np.pi))
            worst = max(worst, abs(float(law.log_prob(jnp.asarray(value))) - np.log(weights @ density.prod(1))))
    with item("2.20") as check:
        check(worst, "<=", 1e-10, "log p of mixtures against the sum of densities")


def test_nodes_are_spread_like_a_normal_law():
    for size in (1, 2, 4):
        nodes = normal_nodes(64, size)
        assert nodes.shape == (64, size) and np.abs(nodes.mean(0)).max() < 1e-6
        assert np.abs(nodes.var(0) - 1).max() < 0.12


@every
def test_divergence_of_laws(name):
    divergence = jit(lambda one, other: one.kl(other))
    one = jit(lambda: law_of(RECIPES[name], PLANE, 0.3))()
    other = jax.tree.map(lambda x: x + 0.1, one)
    draws = jit(jax.vmap(one.sample))(jax.random.split(KEY, 4000))
    sampled = jit(lambda: (jax.vmap(one.log_prob)(draws) - jax.vmap(other.log_prob)(draws)).mean())()
    assert float(divergence(one, one)) == pytest.approx(0.0, abs=1e-5)
    assert float(divergence(one, other)) == pytest.approx(float(sampled), abs=0.05 + 0.1 * abs(float(sampled)))


def test_autoregressive_choices_sum_to_one_and_have_an_exact_mode(item):
    spec = from_space(spaces.MultiDiscrete([2, 3]))
    law = jit(lambda: law_of(Autoregressive(hidden=6), spec))()
    every_action = jnp.asarray([[i, j] for i in range(2) for j in range(3)], jnp.int32)
    p = np.exp(np.float64(jit(jax.vmap(law.log_prob))(every_action)))
    draws = np.asarray(jit(jax.vmap(law.sample))(jax.random.split(KEY, 6000)))
    counts = np.array([(draws == a).all(1).mean() for a in np.asarray(every_action)])
    with item("2.22") as check:
        check(abs(p.sum() - 1.0), "<=", 1e-6, "probabilities of all combinations")
        check(0.5 * np.abs(counts - p).sum(), "<=", 0.02, "total variation of 6,000 samples")
    assert float(jit(lambda law: law.entropy())(law)) == pytest.approx(-(p * np.log(p)).sum(), abs=0.15)


def test_a_bin_is_found_again(item):
    law = jit(lambda: law_of(Autoregressive(9), PLANE))()
    low, high = PLANE.bounds()
    values = jax.random.uniform(KEY, (500, 2), minval=jnp.asarray(low), maxval=jnp.asarray(high))
    centres = jax.vmap(lambda a: law.value_of(law.bins_of(a)))(values)
    with item("2.22") as check:
        error = np.abs(np.asarray(centres - values)) / ((high - low) / 9)[None]
        check(error.max(), "<=", 0.5 + 1e-5, "distance from the middle of its bin, in widths of it")


# --- what they are for -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_modes():
    """Actions around -1 and 1, sd 0.1, half of them each."""
    sides = jnp.where(jnp.arange(512) % 2 == 0, 1.0, -1.0)
    return (sides + 0.1 * jax.random.normal(KEY, (512,)))[:, None]


@pytest.fixture(scope="module")
def gauss(two_modes):
    """One Gaussian, fitted to them."""
    return fit(Standard(), LINE, two_modes)


def test_one_gaussian_is_the_average_of_two_modes(gauss, item):
    law = gauss
    with item("2.23") as check:
        check(abs(float(law.mean[0])), "<=", 0.05, "mean of the Gaussian")
        check(abs(float(law.std[0]) - np.sqrt(1 + 0.1**2)), "<=", 0.05, "its sd from sqrt(1 + s²)")
        check(float(jnp.abs(law.mode()[0])), "<", 0.1, "and its likeliest action lies between the modes")


@every
def test_two_modes_are_kept(name, two_modes, gauss, item):
    law = fit(RECIPES[name] if name != "autoregressive" else Autoregressive(41, 8), LINE, two_modes, 600)
    draws = np.asarray(jit(jax.vmap(law.sample))(jax.random.split(KEY, 2000)))[:, 0]
    gain = float(jit(lambda: (jax.vmap(law.log_prob)(two_modes) - jax.vmap(gauss.log_prob)(two_modes)).mean())())
    with item({"mixture": "2.20", "autoregressive": "2.22", "latent": "2.21"}[name]) as check:
        for side in (-1.0, 1.0):
            check((np.abs(draws - side) < 0.5).mean(), ">", 0.45, f"{name}: mass near {side:g}")
        check(gain, ">", 1.0, f"{name}: nats above one Gaussian (E2.8)")
        check(abs(abs(float(law.mode()[0])) - 1.0), "<", 0.2, f"{name}: the mode is at one of them")


def test_the_sum_of_two_gaussian_variables_is_no_mixture(two_modes, item):
    """Erratum E2.8: what the notes' words say, a weighted sum of Gaussians, read as one of random variables."""
    one, two = jax.random.normal(KEY, (2, 4000)) * 0.1 + jnp.asarray([[1.0], [-1.0]])
    summed = 0.5 * one + 0.5 * two
    with item("2.20") as check:
        check((jnp.abs(jnp.abs(summed) - 1.0) < 0.5).mean(), "==", 0.0, "half of each, added up: mass near a mode")


def test_two_entries_that_must_differ(item):
    """a_2 = not a_1: a law of two entries that no product of two laws is near."""
    first = jnp.arange(256) % 2
    actions = jnp.stack([first, 1 - first], -1).astype(jnp.int32)
    grid = jnp.asarray([[0, 0], [0, 1], [1, 0], [1, 1]], jnp.int32)
    wanted = np.array([0.0, 0.5, 0.5, 0.0])
    apart = lambda law: 0.5 * np.abs(np.exp(jit(jax.vmap(law.log_prob))(grid)) - wanted).sum()  # noqa: E731
    with item("2.22") as check:
        check(apart(fit(Autoregressive(hidden=8), SWITCHES, actions)), "<", 0.05, "total variation, autoregressive")
        check(apart(fit(Standard(), SWITCHES, actions)), ">", 0.4, "total variation, independent entries")


# --- refusals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("recipe", "space", "words"),
    [
        (Mixture(), spaces.Discrete(3), "the head mixture is for box actions, and these are discrete"),
        (Latent(), spaces.MultiBinary(3), "the head latent is for box actions"),
        (Autoregressive(), spaces.Discrete(3), "for box or multi-discrete actions"),
        (Autoregressive(), spaces.Box(-np.inf, 1.0, (1,)), "bins need a box with bounds"),
    ],
)
def test_what_is_refused(recipe, space, words):
    with pytest.raises(ValueError, match=words):
        recipe.build(4, from_space(space), KEY)
    with pytest.raises(ValueError, match=r"Mixture.components must be in \[1, inf\)"):
        Mixture(0)


def test_the_bound_lies_below_the_density(two_modes, item):
    """The loss of the latent head is above -log p, and the more draws it has the nearer."""

    @jit
    def measured():
        heads = {k: Latent(1, 16, k).build(1, LINE, KEY) for k in (1, 8, 128)}
        keys = jax.random.split(KEY, 256)
        mean = lambda f: jax.vmap(f)(two_modes[:256], keys).mean()  # noqa: E731
        bounds = [mean(lambda a, k, h=h: h.loss(jnp.ones(1), a, k)) for h in heads.values()]
        law, nodes = heads[1](jnp.ones(1)), jnp.asarray(normal_nodes(1024, 1))
        density = lambda a, k: jax.vmap(lambda z: jnp.exp(law.given(z).log_prob(a)))(nodes).mean()  # noqa: E731
        return jnp.stack([*bounds, mean(lambda a, k: -jnp.log(density(a, k)))])

    *bounds, exact = np.asarray(measured())
    with item("2.21") as check:
        for count, looser, tighter in zip((1, 8, 128), bounds, [*bounds[1:], exact], strict=True):
            check(looser - tighter, ">", -0.02, f"what the bound of {count} draws lacks to the next")
        check(bounds[2] - exact, "<", 0.3 * (bounds[0] - exact), "gap of 128 draws, and of 1")


@pytest.mark.parametrize("recipe", [Mixture(2), Latent(1, 4)], ids=["mixture", "latent"])
def test_spreads_have_a_floor(recipe):
    head = jit(lambda: recipe.build(2, LINE, KEY))()
    narrow = eqx.tree_at(lambda h: h.log_std, head, head.log_std - 20.0)
    assert np.allclose(np.exp(narrow.with_least_std(0.05).log_std), 0.1, rtol=1e-5)
