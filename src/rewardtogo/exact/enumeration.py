"""Sums over every trajectory and over every deterministic policy: slow, and beyond doubt.

    log p_π(τ) = log p_0(s_0) + Σ_{t=0}^{T-1} [log π(a_t | s_t) + log P(s_{t+1} | s_t, a_t)],   τ = (s_0, a_0, ...,
    a_{T-1}, s_T)

    J(π) = Σ_τ p_π(τ) Σ_t γ^t r_t

The notes' trajectory ends at a_T and its density has T transitions, one more than it has states for; drop the last
transition or keep the last state, and it sums to 1 either way (erratum E1.1). An episode that ends early is padded
with action 0 in its terminal state, at probability 1.

Source: notes, section 1.1.
"""

import itertools

import numpy as np
from jaxtyping import Array, Float, Int

from ..envs.tabular import MDP, POMDP, can_end
from .dynamic_programming import horizon_of
from .policies import check_policy
from .trajectories import Trajectories

MOST_TRAJECTORIES = 4_000_000
"""More entries than this and enumeration is refused: the arrays would no longer fit a small machine."""

MOST_POLICIES = 300_000
"""More deterministic policies than this and the search is refused."""


def enumerate_trajectories(
    mdp: MDP, policy: Float[Array | np.ndarray, "... S A"], horizon: int | None = None
) -> tuple[Trajectories, Float[np.ndarray, "N"]]:
    """Every trajectory of positive probability under `policy`, and its log probability.

    Raises `ValueError` without a horizon, and where there are too many to hold.
    """
    steps = _need_horizon(mdp, horizon)
    table = check_policy(mdp, policy, steps)
    transitions, terminal = np.asarray(mdp.transitions, np.float64), np.asarray(mdp.terminal)
    states = np.flatnonzero(mdp.initial)[:, None]
    log_probs = np.log(np.asarray(mdp.initial, np.float64)[states[:, 0]])
    actions = np.zeros((len(states), 0), int)
    for t in range(steps):
        joint = table[t][:, :, None] * transitions
        joint[terminal] = np.eye(mdp.num_states)[terminal][:, None] * (np.arange(mdp.num_actions) == 0)[None, :, None]
        here = joint[states[:, -1]]
        if np.count_nonzero(here) * steps > MOST_TRAJECTORIES:
            raise ValueError(
                f"{mdp.num_states} states and {mdp.num_actions} actions have too many trajectories of {steps} steps "
                "to list: use a smaller problem, a shorter horizon, or dynamic programming"
            )
        parent, action, following = np.nonzero(here)
        log_probs = log_probs[parent] + np.log(here[parent, action, following])
        states = np.concatenate([states[parent], following[:, None]], 1)
        actions = np.concatenate([actions[parent], action[:, None]], 1)
    return _as_trajectories(mdp, table, states, actions), log_probs


def _as_trajectories(mdp: MDP, table: np.ndarray, states: np.ndarray, actions: np.ndarray) -> Trajectories:
    now, following, steps = states[:, :-1], states[:, 1:], actions.shape[1]
    alive = ~np.asarray(mdp.terminal)[now]
    # Terminal states have reward 0 in the arrays already, so padding adds nothing.
    rewards = mdp.rewards[now, actions] if mdp.outcome_rewards is None else mdp.outcome_rewards[now, actions, following]
    log_prob = np.log(table[np.arange(steps), now, actions], where=alive, out=np.zeros(alive.shape))
    ended = np.asarray(mdp.terminal)[states[:, -1]] | (steps == mdp.horizon)
    return Trajectories(
        states, actions, np.asarray(rewards, np.float64), alive.sum(-1), ended, ~ended, {"log_prob": log_prob}
    )


def _need_horizon(mdp: MDP, horizon: int | None) -> int:
    steps = horizon_of(mdp, horizon)
    if steps is None:
        raise ValueError("trajectories of this problem have no last step, so they cannot be listed: give a horizon")
    return steps


def trajectory_log_prob(
    mdp: MDP,
    policy: Float[Array | np.ndarray, "... S A"],
    states: Int[Array | np.ndarray, "N K"],
    actions: Int[Array | np.ndarray, "N T"],
) -> Float[np.ndarray, "N"]:
    """The logarithm of p_π(τ) of trajectories (item 1.14), -inf for impossible ones.

    `states` holds T + 1 of them, or T: then the last transition is left out, which is the notes' trajectory read so
    that it is a density. Actions after a terminal state are padding and count nothing.
    """
    states, actions = np.asarray(states), np.asarray(actions)
    steps = actions.shape[1]
    if states.shape[1] not in (steps, steps + 1):
        raise ValueError(
            f"{steps} actions go with {steps + 1} states, or {steps} without the last one, not with {states.shape[1]}"
        )
    table = check_policy(mdp, policy, steps)
    alive = ~np.asarray(mdp.terminal)[states[:, :steps]]
    chosen = np.where(alive, table[np.arange(steps), states[:, :steps], actions], 1.0)
    moves = states.shape[1] - 1
    moved = np.asarray(mdp.transitions, np.float64)[states[:, :moves], actions[:, :moves], states[:, 1:]]
    with np.errstate(divide="ignore"):
        return np.log(mdp.initial[states[:, 0]]) + np.log(chosen).sum(-1) + np.log(moved).sum(-1)


def enumerated_return(mdp: MDP, policy: Float[Array | np.ndarray, "... S A"], horizon: int | None = None) -> float:
    """J(π) = Σ_τ p(τ) Σ_t γ^t r_t by enumeration (item 1.15)."""
    trajectories, log_probs = enumerate_trajectories(mdp, policy, horizon)
    return float(np.exp(log_probs) @ trajectories.returns(float(mdp.discount)))


def best_deterministic_policy(
    problem: MDP | POMDP, horizon: int | None = None, *, time_varying: bool = False
) -> tuple[Float[np.ndarray, "... O A"], float]:
    """argmax_π J(π) by trying every deterministic policy (item 1.17): its table and its J.

    There are |A|^|S| of them, or |A|^(|S| T) that vary with time; of a POMDP the policies of the observation are
    tried (item 1.6). One that goes on for ever at discount 1 counts as -∞. Raises `ValueError` where there are too
    many to try.
    """
    mdp = problem.mdp if isinstance(problem, POMDP) else problem
    steps = _need_horizon(mdp, horizon) if time_varying else horizon_of(mdp, horizon)
    inputs = problem.num_observations if isinstance(problem, POMDP) else mdp.num_states
    # Nothing is chosen in a terminal state that is seen as such.
    free = np.ones(inputs, bool) if isinstance(problem, POMDP) else ~np.asarray(mdp.terminal)
    choices = int(free.sum()) * (steps or 1) ** time_varying
    if mdp.num_actions**choices > MOST_POLICIES:
        raise ValueError(
            f"there are {mdp.num_actions}^{choices} deterministic policies, too many to try them all: "
            "use a smaller problem or dynamic programming"
        )
    listed = np.array(list(itertools.product(range(mdp.num_actions), repeat=choices)), int)
    actions = np.zeros((len(listed), steps if time_varying else 1, inputs), int)  # type: ignore[arg-type]
    actions[:, :, free] = listed.reshape(len(listed), -1, int(free.sum()))
    emissions = problem.emissions if isinstance(problem, POMDP) else np.eye(inputs)
    returns = _returns_of_all(mdp, np.asarray(emissions), actions, steps)
    best = int(returns.argmax())
    table = np.eye(mdp.num_actions)[actions[best]]
    return (table if time_varying else table[0]), float(returns[best])


def _returns_of_all(mdp: MDP, emissions: np.ndarray, actions: np.ndarray, steps: int | None) -> np.ndarray:
    """J of K policies `[K, T or 1, O]` at once."""

    def chain(t: int) -> tuple[np.ndarray, np.ndarray]:
        table = emissions @ np.eye(mdp.num_actions)[actions[:, t % actions.shape[1]]]
        return np.einsum("ksa,sax->ksx", table, mdp.transitions), (table * mdp.rewards).sum(-1)

    discount, terminal = float(mdp.discount), np.asarray(mdp.terminal)
    if steps is None:
        transitions, rewards = chain(0)
        ends = can_end(transitions, terminal).all(-1) if discount == 1 else np.ones(len(actions), bool)
        system = np.eye(mdp.num_states) - discount * transitions[ends] * ~terminal
        returns = np.full(len(actions), -np.inf)
        returns[ends] = np.linalg.solve(system, rewards[ends][..., None])[..., 0] @ mdp.initial
        return returns
    value = np.zeros((len(actions), mdp.num_states))
    for t in reversed(range(steps)):
        transitions, rewards = chain(t)
        value = rewards + discount * (transitions @ value[..., None])[..., 0]
    return value @ mdp.initial
