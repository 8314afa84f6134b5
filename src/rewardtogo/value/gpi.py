"""Generalised policy iteration: evaluate, improve, and again (notes, section 5.2.1; Sutton and Barto 2018, 4.6).

What it is depends on the two hooks alone: an exact evaluation makes it policy iteration (Algorithm 6), one backup value iteration
(Algorithm 7), a regression to r + γ max_a' Q fitted Q-iteration (Algorithm 9). Where evaluation is exact and improvement greedy, no value
ever falls (policy improvement theorem); with estimates there is no such promise (erratum E5.1).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..core import Solution

UNTIL = ("policy", "values")


def generalised_policy_iteration(
    evaluate: Callable[[Any, Any], Any],
    improve: Callable[[Any], Any],
    policy: Any,
    values: Any,
    *,
    until: str = "policy",
    tolerance: float = 1e-12,
    max_rounds: int = 10_000,
) -> Solution:
    """Loop until the policy, or the values, stay as they are.

    - `evaluate(policy, values)`: V, Q or A of a policy as an array, perhaps from the last values.
    - `improve(values)`: a policy, as an array.

    `value` is the pair (policy, values), `stats["values"]` the values of each round.

    Raises `ValueError` for another end than the policy's or the values', and where there would be no round.
    """
    if until not in UNTIL:
        raise ValueError(f"it goes on until one of {', '.join(UNTIL)} stays, not {until!r}")
    if max_rounds < 1:
        raise ValueError(f"{max_rounds} rounds find nothing: allow at least 1")
    path, settled = [], False
    while not settled and len(path) < max_rounds:
        new_values = np.asarray(evaluate(policy, values))
        new_policy = np.asarray(improve(new_values))
        if until == "policy":
            settled = np.array_equal(new_policy, policy)
        else:
            settled = bool(np.abs(new_values - values).max() <= tolerance * max(1.0, np.abs(new_values).max()))
        policy, values = new_policy, new_values
        path.append(values)
    stats = {"rounds": np.asarray(len(path)), "values": np.stack(path)}
    return Solution((policy, values), np.asarray(settled), stats)
