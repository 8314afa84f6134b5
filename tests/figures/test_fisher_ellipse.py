"""The figure of the two trust regions: what its curves show is measured."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import fisher_ellipse
from rewardtogo.figures.fisher_ellipse import (
    EPS,
    THETA,
    circle_radius,
    ellipse,
    gaussian_fisher,
    gaussian_kl,
    natural_step,
    sampled_fisher,
)


def test_kl_is_constant_along_the_ellipse_and_not_along_the_circle(item):
    figure = fisher_ellipse.draw(seed=1)
    FigureCanvasAgg(figure).draw()
    plane, along = figure.axes
    rings = {line.get_label(): np.asarray(line.get_xydata()) for line in plane.get_lines()[:2]}
    kls = {line.get_label(): np.asarray(line.get_ydata()) for line in along.get_lines()[:2]}
    drawn = [gaussian_kl(ring, THETA) for ring in rings.values()]
    with item("7.23") as check:
        check(np.abs(kls["along the ellipse"] / EPS - 1).max(), "<=", 0.05, "KL along the ellipse, from ε")
        circle = kls["along the circle"]
        check(circle.max() / circle.min(), ">", 3, "largest KL along the circle over the least")
        for kl, ring in zip(kls.values(), drawn, strict=True):
            check(np.abs(kl - ring).max(), "==", 0, "curves on the right against the rings on the left")


def test_the_fisher_information_of_a_gaussian(item):
    fisher, step = gaussian_fisher(THETA), 1e-4
    moves = step * np.eye(2)
    hessian = np.array(
        [
            [sum(i * j * gaussian_kl(THETA + i * a + j * b, THETA) for i in (1, -1) for j in (1, -1)) for b in moves]
            for a in moves
        ]
    ) / (4 * step**2)
    sampled = sampled_fisher(THETA, 0, 1_000_000)
    with item("7.23") as check:
        check(np.abs(hessian - fisher).max(), "<=", 1e-5, "F against the second differences of KL")
        errors = np.array([[2**0.5 / 0.09, 2.9 / 0.3], [2.9 / 0.3, 56**0.5]]) / 1e3
        check((np.abs(sampled - fisher) / errors).max(), "<=", 4, "standard errors of F from 10^6 samples")
    angles = np.linspace(0, 2 * np.pi, 50)
    for matrix in (fisher, sampled_fisher(THETA, 0, 30)):
        d = ellipse(matrix, EPS, angles)
        assert np.allclose(0.5 * np.einsum("ki,ij,kj->k", d, matrix, d), EPS)
        assert np.isclose(np.pi * circle_radius(matrix, EPS) ** 2, 2 * np.pi * EPS / np.sqrt(np.linalg.det(matrix)))


def test_the_natural_step_ends_on_the_ellipse(item):
    gradient, fisher = np.array([0.5, -0.18]), gaussian_fisher(THETA)
    step = natural_step(gradient, fisher, EPS)
    printed = np.sqrt(2 * EPS / (gradient @ fisher @ gradient)) * np.linalg.solve(fisher, gradient)
    others = ellipse(fisher, EPS, np.linspace(0, 2 * np.pi, 10_000))
    with item("7.23") as check:
        check(abs(0.5 * step @ fisher @ step / EPS - 1), "<=", 1e-12, "½ d' F d / ε - 1 of the step drawn")
        check((others @ gradient).max() - step @ gradient, "<=", 0, "g·d around the ellipse beyond that of the step")
        off = gaussian_kl(THETA + printed, THETA) / EPS
        check(max(off, 1 / off), ">", 10, "E7.9: with the printed g'Fg, how far KL is from ε (factor)")
