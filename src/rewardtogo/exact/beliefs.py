"""The exact belief of a partially observed problem: what the history says of the hidden state.

    b_0(s) ∝ O(o_0 | s) p_0(s),     b'(s') ∝ O(o | s') Σ_s P(s' | s, a) b(s)

An agent that acts again knows that the episode goes on, so terminal states have no part in b'.

Source: notes, section 1.1 (observations); item 1.2.
"""

import numpy as np
from jaxtyping import Array, Float

from ..envs.tabular import POMDP


def initial_belief(pomdp: POMDP, observation: int) -> Float[np.ndarray, "S"]:
    """b_0 after the first observation.

    Raises `ValueError` for an observation that cannot be made.
    """
    return _condition(pomdp, np.asarray(pomdp.mdp.initial, np.float64), observation)


def belief_update(
    pomdp: POMDP, belief: Float[Array | np.ndarray, "S"], action: int, observation: int
) -> Float[np.ndarray, "S"]:
    """The belief b' after taking `action` in belief `belief` and seeing `observation` in an episode that goes on.

    Raises `ValueError` for an observation that cannot be made there.
    """
    predicted = np.asarray(belief, np.float64) @ np.asarray(pomdp.mdp.continuation, np.float64)[:, action]
    return _condition(pomdp, predicted, observation)


def _condition(pomdp: POMDP, predicted: np.ndarray, observation: int) -> np.ndarray:
    joint = np.asarray(pomdp.emissions, np.float64)[:, observation] * predicted
    if not joint.sum() > 0:
        raise ValueError(f"observation {observation} has probability 0 under this belief, so no belief can follow it: "
                         "check that belief, action and observation belong to one history")  # fmt: skip
    return joint / joint.sum()
