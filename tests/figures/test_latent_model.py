"""Figure 8.3: the edges are those of the notes, and they are read from the networks."""

import equinox as eqx
import jax
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Annotation

from rewardtogo.figures import latent_model
from rewardtogo.figures.latent_model import factorisation, made

KEY = jax.random.key(0)


def test_edges(item):
    networks, actions = made(0)
    model, encoder = factorisation(networks, actions, KEY)
    printed = {("s", "s'"), ("a", "s'"), ("s", "o"), ("s", "r"), ("a", "r")}
    # A network that does not look at the action has an edge less.
    first = networks.outcome.layers[0].weight
    blind = eqx.tree_at(lambda n: n.outcome.layers[0].weight, networks, first.at[:, -actions:].set(0.0))
    with item("8.64") as check:
        check(len(model ^ printed), "==", 0, "edges that differ from the figure of the notes")
        check(len(encoder ^ {("o", "s")}), "==", 0, "edges of the encoder that differ")
        check(
            len(factorisation(blind, actions, KEY)[0] ^ (printed - {("a", "r")})),
            "==",
            0,
            "the same, rewards blind to actions",
        )
        figures = [latent_model.draw(0), latent_model.draw(0, blind)]
        arrows = [sum(isinstance(text, Annotation) for text in figure.axes[0].texts) for figure in figures]
        check(arrows[0] - arrows[1], "==", 2, "arrows less where the reward is blind, in two steps")
        check(arrows[0], "==", 2 * 5 + 1 + 3, "arrows drawn")
    FigureCanvasAgg(figures[0]).draw()
