"""Problems small enough to list all batches of, and a finite difference. Two states, two actions, three steps."""

from typing import NamedTuple

import numpy as np

from rewardtogo.envs.tabular import MDP, POMDP
from rewardtogo.envs.tabular_problems import random_mdp


class Small(NamedTuple):
    """A random MDP with two tables of logits: the policy's own, and another one that is somewhat different."""

    mdp: MDP
    logits: np.ndarray
    other: np.ndarray


def small(discount=1.0):
    rng = np.random.default_rng(1)
    transitions = rng.dirichlet(np.ones(2), size=(2, 2))
    rewards = rng.normal(size=(2, 2))
    logits = rng.normal(size=(2, 2))
    other = logits + 0.7 * rng.normal(size=(2, 2))
    return Small(MDP(transitions, rewards, [0.6, 0.4], discount, horizon=3), logits, other)


def offset(mdp, constant):
    """The same problem with `constant` added to every reward."""
    return MDP(mdp.transitions, mdp.rewards + constant, mdp.initial, mdp.discount, mdp.terminal, mdp.horizon)


def aliased(seed, states=4, horizon=3, discount=0.9):
    """A random problem whose states look alike in pairs."""
    mdp = random_mdp(seed, states, 2, horizon=horizon, discount=discount, concentration=0.5)
    return POMDP(mdp, np.eye(states // 2)[np.arange(states) // 2])


def finite_difference(function, at, step=1e-5):
    """Central differences of a number or an array with respect to every entry of `at`: `[*at.shape, ...]`."""
    columns = []
    for i in range(at.size):
        change = np.zeros(at.size)
        change[i] = step
        change = change.reshape(at.shape)
        columns.append((np.asarray(function(at + change)) - np.asarray(function(at - change))) / (2 * step))
    return np.stack(columns).reshape(*at.shape, *np.shape(columns[0]))
