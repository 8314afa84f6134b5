"""What an agent sees of a partially observed problem, as MDPs: the pair of state and observation, and the history.

- `joint_mdp`: the state (s, o). A policy of the observation is one of its policies, with logits that are shared by
  all states that look alike; J, trajectories and gradients then are those of any MDP.
- `history_mdp`: the state h_t = (o_0, a_0, ..., a_{t-1}, o_t), "any non-Markovian process can be made Markovian by setting
  the state as the whole history" (notes, 3.5). With b_h the belief after h,

      p(h a o' | h, a) = Σ_s b_h(s) Σ_s' P(s' | s, a) O(o' | s'),      r(h, a) = Σ_s b_h(s) r(s, a).

Source: notes, section 3.5 (erratum E3.14); items 3.13 and 3.14.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from ..envs.tabular import MDP, POMDP
from .enumeration import enumerate_trajectories
from .trajectories import Trajectories

MOST_HISTORIES = 3000
"""More histories than this and their MDP, whose transitions grow with the square, is refused."""


def joint_mdp(pomdp: POMDP) -> MDP:
    """The MDP of pairs: the state is s Z + o, with s hidden and o seen."""
    mdp, emissions = pomdp.mdp, np.asarray(pomdp.emissions, np.float64)
    states, actions, seen = mdp.num_states, mdp.num_actions, pomdp.num_observations
    moves = np.asarray(mdp.transitions, np.float64)[..., None] * emissions
    given = mdp.rewards if mdp.outcome_rewards is None else np.repeat(mdp.outcome_rewards, seen, -1)
    start = (np.asarray(mdp.initial, np.float64)[:, None] * emissions).ravel()
    transitions = np.repeat(moves.reshape(states, actions, -1), seen, 0)
    return MDP(
        transitions / transitions.sum(-1, keepdims=True),
        np.repeat(np.asarray(given, np.float64), seen, 0),
        start / start.sum(),
        mdp.discount,
        np.repeat(mdp.terminal, seen),
        mdp.horizon,
    )


def shared_rows(problem: MDP | POMDP) -> tuple[MDP, Int[np.ndarray, "S"]]:
    """The MDP to compute with, and which observation each of its states shows: its row in a policy's table."""
    if isinstance(problem, MDP):
        return problem, np.arange(problem.num_states)
    seen = problem.num_observations
    return joint_mdp(problem), np.arange(problem.mdp.num_states * seen) % seen


def enumerate_observed(
    problem: MDP | POMDP, policy: Float[Array | np.ndarray, "... O A"], horizon: int | None = None
) -> tuple[Trajectories, Float[np.ndarray, "N"]]:
    """Every trajectory of positive probability and its log probability, as `enumerate_trajectories`.

    Of a `POMDP` the trajectories hold the observations, and the hidden states `[N, T]` as `extras["state"]`: several
    may show the same.
    """
    mdp, rows = shared_rows(problem)
    every, log_probs = enumerate_trajectories(mdp, np.asarray(policy, np.float64)[..., rows, :], horizon)
    if isinstance(problem, MDP):
        return every, log_probs
    pairs = np.asarray(every.observations)
    hidden = pairs[:, :-1] // problem.num_observations
    return eqx.tree_at(
        lambda e: (e.observations, e.extras), every, (rows[pairs], {**every.extras, "state": hidden})
    ), log_probs


class Histories(eqx.Module):
    """The MDP over histories, and what they are. The last state of `mdp` is the end of every episode.

    - `steps`: t of each history; `observation`: o_t, its last one.
    - `parent`, `action`: the history before and the action between, -1 for a first observation.
    - `beliefs`: b_h(s), the distribution of the hidden state after it.
    """

    mdp: MDP
    steps: Int[np.ndarray, "H"]
    observation: Int[np.ndarray, "H"]
    parent: Int[np.ndarray, "H"]
    action: Int[np.ndarray, "H"]
    beliefs: Float[np.ndarray, "H S"]


def history_mdp(pomdp: POMDP, horizon: int | None = None) -> Histories:
    """The MDP whose states are the histories of fewer than `horizon` actions that can happen (item 3.14).

    Raises `ValueError` without a horizon, and where there are too many histories.
    """
    steps = pomdp.mdp.horizon if horizon is None else horizon
    if steps is None or steps < 1:
        raise ValueError(
            f"histories grow with every step and the horizon is {steps}: give a number of actions, at least 1"
        )
    emissions, moves = np.asarray(pomdp.emissions, np.float64), np.asarray(pomdp.mdp.continuation, np.float64)
    joint = np.asarray(pomdp.mdp.initial, np.float64)[:, None] * emissions
    seen = np.flatnonzero(joint.sum(0))
    levels = [_Level(np.full(len(seen), -1), np.full(len(seen), -1), seen, joint.T[seen])]
    first, count = 0, len(seen)
    while len(levels) < steps:
        joint = np.einsum("hs,sax,xz->hazx", levels[-1].beliefs, moves, emissions)
        parent, action, seen = np.nonzero(joint.sum(-1))
        levels.append(_Level(parent + first, action, seen, joint[parent, action, seen]))
        first, count = count, count + len(seen)
        if count > MOST_HISTORIES:
            raise ValueError(
                f"there are over {MOST_HISTORIES} histories of {steps} steps, too many for one MDP: "
                "use a shorter horizon or fewer observations"
            )
    return _as_histories(pomdp, levels, steps)


class _Level(NamedTuple):
    """All histories of one length. `joint` is p(o, s | the history before, a), which leaves the belief when normalised."""

    parent: np.ndarray
    action: np.ndarray
    seen: np.ndarray
    joint: np.ndarray

    @property
    def beliefs(self) -> np.ndarray:
        return self.joint / self.joint.sum(-1, keepdims=True)


def _as_histories(pomdp: POMDP, levels: list[_Level], steps: int) -> Histories:
    parent, action, seen, joint = (np.concatenate(parts) for parts in zip(*levels, strict=True))
    chance = joint.sum(-1)
    beliefs = joint / chance[:, None]
    count, starts = len(parent), len(levels[0].parent)
    transitions = np.zeros((count + 1, pomdp.mdp.num_actions, count + 1))
    transitions[parent[starts:], action[starts:], np.arange(starts, count)] = chance[starts:]
    # What is left is the chance that the episode ends: in a terminal state, or at the horizon.
    transitions[..., -1] = np.maximum(1 - transitions.sum(-1), 0)
    transitions /= transitions.sum(-1, keepdims=True)
    rewards = np.concatenate(
        [beliefs @ np.asarray(pomdp.mdp.rewards, np.float64), np.zeros((1, pomdp.mdp.num_actions))]
    )
    start = np.append(np.where(parent < 0, chance, 0.0), 0.0)
    mdp = MDP(transitions, rewards, start / start.sum(), pomdp.mdp.discount, np.arange(count + 1) == count, steps)
    lengths = np.repeat(np.arange(len(levels)), [len(level.parent) for level in levels])
    return Histories(mdp, lengths, seen, parent, action, beliefs)
