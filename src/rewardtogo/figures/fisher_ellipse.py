r"""The trust regions of section 7.2.4: the ball of gradient ascent, and the ellipse of the natural gradient.

A Gaussian policy N(m, σ²) has two parameters, θ = (m, log σ). Near it KL is ½ d' F d, F the Fisher information
E[∇ log π ∇ log π'] = diag(1/σ², 2), so a set of equal KL is an ellipse. Left, contours of the exact KL, an ellipse, the
circle of the same area, the ellipse of an F estimated from samples, and for one objective the best step within each.
Right, the KL along both: one number along the ellipse, many along the circle.

Source: notes, section 7.2.4 (item 7.23); the length of the natural step is sqrt(2 ε / (g' F^-1 g)), erratum E7.9.
"""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from ..policy_gradient.trust_regions import ball_constrained_step

INK, ELLIPSE, CIRCLE = "#333333", "#0072b2", "#d55e00"
THETA = np.array([0.0, np.log(0.3)])
"""(m, log σ) of the policy in the middle."""
GOAL = 0.25
"""J(θ) = E[-(a - GOAL)²] is what the steps are to raise."""
EPS = 1e-3
"""KL of the ellipse: small, so that KL is close to its quadratic model all around."""


def gaussian_kl(new: Float[np.ndarray, "... 2"], old: Float[np.ndarray, "2"]) -> Float[np.ndarray, "..."]:
    """KL(π_new || π_old) of Gaussians given as (m, log σ), exactly."""
    shift, growth = (new[..., 0] - old[0]) / np.exp(old[1]), new[..., 1] - old[1]
    return np.asarray(0.5 * (np.exp(2 * growth) + shift**2 - 1) - growth)


def gaussian_fisher(theta: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2 2"]:
    """F in (m, log σ)."""
    return np.diag([np.exp(-2 * theta[1]), 2.0])


def sampled_fisher(theta: Float[np.ndarray, "2"], seed: int, num_samples: int) -> Float[np.ndarray, "2 2"]:
    """F as the mean of ∇ log π ∇ log π' at actions of the policy."""
    noise = np.random.default_rng(seed).normal(size=num_samples)
    scores = np.stack([noise / np.exp(theta[1]), noise**2 - 1], -1)
    return scores.T @ scores / num_samples


def ellipse(fisher: Float[np.ndarray, "2 2"], eps: float, angles: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K 2"]:
    """The d with ½ d' F d = `eps`: with F = L L', d = sqrt(2 ε) L^-T u for u around the unit circle."""
    around = np.stack([np.cos(angles), np.sin(angles)])
    return np.sqrt(2 * eps) * np.linalg.solve(np.linalg.cholesky(fisher).T, around).T


def circle_radius(fisher: Float[np.ndarray, "2 2"], eps: float) -> float:
    """Of the circle with the area of the ellipse."""
    return float(np.sqrt(2 * eps) * np.linalg.det(fisher) ** -0.25)


def natural_step(
    gradient: Float[np.ndarray, "2"], fisher: Float[np.ndarray, "2 2"], eps: float
) -> Float[np.ndarray, "2"]:
    """The d of largest g·d with ½ d' F d <= ε."""
    direction = np.linalg.solve(fisher, gradient)
    return np.sqrt(2 * eps / (gradient @ direction)) * direction


def draw(seed: int = 0, num_samples: int = 300) -> Figure:
    """The figure; the dotted ellipse is from `num_samples` actions drawn with `seed`."""
    figure = Figure(figsize=(10.5, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.15, 1])
    angles = np.linspace(0, 2 * np.pi, 361)
    fisher = gaussian_fisher(THETA)
    radius = circle_radius(fisher, EPS)
    rings = {
        "ellipse": THETA + ellipse(fisher, EPS, angles),
        "circle": THETA + radius * np.stack([np.cos(angles), np.sin(angles)], -1),
        "sampled": THETA + ellipse(sampled_fisher(THETA, seed, num_samples), EPS, angles),
    }
    _draw_plane(left, rings, fisher, radius, num_samples)
    _draw_along(right, np.degrees(angles), rings)
    return figure


def _draw_plane(axis: Axes, rings: dict[str, np.ndarray], fisher: np.ndarray, radius: float, num_samples: int) -> None:
    reach = 1.25 * max(np.abs(ring - THETA).max() for ring in rings.values())
    offsets = np.linspace(-reach, reach, 201)
    plane = THETA + np.stack(np.meshgrid(offsets, offsets), -1)
    levels = EPS * np.array([0.25, 1, 2.25, 4, 6.25, 9])
    lines = axis.contour(
        plane[..., 0], plane[..., 1], gaussian_kl(plane, THETA), levels, colors="#bbbbbb", linewidths=0.8
    )
    axis.clabel(lines, fmt="%g", fontsize=7)
    axis.plot(*rings["ellipse"].T, color=ELLIPSE, linewidth=2, label="ellipse $\\frac{1}{2} d^T F d = \\epsilon$")
    axis.plot(*rings["circle"].T, color=CIRCLE, linewidth=2, label="circle of the same area")
    axis.plot(*rings["sampled"].T, ":", color=ELLIPSE, linewidth=1.6, label=f"$F$ from {num_samples} samples")
    gradient = np.array([2 * (GOAL - THETA[0]), -2 * np.exp(2 * THETA[1])])
    steps = ((natural_step(gradient, fisher, EPS), ELLIPSE), (ball_constrained_step(gradient, radius**2), CIRCLE))
    for step, colour in steps:
        ends = [(float(m), float(log)) for m, log in (THETA, THETA + step)]
        arrow = FancyArrowPatch(
            *ends, arrowstyle="-|>", mutation_scale=13, linewidth=1.6, color=colour, shrinkA=0, shrinkB=0
        )
        axis.add_patch(arrow)
    axis.plot(*THETA, "o", color=INK, markersize=4)
    axis.set(xlabel="mean $m$", ylabel="$\\log \\sigma$", aspect="equal")
    axis.set_title(
        "contours of $D_{KL}(\\pi_{\\theta'} || \\pi_\\theta)$, and the best step in each region", fontsize=11
    )
    axis.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)


def _draw_along(axis: Axes, degrees: np.ndarray, rings: dict[str, np.ndarray]) -> None:
    for name, colour in (("ellipse", ELLIPSE), ("circle", CIRCLE)):
        axis.plot(degrees, gaussian_kl(rings[name], THETA), color=colour, linewidth=2, label=f"along the {name}")
    axis.set(xlabel="angle, degrees", ylabel="$D_{KL}$", ylim=(0, None), xticks=range(0, 361, 90))
    axis.axhline(EPS, color=INK, linestyle=(0, (4, 3)), linewidth=1, label="$\\epsilon$")
    axis.set_title("KL along each", fontsize=11)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9)
