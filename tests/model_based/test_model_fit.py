"""Fits of networks with uncertainty: what is noise, what is not known, against closed forms and fresh data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.model_based import (
    Bootstrap,
    Dropout,
    MeanField,
    aleatoric,
    epistemic,
    fit,
    output_entropy,
    total_variance,
)
from rewardtogo.ops import FullGaussian, linear_posterior, linear_prediction
from rewardtogo.ops.schedules import Linear

KEY = jax.random.key(0)


def sine(size: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """y = sin 3x with noise of deviation .1 + .2 |x|, where .3 <= |x| <= 1."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0.3, 1.0, size) * rng.choice([-1, 1], size)
    return x[:, None], (np.sin(3 * x) + noise(x) * rng.normal(size=size))[:, None]


def noise(x: np.ndarray) -> np.ndarray:
    return 0.1 + 0.2 * np.abs(x)


def cover(regression, share: float = 0.9) -> float:
    """Share of fresh targets inside the bands for 90 %."""
    x, y = sine(4000, 9)
    said = regression(jnp.asarray(x, jnp.float32))
    centre, width = said.mean.mean(0), 1.6449 * jnp.sqrt(total_variance(said))
    return float((np.abs(y - np.asarray(centre)) <= np.asarray(width)).mean())


@pytest.fixture(scope="module")
def ensembles():
    """Fits to 400 samples and to 1600."""
    return {n: fit(*sine(n), KEY, sizes=(32, 32), epochs=4000 // (n // 50), batch_size=64).value for n in (400, 1600)}


def test_what_is_noise(item, ensembles):
    at = np.linspace(0.35, 0.95, 13)
    at = np.concatenate([-at[::-1], at])[:, None]
    found = {n: np.sqrt(np.asarray(aleatoric(r(jnp.asarray(at, jnp.float32)))))[:, 0] for n, r in ensembles.items()}
    with item("8.53") as check:
        for n in (400, 1600):
            off = np.sqrt(((found[n] / noise(at[:, 0]) - 1) ** 2).mean())
            check(
                off, "<=", {400: 0.2, 1600: 0.1}[n], f"sigma(x) at 26 places, relative, root mean square, {n} samples"
            )
        check(abs(found[1600].mean() / found[400].mean() - 1), "<=", 0.1, "with four times the data it stays")
        rise = np.polyfit(np.abs(at[:, 0]), found[1600], 1)[0]
        check(abs(rise - 0.2), "<=", 0.1, "its slope in |x|")


def test_what_is_not_known(item, ensembles):
    near = {n: r(jnp.asarray([[-0.8], [-0.5], [0.5], [0.8]])) for n, r in ensembles.items()}
    far = {n: r(jnp.asarray([[2.0], [2.5], [-2.0], [-2.5]])) for n, r in ensembles.items()}
    with item("8.54") as check:
        for n in (400, 1600):
            ratio = float(epistemic(far[n]).mean() / epistemic(near[n]).mean())
            check(ratio, ">=", 5, f"epistemic variance off the data, times that on it, {n} samples")
        fall = float(epistemic(near[400]).mean() / epistemic(near[1600]).mean())
        check(fall, ">", 1, "it falls with more data")
    with item("8.58") as check:
        check(abs(cover(ensembles[400]) - 0.9), "<=", 0.08, "cover of bands for 90 %, 400 samples")
    with item("8.59") as check:
        check(cover(ensembles[400]), ">=", 0.8, "cover of intervals for 90 %, 400 samples")
        check(cover(ensembles[400]), "<=", 0.98, "the same")


def test_an_entropy_does_not_know_what_the_model_does_not_know(item):
    """Noise of one deviation, .1, everywhere: off the data every member is as sure as on them, and wrong."""
    x, _ = sine(400)
    y = np.sin(3 * x) + 0.1 * np.random.default_rng(1).normal(size=x.shape)
    found = fit(x, y, KEY, sizes=(32, 32), epochs=500, batch_size=64).value
    places = [jnp.asarray([[-0.8], [-0.5], [0.5], [0.8]]), jnp.asarray([[-2.0], [2.0]])]
    near, far = map(found, places)
    square = [
        float(((said.mean - jnp.sin(3 * at)[None]) ** 2 / jnp.exp(said.log_variance)).mean())
        for said, at in zip((near, far), places, strict=True)
    ]
    with item("8.52") as check:
        rise = float(output_entropy(far).mean() - output_entropy(near).mean())
        check(rise, "<=", 0.1, "rise of the members' entropy off the data, nats")
        check(square[0], "<=", 1.0, "squared error over the variance that a member claims, on the data")
        check(square[1], ">=", 50, "and off them")
        check(float(epistemic(far).mean() / aleatoric(far).mean()), ">=", 5, "epistemic over aleatoric variance there")


@pytest.mark.parametrize("posterior", [MeanField(), Dropout(0.05)], ids=["mean_field", "dropout"])
def test_intervals_of_networks_with_random_weights(item, posterior):
    found = fit(*sine(400), KEY, posterior=posterior, sizes=(32,), members=16, epochs=600, patience=0).value
    with item("8.60") as check:
        check(cover(found), ">=", 0.8, f"cover of intervals for 90 %, {type(posterior).__name__}")
        check(cover(found), "<=", 0.98, "the same")


def plane(size: int, correlation: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """y = 1.5 x_1 - x_2 + .5 and noise of deviation .5; columns of x with mean 0, variance 1 and exactly this correlation."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(size, 2))
    z = np.linalg.qr(z - z.mean(0))[0]
    x = np.sqrt(size) * z @ np.linalg.cholesky(np.array([[1.0, correlation], [correlation, 1.0]])).T
    return x, (x @ np.array([1.5, -1.0]) + 0.5 + 0.5 * rng.normal(size=size))[:, None]


def exact(x: np.ndarray, y: np.ndarray) -> FullGaussian:
    """The posterior of weights and bias, both standardised, with the prior of `MeanField()`: N(0, 1/2), and N(0, 1) for the bias."""
    z = jnp.concatenate([jnp.asarray(x), jnp.ones((len(x), 1))], 1)
    target = jnp.asarray((y - y.mean()) / y.std())[:, 0]
    prior = FullGaussian(jnp.zeros(3), jnp.diag(jnp.sqrt(jnp.asarray([0.5, 0.5, 1.0]))))
    return linear_posterior(z, target, (0.5 / y.std()) ** 2, prior)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_mean_field_weights_of_a_linear_model(item, correlation):
    """Orthogonal features: the conjugate posterior. Correlated ones: its mean, and 1 / Lambda_jj, which is less than its variances."""
    x, y = plane(50, correlation)
    options = {"sizes": (), "probabilistic": False, "noise": 0.5, "holdout": 0.0, "batch_size": 50}
    found = fit(
        x, y, KEY, posterior=MeanField(), members=32, epochs=3000, learning_rate=Linear(0.03, 0.0), **options
    )  # fmt: skip
    (layer,), (spread,) = found.stats["parameters"].mean, found.stats["parameters"].log_sd
    mean = np.append(layer.weight[0], layer.bias[0])
    sd = np.exp(np.append(spread.weight[0], spread.bias[0]))
    conjugate = exact(x, y)
    precision = np.linalg.inv(np.asarray(conjugate.covariance))
    whole = np.sqrt(np.diagonal(np.asarray(conjugate.covariance)))
    with item("8.60") as check:
        off = np.abs(mean - np.asarray(conjugate.mean)).max() / np.abs(conjugate.mean).max()
        check(off, "<=", 0.05, f"mean of the weights, correlation {correlation}, relative")
        if correlation == 0.0:
            check(
                np.abs(sd / whole - 1).max(), "<=", 0.05, "deviations of the weights, those of the conjugate posterior"
            )
        else:
            check(np.abs(sd * np.sqrt(np.diagonal(precision)) - 1).max(), "<=", 0.05, "correlated: 1 / Lambda_jj")
            check((sd / whole)[:2].max(), "<=", 0.75, "correlated: less than the posterior's")


def test_dropout_in_a_linear_model_is_ridge_regression(item):
    """E over masks of |y - X m w / (1 - p)|^2 = |y - X w|^2 + p / (1 - p) sum_j w_j^2 |x_j|^2."""
    x, y = plane(50, 0.8)
    rate, target = 0.3, (y - y.mean()) / y.std()
    found = fit(
        x, y, KEY, posterior=Dropout(rate, True, 1.0, 0.0), sizes=(), probabilistic=False, holdout=0.0, batch_size=50,
        members=64, epochs=2000, learning_rate=Linear(0.03, 0.0),
    )  # fmt: skip
    weights = np.asarray(found.stats["parameters"][0].weight[0])
    gram = x.T @ x
    ridge = np.linalg.solve(gram + rate / (1 - rate) * np.diag(np.diagonal(gram)), x.T @ target)[:, 0]
    plain = np.linalg.solve(gram, x.T @ target)[:, 0]
    with item("8.60") as check:
        check(np.abs(weights / ridge - 1).max(), "<=", 0.05, "weights, those of ridge regression, relative")
        check(np.abs(weights / plain - 1).max(), ">=", 0.2, "from those of least squares")


def test_bootstrap_of_a_linear_model(item):
    """Against the closed form: the spread of 200 members is what is not known, and falls as 1/n. (With a hundred
    samples the bootstrap is itself off by a third, as resampling sees what noise there happened to be.)"""
    at, spread = np.array([[1.0, 0.5], [-1.0, 1.5], [0.5, -2.0]]), {}
    for n in (400, 1600):
        x, y = plane(n, 0.3, 1)
        options = {"sizes": (), "probabilistic": False, "holdout": 0.0, "batch_size": n}
        found = fit(x, y, KEY, members=200, epochs=150, learning_rate=Linear(0.1, 0.0), **options).value
        spread[n] = np.asarray(epistemic(found(jnp.asarray(at, jnp.float32))))[:, 0]
        features = lambda x: jnp.concatenate([jnp.asarray(x), jnp.ones((len(x), 1))], 1)  # noqa: E731
        posterior = linear_posterior(features(x), jnp.asarray(y)[:, 0], 0.25)
        closed = np.array([float(linear_prediction(posterior, row, 0.25).epistemic) for row in features(at)])
        with item("8.57") as check:
            check(
                abs(spread[n].mean() / closed.mean() - 1), "<=", 0.3, f"variance of 200 members, closed form, n = {n}"
            )
    with item("8.54") as check:
        check(abs(spread[400].mean() / spread[1600].mean() / 4 - 1), "<=", 0.3, "four times the data, a quarter of it")


def test_a_linear_map_is_found(item):
    """Without noise, whatever is predicted, change or next state; R^2 on fresh data."""
    rng = np.random.default_rng(0)
    A = np.array([[0.9, 0.1, 0.0], [-0.2, 0.8, 0.5]])
    x = rng.normal(size=(200, 3))
    options = {"sizes": (), "members": 1, "posterior": Bootstrap(False), "probabilistic": False}
    maps = {}
    for name, target in (("next", x @ A.T), ("change", x @ A.T - x[:, :2])):
        found = fit(x, target, KEY, learning_rate=Linear(0.05, 0.0), epochs=500, patience=0, **options).value
        said = lambda rows: np.asarray(found(jnp.asarray(rows, jnp.float32)).mean[0])  # noqa: B023, E731
        maps[name] = (said(np.eye(3)) - said(np.zeros((1, 3)))).T + (name == "change") * np.eye(2, 3)
    with item("8.47") as check:
        check(np.abs(maps["next"] - A).max(), "<=", 1e-3, "matrix, from next states")
        check(np.abs(maps["change"] - A).max(), "<=", 1e-3, "matrix, from changes (erratum E8.16)")
        check(np.abs(maps["change"] - maps["next"]).max(), "<=", 1e-3, "one from the other")


def test_early_stopping(item):
    """Few samples, much noise and a large network: the fit stops, and what it keeps is better than what it would have become."""

    def line(size: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(seed)
        x = rng.uniform(-1, 1, (size, 1))
        return x, x + 0.5 * rng.normal(size=(size, 1))

    (x, y), (fresh, truth) = line(60, 0), (np.linspace(-1, 1, 200)[:, None], np.linspace(-1, 1, 200)[:, None])
    options = {"sizes": (64, 64), "batch_size": 16, "probabilistic": False, "posterior": Bootstrap(False), "members": 1}
    stopped = fit(x, y, KEY, patience=30, holdout=0.25, epochs=1000, **options)
    last = fit(x, y, KEY, patience=0, holdout=0.0, epochs=1000, **options)

    def error(solution) -> float:
        return float(((np.asarray(solution.value(jnp.asarray(fresh, jnp.float32)).mean[0]) - truth) ** 2).mean())

    losses = np.asarray(stopped.stats["holdout_loss"])
    epochs = int(stopped.stats["epochs"])
    with item("8.47") as check:
        check(int(stopped.converged), "==", 1, "it stopped early")
        check(epochs - 1 - int(np.nanargmin(losses)), "==", 30, "epochs after the best")
        check(error(stopped) / error(last), "<=", 0.5, "error against the truth, over that of a fit to the end")
    assert np.isnan(losses[epochs:]).all() and not bool(last.converged)
    assert np.isfinite(np.asarray(last.stats["loss"])).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": np.zeros((3, 1))}, "as many targets as inputs"),
        ({"y": np.full((4, 1), np.nan)}, "not finite"),
        ({"holdout": 0.9}, "too little to learn from"),
        ({"noise": 0.5}, "probabilistic=False"),
        ({"epochs": 0}, "at least one epoch"),
    ],
)
def test_refusals(change, words):
    with pytest.raises(ValueError, match=words):
        fit(**({"x": np.zeros((4, 1)), "y": np.zeros((4, 1)), "key": KEY} | change))
