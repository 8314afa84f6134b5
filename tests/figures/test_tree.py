"""Figure 2.3: what is drawn is flown."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.figures import tree
from rewardtogo.figures.tree import HEADS, Flights, expert_flights, fly


@pytest.mark.parametrize("name", ["a Gaussian", "a mixture of Gaussians"])
def test_past_the_tree(name, item):
    found = fly(HEADS[name])
    sides = (found.beside > 0).mean()
    with item("2.19") as check:
        if name == "a Gaussian":
            check(
                found.collisions,
                ">=",
                0.3,
                "collisions of a Gaussian that samples: wide, and in the middle of the tree",
            )
            check(abs(found.beside.mean()), "<=", 0.05, "mean of its headings, from the tree")
        else:
            check(found.collisions, "<=", 0.05, "collisions of the mixture that is drawn")
            check(abs(sides - 0.5), "<=", 0.15, "share of its flights to the right, from a half")


def test_the_drawing_shows_these_flights(monkeypatch):
    expert = expert_flights()
    assert expert.collisions == 0 and abs(expert.beside.mean()) < 0.05
    monkeypatch.setattr(tree, "fly", lambda head, seed: Flights(np.zeros(4), np.array([-0.5, 0.5, 0.2, 0.5])))
    figure = tree.draw()
    FigureCanvasAgg(figure).draw()
    axes = [a for a in figure.get_axes() if a.get_title().endswith("in the tree")]
    assert [a.get_title() for a in axes] == [f"{name}: 25 % in the tree" for name in HEADS]
    assert all(sum(p.get_path().get_extents(p.get_patch_transform()).height for p in a.patches[1:]) == 4 for a in axes)
