import itertools

import numpy as np
import pytest

from rewardtogo.envs.tabular import POMDP
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.exact import belief_update, initial_belief


def by_enumeration(pomdp, actions, observations):
    """p(s_T | o_0, a_0, ..., o_T, not ended) as a sum over every hidden path."""
    mdp, weights = pomdp.mdp, np.zeros(pomdp.mdp.num_states)
    for path in itertools.product(range(mdp.num_states), repeat=len(observations)):
        weight = mdp.initial[path[0]] * pomdp.emissions[path[0], observations[0]]
        for s, a, after, o in zip(path, actions, path[1:], observations[1:], strict=False):
            weight *= mdp.transitions[s, a, after] * pomdp.emissions[after, o] * (not mdp.terminal[after])
        weights[path[-1]] += weight
    return weights / weights.sum()


def test_the_filter_is_bayes_rule(item):
    worst = 0.0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        pomdp = POMDP(random_mdp(seed, 4, 2, num_terminal=seed % 2), rng.dirichlet(np.ones(3), 4))
        actions, observations = rng.integers(2, size=4), rng.integers(3, size=5)
        belief = initial_belief(pomdp, int(observations[0]))
        for action, observation in zip(actions, observations[1:], strict=True):
            belief = belief_update(pomdp, belief, int(action), int(observation))
        worst = max(worst, np.abs(belief - by_enumeration(pomdp, actions, observations)).max())
    with item("1.2") as check:
        check(worst, "<=", 1e-12, "belief against Bayes by enumeration")


def test_seeing_the_state_leaves_no_doubt(item):
    pomdp = POMDP(random_mdp(1, 3, 2), np.eye(3))
    with item("1.2") as check:
        check(np.abs(belief_update(pomdp, np.full(3, 1 / 3), 1, 2) - [0, 0, 1]).max(), "==", 0, "O = identity")


def test_what_cannot_be_seen_is_refused():
    pomdp = POMDP(random_mdp(1, 2, 1), np.array([[1.0, 0.0], [1.0, 0.0]]))
    with pytest.raises(ValueError, match="probability 0"):
        initial_belief(pomdp, 1)
