"""Values by dynamic programming: V^π, Q^π, J and the optimum, in float64.

Finite horizon (values depend on time; erratum E1.2):

    V_T = 0,   Q_t(s, a) = r(s, a) + γ Σ_s' P(s' | s, a) V_{t+1}(s'),   V_t(s) = E_{a ~ π_t}[Q_t(s, a)].

Discounted, with no horizon:  V = (I - γ P_π)^{-1} r_π,  Q = r + γ P V,  where P leaves out the terminal states.
V = E_a[Q] is the law of total expectation, and J = E_{s_0 ~ p_0}[V(s_0)] is an expectation, not a sum (erratum E1.3).

Source: notes, section 1.2.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Array, Float, Int

from ..envs.tabular import MDP, can_end
from .policies import check_policy, greedy_policy


def horizon_of(mdp: MDP, horizon: int | None) -> int | None:
    """The horizon asked for, or else the problem's own.

    Raises `ValueError` for one that is not a positive number of actions.
    """
    if horizon is not None and horizon < 1:
        raise ValueError(f"the horizon is {horizon} and must be a number of actions, at least 1")
    return mdp.horizon if horizon is None else horizon


def induced_chain(
    mdp: MDP, policy: Float[Array | np.ndarray, "S A"]
) -> tuple[Float[np.ndarray, "S S"], Float[np.ndarray, "S"]]:
    """P_π(s' | s) = Σ_a π(a | s) P(s' | s, a) and r_π(s) = Σ_a π(a | s) r(s, a): the Markov chain a policy makes."""
    table = check_policy(mdp, policy, None)
    return np.einsum("sa,sax->sx", table, mdp.transitions), (table * mdp.rewards).sum(-1)


def discounted_system(mdp: MDP, policy: Float[np.ndarray, "S A"]) -> Float[np.ndarray, "S S"]:
    """I - γ P_π without the terminal states: the matrix of every discounted sum.

    Raises `ValueError` where the sums diverge: discount 1, and a state from which the policy never ends.
    """
    chain, _ = induced_chain(mdp, policy)
    stuck = np.flatnonzero(~can_end(chain, mdp.terminal))
    if mdp.discount == 1 and len(stuck):
        raise ValueError(
            f"with discount 1 this policy has no value: from state {stuck[0]} it never reaches a terminal state; "
            "lower the discount or give a horizon"
        )
    return np.eye(mdp.num_states) - float(mdp.discount) * chain * ~np.asarray(mdp.terminal)


def q_values(
    mdp: MDP, policy: Float[Array | np.ndarray, "... S A"], horizon: int | None = None
) -> Float[np.ndarray, "... S A"]:
    """Q^π (item 1.19): `[T, S, A]` with a horizon (its own or the problem's), else the discounted `[S, A]`."""
    steps = horizon_of(mdp, horizon)
    table = check_policy(mdp, policy, steps)
    rewards, discount = np.asarray(mdp.rewards, np.float64), float(mdp.discount)
    if steps is None:
        value = np.linalg.solve(discounted_system(mdp, table), (table * rewards).sum(-1))
        return rewards + discount * mdp.continuation @ value
    q = np.empty((steps, mdp.num_states, mdp.num_actions))
    value = np.zeros(mdp.num_states)
    for t in reversed(range(steps)):
        q[t] = rewards + discount * mdp.transitions @ value
        value = (table[t] * q[t]).sum(-1)
    return q


def v_values(
    mdp: MDP, policy: Float[Array | np.ndarray, "... S A"], horizon: int | None = None
) -> Float[np.ndarray, "... S"]:
    """V^π (item 1.20): `[T + 1, S]` with a horizon, the last row 0, else the discounted `[S]`."""
    steps = horizon_of(mdp, horizon)
    if steps is None:
        table = check_policy(mdp, policy, None)
        return np.linalg.solve(discounted_system(mdp, table), (table * mdp.rewards).sum(-1))
    value = (check_policy(mdp, policy, steps) * q_values(mdp, policy, steps)).sum(-1)
    return np.concatenate([value, np.zeros((1, mdp.num_states))])


def expected_return(mdp: MDP, policy: Float[Array | np.ndarray, "... S A"], horizon: int | None = None) -> float:
    """J(π) = E[Σ_t γ^t r_t] = E_{s_0 ~ p_0}[V_0(s_0)], by dynamic programming (item 1.15)."""
    value = v_values(mdp, policy, horizon)
    return float(mdp.initial @ (value if value.ndim == 1 else value[0]))


def optimal_q_values(mdp: MDP, horizon: int | None = None) -> Float[np.ndarray, "... S A"]:
    """Q*: by backward induction `[T, S, A]`, or without a horizon by exact policy iteration `[S, A]`.

    Raises `ValueError` where discount 1 and a loop that pays for ever leave nothing optimal.
    """
    steps = horizon_of(mdp, horizon)
    if steps is None:
        return q_values(mdp, _policy_iteration(mdp))
    q = np.empty((steps, mdp.num_states, mdp.num_actions))
    value = np.zeros(mdp.num_states)
    for t in reversed(range(steps)):
        q[t] = mdp.rewards + float(mdp.discount) * mdp.transitions @ value
        value = q[t].max(-1)
    return q


def optimal_policy(mdp: MDP, horizon: int | None = None) -> Float[np.ndarray, "... S A"]:
    """A deterministic optimal policy as a table; with discount 1 one that ends, which not every greedy one does."""
    return _policy_iteration(mdp) if horizon_of(mdp, horizon) is None else greedy_policy(optimal_q_values(mdp, horizon))


def _policy_iteration(mdp: MDP) -> Float[np.ndarray, "S A"]:
    start = first_actions(mdp)
    return np.eye(mdp.num_actions)[improve_until_stable(lambda a: q_values(mdp, np.eye(mdp.num_actions)[a]), start)[0]]


def improve_until_stable(
    evaluate: Callable[[Int[np.ndarray, "S"]], Float[np.ndarray, "S A"]],
    actions: Int[np.ndarray, "S"],
    tolerance: float = 1e-13,
) -> tuple[Int[np.ndarray, "S"], list[Float[np.ndarray, "S"]]]:
    """Policy iteration that changes an action only for a real gain: the last policy, and the values of each one on the way.

    - `evaluate`: Q^π of a deterministic policy.
    - `tolerance`: what counts as a gain, relative to the largest |Q|.

    With discount 1 that matters: from a policy that ends it then leads to policies that end, unless some loop has a
    positive reward. The sum of the values rises strictly, so rounding cannot make it go in circles.
    """
    states, total, path = np.arange(len(actions)), -np.inf, []
    best = actions
    while True:
        q = evaluate(actions)
        held = q[states, actions]
        if held.sum() <= total:
            return best, path
        path.append(held)
        total, best = held.sum(), actions
        actions = np.where(q.max(-1) > held + tolerance * np.abs(q).max(initial=1.0), q.argmax(-1), actions)


def first_actions(mdp: MDP) -> Int[np.ndarray, "S"]:
    """A policy to begin policy iteration with, which has a value: greedy for rewards, or one that ends where the discount is 1."""
    return _ending_actions(mdp) if mdp.discount == 1 else np.asarray(mdp.rewards).argmax(-1)


def _ending_actions(mdp: MDP) -> np.ndarray:
    """In each state an action that may lead one step closer to a terminal state."""
    ends, actions = np.array(mdp.terminal), np.zeros(mdp.num_states, int)
    while not ends.all():
        nearer = (np.asarray(mdp.transitions) * ends).sum(-1)
        new = ~ends & (nearer > 0).any(-1)
        actions[new] = nearer[new].argmax(-1)
        ends |= new
    return actions
