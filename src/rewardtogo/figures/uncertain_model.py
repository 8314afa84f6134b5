r"""Figure 8.2: a network's estimate of one dimension of a transition, its mean and its bands, by three kinds of posterior.

The change of a pendulum's speed in one step, 0.75 sin(angle), with noise whose deviation grows with the angle, seen on two stretches of
angles only. The inner band is the noise that the members report (aleatoric), the outer one has their disagreement too (epistemic): on the
data the two are nearly one. Away from them the outer one widens for the ensemble; mean-field weights and dropout widen little, which is
what they are known for.

Source: notes, section 8.3.3 (item 8.58).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..model_based import (
    Bootstrap,
    Dropout,
    MeanField,
    Posterior,
    Prediction,
    Regression,
    aleatoric,
    fit,
    total_variance,
)

GRID = np.linspace(-np.pi, np.pi, 241)
INK, BAND, TRUTH = "#333333", "#0072b2", "#d55e00"
WIDTH = 1.6449
"""Deviations on both sides that hold 90 % of a Gaussian."""
POSTERIORS: dict[str, Posterior] = {
    "bootstrap ensemble": Bootstrap(),
    "mean-field weights": MeanField(),
    "MC dropout": Dropout(0.05),
}


def truth(angle: Float[np.ndarray, "*N"]) -> tuple[Float[np.ndarray, "*N"], Float[np.ndarray, "*N"]]:
    """Mean change of the speed, and the deviation of its noise."""
    return 0.75 * np.sin(angle), 0.03 + 0.05 * np.abs(angle)


def data(seed: int, size: int = 400) -> tuple[Float[np.ndarray, "N 1"], Float[np.ndarray, "N 1"]]:
    """Angles in [-2.2, -0.7] and [0.4, 1.9], and changes."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 1.5, size) + np.where(rng.uniform(size=size) < 0.5, -2.2, 0.4)
    mean, sd = truth(angle)
    return angle[:, None], (mean + sd * rng.normal(size=size))[:, None]


class Bands(NamedTuple):
    """Mean, deviation of the noise, and deviation of everything, at some angles."""

    mean: Float[np.ndarray, "N"]
    noise: Float[np.ndarray, "N"]
    total: Float[np.ndarray, "N"]


def model(name: str, seed: int = 0) -> Regression:
    """A fit by one of the posteriors."""
    members = 5 if name == "bootstrap ensemble" else 16
    found = fit(
        *data(seed),
        jax.random.key(seed),
        posterior=POSTERIORS[name],
        sizes=(32, 32),
        members=members,
        patience=0,
        epochs=400,
    )
    return found.value


def bands(regression: Regression, angle: Float[np.ndarray, "N"]) -> Bands:
    """What it says."""
    said: Prediction = regression(jnp.asarray(angle, jnp.float32)[:, None])
    parts = (said.mean.mean(0), jnp.sqrt(aleatoric(said)), jnp.sqrt(total_variance(said)))
    return Bands(*(np.asarray(part)[:, 0] for part in parts))


def cover(regression: Regression, seed: int = 1000) -> float:
    """Share of fresh changes, at angles like those of the data, inside the bands for 90 %."""
    angle, change = data(seed, 4000)
    found = bands(regression, angle[:, 0])
    return float((np.abs(change[:, 0] - found.mean) <= WIDTH * found.total).mean())


def draw(seed: int = 0) -> Figure:
    """The three posteriors side by side."""
    return draw_models({name: model(name, seed) for name in POSTERIORS}, seed)


def draw_models(models: dict[str, Regression], seed: int) -> Figure:
    """The figure of fits that are there."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    axes = figure.subplots(1, len(models), sharey=True)
    for axis, (name, regression) in zip(axes, models.items(), strict=True):
        _draw_bands(axis, regression, seed)
        axis.set_title(f"{name}: {100 * cover(regression):.0f} % of fresh data inside", fontsize=10)
    axes[0].set(ylabel="change of the speed in one step")
    axes[0].legend(frameon=False, fontsize=8, loc="upper left")
    return figure


def _draw_bands(axis: Axes, regression: Regression, seed: int) -> None:
    found = bands(regression, GRID)
    for width, alpha, label in ((found.total, 0.18, "and what is not known"), (found.noise, 0.3, "90 % for the noise")):
        low, high = found.mean - WIDTH * width, found.mean + WIDTH * width
        axis.fill_between(GRID, low, high, color=BAND, alpha=alpha, linewidth=0, label=label)
    axis.plot(GRID, found.mean, color=BAND, linewidth=1.8, label="mean")
    axis.plot(GRID, truth(GRID)[0], color=TRUTH, linewidth=1.2, linestyle="dashed", label="the truth")
    axis.plot(*data(seed), ".", color=INK, markersize=2, alpha=0.5, label="data")
    axis.set(xlabel="angle", ylim=(-1.4, 1.4), xlim=(-np.pi, np.pi))
    axis.spines[["top", "right"]].set_visible(False)
