r"""Figure 4.1: a value network, drawn with the weights that it was fitted to, and its V beside the exact one.

The problem is linear and quadratic in two dimensions, a mass on a spring that is pushed back to the origin:

$$s' = A s + B u + w, \qquad u = -K s + \epsilon, \qquad r = -(s^T Q s + R u^2), \qquad V^\pi(s) = -(s^T P s + c),$$

$$P = Q + R K^T K + \gamma (A - B K)^T P (A - B K), \qquad c = \frac{R \sigma_u^2 + \gamma\, \mathrm{tr}(P \Sigma)}{1 - \gamma}, \qquad
\Sigma = \sigma_w^2 I + \sigma_u^2 B B^T.$$

Short rollouts, cut before anything ended, are all that the network sees. It is fitted to reward sums (λ = 1) and by bootstrapping (λ = 0);
a cut sum goes on with V. Its error is far less than that of the reward sums that it is fitted to: neighbours average the noise away.

Source: notes, sections 4.3 and 4.4 (items 4.7, 4.11 to 4.13). The problem is our own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from ..actor_critic.value_fitting import ValueNetwork, fit_value, value_targets
from ..core import Spec, Transition
from ..nn import MLP, Optimiser
from ..nn.network import MLPTorso

A, B = np.array([[1.0, 0.3], [-0.3, 0.9]]), np.array([0.0, 0.3])
K, Q, R = np.array([0.4, 0.6]), np.diag([1.0, 0.3]), 0.1
NOISE, EXPLORATION, GAMMA = 0.06, 0.25, 0.9
REACH = 1.5
"""Rollouts start in a square of this half side."""
SIZES = (8, 8)
INK, POSITIVE, NEGATIVE, GREY = "#333333", "#0072b2", "#d55e00", "#bbbbbb"


def exact_value() -> tuple[Float[np.ndarray, "2 2"], float]:
    """P and c."""
    closed = A - np.outer(B, K)
    cost = Q + R * np.outer(K, K)
    p = np.linalg.solve(np.eye(4) - GAMMA * np.kron(closed.T, closed.T), cost.ravel()).reshape(2, 2)
    spread = NOISE**2 * np.eye(2) + EXPLORATION**2 * np.outer(B, B)
    return p, float((R * EXPLORATION**2 + GAMMA * np.trace(p @ spread)) / (1 - GAMMA))


def value_of(states: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
    """V^π, exactly."""
    p, c = exact_value()
    return -np.einsum("...i,ij,...j->...", states, p, states) - c


def rollouts(seed: int, number: int = 256, steps: int = 12) -> Transition:
    """Steps `[T, B]` of the policy, from random places; nothing terminates, and the last step is cut."""
    rng = np.random.default_rng(seed)
    states, rewards = [rng.uniform(-REACH, REACH, (number, 2))], []
    for _ in range(steps):
        s = states[-1]
        u = -s @ K + EXPLORATION * rng.normal(size=number)
        rewards.append(-np.einsum("bi,ij,bj->b", s, Q, s) - R * u**2)
        states.append(s @ A.T + u[:, None] * B + NOISE * rng.normal(size=s.shape))
    seen, none = jnp.asarray(np.stack(states), jnp.float32), jnp.zeros((steps, number), bool)
    cut = none.at[-1].set(True)
    reward = jnp.asarray(np.stack(rewards), jnp.float32)
    return Transition(seen[:-1], jnp.zeros((steps, number)), reward, none, cut, seen[1:], {})


class Fit(NamedTuple):
    """A fitted network, the steps that it was fitted to, its values there, and the reward sums with it at the end."""

    network: ValueNetwork
    states: Float[np.ndarray, "N 2"]
    values: Float[np.ndarray, "N"]
    sums: Float[np.ndarray, "N"]

    @property
    def r_squared(self) -> float:
        """1 - mean squared error / variance of V^π."""
        return 1 - self.error(self.values) / float(value_of(self.states).var())

    def error(self, estimates: Float[np.ndarray, "N"]) -> float:
        """Mean squared, of these estimates of V^π at the states."""
        return float(((estimates - value_of(self.states)) ** 2).mean())


def fit(seed: int, lambda_: float) -> Fit:
    """Regression on reward sums (λ = 1) or on r + γ V(s') (λ = 0), measured on fresh rollouts."""
    spec = Spec("box", (2,), low=(-np.inf,), high=(np.inf,))
    network = ValueNetwork.of(MLP(*SIZES), spec, jax.random.key(seed))
    rounds, updates = (20, 100) if lambda_ == 1 else (300, 10)
    network, _ = fit_value(network, rollouts(seed), gamma=GAMMA, lambda_=lambda_, rounds=rounds, updates=updates,
                           optimiser=Optimiser(1e-2, 10.0))  # fmt: skip
    fresh = rollouts(seed + 1, number=200)
    values = jax.jit(jax.vmap(jax.vmap(lambda o: network(o))))(fresh.observation)
    sums = jax.jit(lambda n, t: value_targets(n, t, GAMMA, 1.0))(network, fresh)
    flat = lambda x: np.asarray(x, np.float64).reshape(-1, *x.shape[2:])  # noqa: E731
    return Fit(network, flat(fresh.observation), flat(values), flat(sums))


def draw(seed: int = 0) -> Figure:
    """The figure; rollouts and first weights are from `seed`."""
    figure = Figure(figsize=(13, 4.4), layout="constrained")
    net, contours, scatter = figure.subplots(1, 3, width_ratios=[1.05, 1, 1])
    sums, bootstrapped = fit(seed, 1.0), fit(seed, 0.0)
    _draw_network(net, sums.network)
    _draw_contours(contours, sums.network)
    _draw_scatter(scatter, sums, bootstrapped)
    return figure


def weights_of(network: ValueNetwork) -> list[Float[Array, "out in"]]:
    """The matrix of each layer. Raises `ValueError` for a network of other than dense layers."""
    if not isinstance(network.torso, MLPTorso):
        raise ValueError(f"{type(network.torso).__name__} cannot be drawn as layers of numbers: use an MLP")
    return [layer.weight for layer in (*network.torso.layers, network.head)]


def _draw_network(axis: Axes, network: ValueNetwork) -> None:
    matrices = [np.asarray(w) for w in weights_of(network)]
    sizes = [matrices[0].shape[1], *(len(w) for w in matrices)]
    places = [[(2.2 * column, row - (size - 1) / 2) for row in range(size)] for column, size in enumerate(sizes)]
    for column, matrix in enumerate(matrices):
        for (after, before), weight in np.ndenumerate(matrix / np.abs(matrix).max()):
            start, end = places[column][before], places[column + 1][after]
            axis.plot([start[0], end[0]], [start[1], end[1]], color=POSITIVE if weight > 0 else NEGATIVE,
                      linewidth=2.5 * abs(weight), alpha=0.75, zorder=1)  # fmt: skip
    for layer in places:
        for place in layer:
            axis.add_patch(Circle(place, 0.24, facecolor="white", edgecolor=INK, linewidth=1.3, zorder=2))
    for i, (x, y) in enumerate(places[0]):
        axis.text(x - 0.35, y, f"$s_{i + 1}$", ha="right", va="center", fontsize=13, color=INK)
    axis.text(places[-1][0][0] + 0.35, 0, "$V_\\phi(s)$", ha="left", va="center", fontsize=13, color=INK)
    axis.set(xlim=(-0.9, 2.2 * len(matrices) + 1.6), ylim=(max(sizes) / 2 + 0.1, -max(sizes) / 2 - 0.1), aspect="equal")
    axis.axis("off")
    axis.set_title("the value network, with its weights", fontsize=11)


def _draw_contours(axis: Axes, network: ValueNetwork) -> None:
    line = np.linspace(-REACH, REACH, 61)
    grid = np.stack(np.meshgrid(line, line), -1)
    found = jax.vmap(jax.vmap(lambda o: network(o)))(jnp.asarray(grid, jnp.float32))
    found, exact = np.asarray(found), value_of(grid)
    shades, levels = np.arange(-20, 1), [-18, -15, -12, -9, -6, -4, -2]
    colours = axis.contourf(line, line, found, shades, cmap="Blues_r", extend="both", alpha=0.6)
    axis.contour(line, line, found, levels, colors=POSITIVE, linewidths=1.5, linestyles="solid")
    axis.contour(line, line, exact, levels, colors=INK, linewidths=1.2, linestyles="dashed")
    bar = colours.get_figure().colorbar(colours, ax=axis, shrink=0.85, ticks=[-20, -15, -10, -5, 0])  # type: ignore[union-attr]
    bar.outline.set_visible(False)  # type: ignore[operator]
    axis.set(xlabel="position $s_1$", ylabel="velocity $s_2$", aspect="equal")
    axis.set_title("fitted $V_\\phi$ (solid) and exact $V^\\pi$ (dashed)", fontsize=11)


def _draw_scatter(axis: Axes, sums: Fit, bootstrapped: Fit) -> None:
    shown = slice(None, None, 3)
    axis.plot(value_of(sums.states)[shown], sums.sums[shown], ".", color=GREY, markersize=3, label="single reward sums")
    for found, colour, name in ((sums, POSITIVE, "fitted to reward sums"), (bootstrapped, NEGATIVE, "bootstrapped")):
        axis.plot(value_of(found.states)[shown], found.values[shown], ".", color=colour, markersize=3,
                  label=f"{name}: $R^2$ = {found.r_squared:.3f}")  # fmt: skip
    span = [value_of(sums.states).min(), value_of(sums.states).max()]
    axis.plot(span, span, color=INK, linewidth=1)
    axis.set(xlabel="$V^\\pi(s)$, exact", ylabel="estimate")
    axis.set_title("estimates in fresh rollouts", fontsize=11)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9, markerscale=3)
