"""Figures and experiments of the notes, one file each, drawn anew from computed numbers."""

import importlib
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg

from ..catalogue import nearest

FIGURES = {
    "1.1": ("markov_chain", "a Markov chain, its simulation, and where its state distribution goes"),
    "1.2": ("anatomy", "the anatomy of reinforcement learning: the three parts of the loop, and the time each takes"),
    "2.1": ("drift", "a copy of an expert drifts away from where its data was, and DAgger does not"),
    "2.2": (
        "history",
        "a recurrent policy with one encoder, what it learns that no memoryless one can, and what history costs",
    ),
    "2.3": ("tree", "past a tree on the left or on the right: a Gaussian and three laws with several peaks"),
    "tightrope": ("tightrope_mistakes", "mistakes in T steps: in proportion to T squared for a copy, to T for DAgger"),
    "causal-confusion": ("causal_confusion", "a brake light makes a copy look better and drive worse, and two cures"),
    "3.1": (
        "likelier_trajectories",
        "three trajectories before and after a step of the policy gradient: the more rewarding, the more probable",
    ),
    "4.1": (
        "actor_critic_networks",
        "a value network with its weights, and its V beside the exact one of a linear-quadratic problem",
    ),
    "4.2": (
        "parallel_workers",
        "synchronous and asynchronous workers: who acts with which version of the parameters",
    ),
    "overestimation": ("overestimation", "estimated and true values while DQN and double DQN learn"),
    "estimators": ("estimator_variances", "exact variance and bias of every policy-gradient estimator"),
    "bias-variance": (
        "bias_variance",
        "bias and variance of n-step and lambda-returns, and what n and lambda do to learning",
    ),
    "6.2": (
        "q_processes",
        "Q-learning in general: collecting, regressing and moving the target as processes with rates, of Algorithms 9 to 13",
    ),
    "5.1": (
        "bellman_projection",
        "a Bellman backup and the projection after it in the plane of the values of two states, and where many of them lead",
    ),
    "divergences": ("divergences", "Baird's example and w, 2w: which methods diverge, and which do not"),
    "7.1": (
        "fisher_ellipse",
        "the ball of gradient ascent and the ellipse of the natural gradient, with the KL along both",
    ),
    "8.3": (
        "latent_model",
        "the graphical model with latent states, its edges read from the networks that are planned in",
    ),
    "8.1": (
        "false_belief",
        "false belief from overfitting: a planner walks over the cliff that its model does not know, and what an ensemble changes",
    ),
    "8.2": (
        "uncertain_model",
        "one dimension of a transition as a network estimates it: mean and bands, by three kinds of posterior",
    ),
}
"""Number in the notes: the module here that draws it, and what it shows."""


def draw(name: str, out: str | None = None, seed: int = 0) -> Path:
    """Draw a figure into a file (`figure-NAME.png` if not said). Raises `ValueError` for a figure that there is not."""
    if name not in FIGURES:
        raise ValueError(f"there is no figure {name!r}: {nearest(name, FIGURES, 'rtg figure')}")
    path = Path(out or f"figure-{name}.png")
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise ValueError(f"a figure is written as .png, .svg or .pdf, not {path.suffix or 'without an ending'!r}")
    module = importlib.import_module(f"{__name__}.{FIGURES[name][0]}")
    figure = module.draw(seed)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=150)
    return path
