r"""Figure 8.1: false belief from overfitting. A planner looks for what its model is wrong about, and walks over a cliff.

How far to walk: an action is a step a_0 in [0, 2] and two numbers in [-1, 1] that do not matter. It earns a_0, and -1 beyond a cliff at
1.5. A model is fitted to 30 random actions with noise on their rewards, and a plan is the best of 6,000 random ones in the model. One
large network, fitted to the end, explains the noise by what does not matter, and where it is wrong upwards the plan goes. The members of
a bootstrap ensemble are wrong in different places, so that their mean is less often high by mistake, and the mean less a deviation is
pessimistic.

Source: notes, section 8.3.2 (items 8.49 and 8.51). The problem is our own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..model_based import Bootstrap, Objective, Regression, fit

CLIFF, SAMPLES, NOISE, MEMBERS, EPOCHS = 1.5, 30, 0.3, 8, 400
"""Where the cliff is, samples, the deviation of the noise on their rewards, networks of the ensemble, epochs of a fit."""
GRID = np.linspace(0.0, 2.0, 201)
"""Steps that beliefs are drawn at."""
INK, TRUTH = "#333333", "#999999"
COLOURS = {"one network": "#d55e00", "ensemble": "#0072b2", "ensemble, less a deviation": "#009e73"}


def true_reward(a: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Of a step."""
    return np.where(a > CLIFF, -1.0, a)


def actions(rng: np.random.Generator, number: int) -> Float[np.ndarray, "N 3"]:
    """Random ones."""
    return np.concatenate([rng.uniform(0.0, 2.0, (number, 1)), rng.uniform(-1.0, 1.0, (number, 2))], 1)


CANDIDATES = actions(np.random.default_rng(0), 6000)
"""The actions among which a plan chooses."""


def data(seed: int) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 1"]]:
    """Random actions on both sides of the cliff, and what they earned."""
    rng = np.random.default_rng(seed + 1)
    a = actions(rng, SAMPLES)
    return a, true_reward(a[:, :1]) + NOISE * rng.normal(size=(SAMPLES, 1))


class Belief(NamedTuple):
    """A model and what is made of its members' words, and what it believes of every candidate."""

    regression: Regression
    objective: Objective
    believed: Float[np.ndarray, "N"]

    @property
    def plan(self) -> Float[np.ndarray, "3"]:
        """The action that looks best."""
        return CANDIDATES[self.believed.argmax()]

    @property
    def predicted(self) -> float:
        """What it is worth in the model."""
        return float(self.believed.max())

    @property
    def true(self) -> float:
        """What it is worth."""
        return float(true_reward(self.plan[:1])[0])

    @property
    def gap(self) -> float:
        """How much too good it looked."""
        return self.predicted - self.true

    def along(self, plan: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """What it believes of all steps, the rest as in a plan, and the deviation over members."""
        rest = np.broadcast_to(plan[1:], (len(GRID), 2))
        said = words(self.regression, np.concatenate([GRID[:, None], rest], 1))
        return np.asarray(jax.vmap(self.objective, 1)(said)), np.asarray(said.std(0))


def words(regression: Regression, a: Float[np.ndarray, "N 3"]) -> Float[Array, "E N"]:
    """What the members say of actions."""
    return regression(jnp.asarray(a, jnp.float32)).mean[..., 0]


def beliefs(seed: int) -> dict[str, Belief]:
    """Of one set of data: one network, the mean over an ensemble, and the mean less a deviation."""
    a, r = data(seed)

    def fitted(posterior: Bootstrap, members: int) -> Regression:
        return fit(
            a, r, jax.random.key(seed), posterior=posterior, members=members, probabilistic=False, holdout=0.0, epochs=EPOCHS,
            batch_size=SAMPLES,
        ).value  # fmt: skip

    def belief(regression: Regression, objective: Objective) -> Belief:
        return Belief(regression, objective, np.asarray(jax.vmap(objective, 1)(words(regression, CANDIDATES))))

    one, several = fitted(Bootstrap(False), 1), fitted(Bootstrap(), MEMBERS)
    wanted = ((one, Objective.of()), (several, Objective.of()), (several, Objective.of("lcb", 1.0)))
    return {name: belief(*pair) for name, pair in zip(COLOURS, wanted, strict=True)}


def draw(seed: int = 0, repeats: int = 8) -> Figure:
    """The beliefs from one set of data, and predicted and true rewards of the plans from `repeats` sets."""
    return draw_found([beliefs(seed + i) for i in range(repeats)], seed)


def draw_found(found: list[dict[str, Belief]], seed: int) -> Figure:
    """The figure of what was found from the data of `seed` and the following numbers."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    # The set that fooled its network most: this is what the figure is about.
    worst = int(np.argmax([each["one network"].gap for each in found]))
    _draw_beliefs(left, found[worst], data(seed + worst))
    _draw_rewards(right, found)
    return figure


def _draw_beliefs(axis: Axes, found: dict[str, Belief], seen: tuple[np.ndarray, np.ndarray]) -> None:
    for side in (CLIFF >= GRID, CLIFF < GRID):
        label = "the truth" if side[0] else None
        axis.plot(GRID[side], true_reward(GRID[side]), color=TRUTH, linewidth=5, alpha=0.5, label=label)
    axis.axvline(CLIFF, color=TRUTH, linewidth=0.8, linestyle="dotted")
    for (name, belief), mark in zip(found.items(), "v^s", strict=True):
        colour = COLOURS[name]
        # Each along its own plan, so that the plan lies on its line.
        believed, spread = belief.along(belief.plan)
        axis.plot(GRID, believed, color=colour, linewidth=1.6, label=name)
        if name == "ensemble":
            axis.fill_between(GRID, believed - 2 * spread, believed + 2 * spread, color=colour, alpha=0.15, linewidth=0)
        step = belief.plan[0]
        axis.plot(step, belief.predicted, mark, color=colour, markersize=9, markeredgecolor=INK, zorder=5)
        axis.plot([step] * 2, [belief.predicted, belief.true], color=colour, linewidth=1, linestyle="dashed")
    axis.plot(seen[0][:, 0], seen[1], "o", color=INK, markersize=4, label="data", zorder=4)
    axis.set(xlabel="step", ylabel="reward", ylim=(-4, 8), xlim=(0, 2))
    axis.set_title("beliefs, each along its own plan; the dashed line leads from the plan to the truth", fontsize=10)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9, loc="lower left")


def _draw_rewards(axis: Axes, found: list[dict[str, Belief]]) -> None:
    for i, (name, colour) in enumerate(COLOURS.items()):
        pairs = np.array([[each[name].predicted, each[name].true] for each in found])
        ends = [i - 0.2, i + 0.2]
        axis.plot(ends, pairs.T, color=colour, alpha=0.35, linewidth=1)
        axis.plot(ends, pairs.mean(0), color=colour, linewidth=3, marker="o")
        label = name.replace(", ", ",\n")
        axis.text(i, -1.6, f"{label}\ntoo good by {pairs[:, 0].mean() - pairs[:, 1].mean():.2f}", ha="center", va="top",
                  fontsize=9, color=colour)  # fmt: skip
    axis.set(ylabel="reward of the plan: predicted (left), true (right)", xlim=(-0.6, 2.6), ylim=(-4, 5), xticks=[])
    axis.set_title(f"{len(found)} sets of data, and their means", fontsize=10)
    axis.spines[["top", "right", "bottom"]].set_visible(False)
