"""Random problems with two policies each, for the tests of chapter 7's theory, and one on which its bound is attained."""

import functools
from typing import Any

import numpy as np

from rewardtogo.envs.tabular import MDP
from rewardtogo.envs.tabular_problems import random_mdp, random_policy


@functools.cache
def problem(seed: int, **options: Any) -> tuple[MDP, np.ndarray, np.ndarray]:
    """Problem, new policy, old policy: with and without a horizon, terminal states, and policies that change in time.

    The policies are anything from far apart to within 1e-3.
    """
    rng = np.random.default_rng(seed)
    horizon = (None, 6)[seed % 2]
    common: dict[str, Any] = {
        "discount": float(rng.uniform(0.3, 0.97)),
        "horizon": horizon,
        "num_terminal": seed // 2 % 2,
        "concentration": float(rng.choice([0.1, 1.0])),
    }
    states, actions = int(rng.integers(2, 6)), int(rng.integers(2, 5))
    mdp = random_mdp(seed, states, actions, **{**common, **options})
    timed = mdp.horizon if seed // 4 % 2 else None
    old, other = (random_policy(2 * seed + k, states, actions, timed) for k in range(2))
    share = rng.choice([1.0, 0.3, 0.05, 1e-3])
    return mdp, (1 - share) * old + share * other, old


def problems(count: int, **options: Any) -> list[tuple[MDP, np.ndarray, np.ndarray]]:
    return [problem(seed, **options) for seed in range(count)]


def drifting(eps: float, discount: float) -> tuple[MDP, np.ndarray, np.ndarray]:
    """Where the lower bound is attained to first order in ε.

    Leaving state 0 gains 1, and is a gain only once: in state 1, which is never left, the same action loses 1. The
    old policy always takes action 0; the new one takes action 1 with probability ε.
    """
    transitions = np.zeros((2, 2, 2))
    transitions[0, 0, 0] = transitions[0, 1, 1] = transitions[1, :, 1] = 1
    mdp = MDP(transitions, np.array([[0.0, 1.0], [0.0, -1.0]]), 0, discount)
    return mdp, np.array([[1 - eps, eps]] * 2), np.array([[1.0, 0.0]] * 2)
