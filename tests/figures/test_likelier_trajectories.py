"""Figure 3.1: what is drawn is measured."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rewardtogo.exact import trajectory_log_prob
from rewardtogo.exact.softmax import softmax_policy
from rewardtogo.figures import likelier_trajectories
from rewardtogo.figures.likelier_trajectories import board, step, trajectories


def test_log_probabilities_change_in_the_order_of_the_rewards(item):
    found, mdp = step(), board()
    drawn, small = trajectories(mdp), step(1e-4)
    chance = [
        np.exp(trajectory_log_prob(mdp, softmax_policy(x), drawn.observations, drawn.actions)).sum()
        for x in (np.zeros_like(found.logits), found.logits)
    ]
    # By hand: 8 scores of squared length 3/4 each, and e_a - π against e_b - π, which is -1/4, in the square they share.
    hand = (6 * found.returns - 0.25 * (found.returns.sum() - found.returns)) / 3
    with item("3.12") as check:
        check(
            (np.argsort(found.change) != np.argsort(found.returns)).sum(), "==", 0, "order of Δ log p: of the rewards"
        )
        check(np.abs(found.returns - [1, 0.3, -1]).max(), "==", 0, "the rewards drawn: 1, .3, -1")
        check(np.abs(found.slope - hand).max(), "<=", 1e-12, "first order, against the hand")
        check(np.abs(small.change / 1e-4 - hand).max(), "<=", 1e-3, "a small step against it")
        check(chance[1], ">", chance[0], "probability of the three together")


def test_the_three_meet_only_where_they_begin():
    states = np.asarray(trajectories(board()).observations)
    paths = [set(row) for row in states]
    assert all(len(path) == 9 for path in paths)
    assert all(a & b == {states[0, 0]} for a, b in [(paths[0], paths[1]), (paths[0], paths[2]), (paths[1], paths[2])])


def test_the_drawing_shows_these_numbers():
    figure = likelier_trajectories.draw(0)
    FigureCanvasAgg(figure).draw()
    found = step()
    bars = [patch.get_height() for patch in figure.axes[2].patches]
    assert np.allclose(bars, found.change)
    widths = [
        [line.get_linewidth() for line in axis.get_lines() if len(line.get_xdata()) == 9] for axis in figure.axes[:2]
    ]
    assert np.allclose(2 * np.log(np.divide(*widths[::-1])), found.change)
