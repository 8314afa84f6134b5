r"""Plans without and with feedback, exactly, in finite decision processes (notes, section 8.1).

$$p(s_0, \dots, s_H \mid a_0, \dots, a_{H-1}) = p(s_0) \prod_{t=0}^{H-1} p(s_{t+1} \mid s_t, a_t), \qquad
J(a_0, \dots, a_{H-1}) = E\Big[ \sum_t r(s_t, a_t) \Big]$$

An open-loop plan fixes its actions beforehand; a policy chooses each after seeing the state, so that its best value is never less (item
8.6).
H actions make H transitions (erratum E8.11).
"""

import itertools

import numpy as np
from jaxtyping import Float

from ..core import Solution
from ..envs.tabular import MDP

MOST = 2_000_000
"""Sequences that are worth trying one by one."""


def open_loop_return(mdp: MDP, actions: np.ndarray) -> float:
    """E[sum_t gamma^t r(s_t, a_t)] of a sequence of actions (item 8.4). A terminal state is left no more and gives nothing."""
    return float(open_loop_returns(mdp, np.asarray(actions)[None])[0])


def open_loop_returns(mdp: MDP, sequences: np.ndarray) -> Float[np.ndarray, "N"]:
    """The returns of many sequences `[N, H]`."""
    sequences = np.asarray(sequences)
    if sequences.ndim != 2 or (sequences.size and not (0 <= sequences.min() and sequences.max() < mdp.num_actions)):
        raise ValueError(f"sequences are whole numbers [N, H] from 0 to {mdp.num_actions - 1}")
    over = np.asarray(mdp.terminal)
    rewards = np.where(over[:, None], 0.0, mdp.rewards)
    law = np.broadcast_to(mdp.initial, (len(sequences), mdp.num_states)).copy()
    total, weight = np.zeros(len(sequences)), 1.0
    for action in sequences.T:
        total += weight * np.einsum("ns,sn->n", law, rewards[:, action])
        law = np.einsum("ns,snk->nk", law, mdp.transitions[:, action, :]) if len(law) else law
        weight *= mdp.discount
    return total


def best_open_loop(mdp: MDP, horizon: int) -> Solution:
    """The best sequence of `horizon` actions, by trying all; `value` is the sequence, `stats["return"]` what it brings.

    Raises `ValueError` where there are more than two million.
    """
    count = mdp.num_actions**horizon
    if horizon < 1 or count > MOST:
        raise ValueError(f"{mdp.num_actions}^{horizon} sequences are too many (or none) to try one by one")
    sequences = np.array(list(itertools.product(range(mdp.num_actions), repeat=horizon)))
    returns = open_loop_returns(mdp, sequences)
    best = int(np.argmax(returns))
    return Solution(sequences[best], np.asarray(True), {"return": returns[best], "evaluations": count})
