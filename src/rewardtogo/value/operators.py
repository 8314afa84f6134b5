r"""The Bellman operators of a known decision process, as functions and as arrays that are ready for a loop.

$$(BV)(s) = \max_a \Big( r(s, a) + \gamma \sum_{s'} p(s' \mid s, a)\, V(s') \Big), \qquad
(B^\pi V)(s) = \sum_a \pi(a \mid s) \Big( r(s, a) + \gamma \sum_{s'} p(s' \mid s, a)\, V(s') \Big).$$

With vectors and matrices $BV = \max_a (r_a + \gamma T_a V)$, $T_{a, i, j} = p(s' = j \mid s = i, a)$: *rows* are where one is. The notes
print $p(s' = i \mid s = j, a)$ (erratum E5.8), with which values flow backwards and value iteration diverges. For $\gamma < 1$ both are
contractions,

$$\Vert BV - BV' \Vert_\infty \le \gamma\, \Vert V - V' \Vert_\infty,$$

where the notes leave out the $\gamma$ (erratum E5.9); equality holds for $V' = V + c$. Terminal states, and outcomes that end the
episode, have no value after them (erratum E1.5).

Source: notes, sections 5.2.2 and 5.4.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from ..envs.sparse import SparseMDP, before, sparse_of
from ..envs.tabular import MDP

Problem = MDP | SparseMDP
Vector = Float[Array | np.ndarray, "S"]


class Lookahead(eqx.Module):
    """One step ahead: Q(s, a) = r(s, a) + Σ_k weights[s, a, k] V(successors[s, a, k]), where γ and ends are in the weights.

    Without `successors`, k counts all states. NumPy arrays or JAX arrays, as they come; any subset of the states (`rows`).
    """

    rewards: Float[Array | np.ndarray, "S A"]
    weights: Float[Array | np.ndarray, "S A K"]
    successors: Int[Array | np.ndarray, "S A K"] | None

    def q(self, value: Any) -> Any:
        """Q `[S, A]` of the values `[X]` of what comes next, in their kind of array."""
        if self.successors is None:
            return self.rewards + self.weights @ value
        return self.rewards + (self.weights * value[self.successors]).sum(-1)

    def best(self, value: Any) -> Any:
        """B V `[S]`, of the states that are here."""
        return self.q(value).max(-1)

    def rows(self, states: Int[Array, "N"] | Int[Array, ""] | slice) -> "Lookahead":
        """The same for some states only."""
        successors = None if self.successors is None else self.successors[states]
        return Lookahead(self.rewards[states], self.weights[states], successors)


def lookahead(problem: Problem) -> Lookahead:
    """The arrays of a process for dynamic programming, in float64. Raises `ValueError` where it has a finite horizon."""
    if isinstance(problem, MDP) and problem.horizon is not None:
        raise ValueError(
            f"the problem ends after {problem.horizon} actions, so that its values depend on the time: use backward_induction"
        )
    return stepwise(problem)


def stepwise(problem: Problem) -> Lookahead:
    """As `lookahead`, whatever the horizon."""
    weights = float(problem.discount) * np.asarray(problem.continuation, np.float64)
    successors = problem.successors if isinstance(problem, SparseMDP) else None
    return Lookahead(np.asarray(problem.rewards, np.float64), weights, successors)


def under_policy(ahead: Lookahead, policy: Float[np.ndarray, "S A"] | Int[np.ndarray, "S"]) -> Lookahead:
    """The process that a policy makes of it, as one with a single action: probabilities `[S, A]`, or an action for each state."""
    policy = np.asarray(policy)
    if policy.ndim == 1:
        pick = lambda x: np.take_along_axis(x, policy.reshape(-1, *[1] * (x.ndim - 1)), 1)  # noqa: E731
        successors = None if ahead.successors is None else pick(ahead.successors)
        return Lookahead(pick(ahead.rewards), pick(ahead.weights), successors)
    rewards = (policy * ahead.rewards).sum(-1, keepdims=True)
    weights = policy[..., None] * ahead.weights
    if ahead.successors is None:
        return Lookahead(rewards, weights.sum(1, keepdims=True), None)
    flat = (len(policy), 1, -1)
    return Lookahead(rewards, weights.reshape(flat), ahead.successors.reshape(flat))


def q_backup(problem: Problem, value: Vector) -> Float[np.ndarray, "S A"]:
    """r(s, a) + γ E[V(s')], first line of Algorithm 7. In §5.2.2 the notes call it A; it is Q (erratum E5.3), A is Q - V."""
    return np.asarray(stepwise(problem).q(np.asarray(value, np.float64)))


def bellman_backup(problem: Problem, value: Vector) -> Float[np.ndarray, "S"]:
    """B V = max_a (r_a + γ T_a V), the optimality operator (item 5.21)."""
    return q_backup(problem, value).max(-1)


def evaluation_backup(problem: Problem, policy: Float[np.ndarray, "S A"], value: Vector) -> Float[np.ndarray, "S"]:
    """B^π V = E_{a ~ π}[r + γ E V(s')] (item 5.4)."""
    return (np.asarray(policy) * q_backup(problem, value)).sum(-1)


def deterministic_backup(problem: Problem, actions: Int[np.ndarray, "S"], value: Vector) -> Float[np.ndarray, "S"]:
    """r(s, π(s)) + γ E V(s') of a deterministic policy (item 5.5)."""
    return np.take_along_axis(q_backup(problem, value), np.asarray(actions)[:, None], 1)[:, 0]


def bellman_residual(problem: Problem, value: Vector) -> float:
    """||B V - V||_∞; V is within 1 / (1 - γ) of it of V*."""
    return float(np.abs(bellman_backup(problem, value) - value).max())


def greedy_actions(problem: Problem, q: Float[np.ndarray, "S A"]) -> Int[np.ndarray, "S"]:
    """argmax_a Q(s, a), the first of equals; with discount 1 one that leads to an end, which not every greedy policy does.

    Where a goal pays 1 whenever it is reached, going round in circles before it has the same Q.
    """
    actions = q.argmax(-1)
    if problem.discount < 1:
        return actions
    sparse = problem if isinstance(problem, SparseMDP) else sparse_of(problem)
    best = q >= q.max(-1, keepdims=True) - 1e-9 * max(1.0, float(np.abs(q).max()))
    possible = (sparse.probabilities > 0) & best[..., None]
    ending = (possible & sparse.ends).any(-1)
    done, lists = sparse.terminal.copy(), sparse.predecessors()
    front = np.flatnonzero(ending.any(-1) & ~done)
    actions[front] = ending[front].argmax(-1)
    while len(front):
        done[front] = True
        near = before(lists, front)
        near = near[~done[near]]
        nearer = (possible[near] & ~sparse.ends[near] & done[sparse.successors[near]]).any(-1)
        front = near[nearer.any(-1)]
        actions[front] = nearer[nearer.any(-1)].argmax(-1)
    return actions


# --- norms, contractions, projections --------------------------------------------------------------------------------


def sup_norm(x: Float[np.ndarray, "*N"]) -> float:
    """The largest absolute value."""
    return float(np.abs(x).max())


def weighted_norm(x: Float[np.ndarray, "N"], weights: Float[np.ndarray, "N"]) -> float:
    """(Σ_s d(s) x(s)^2)^(1/2): the L2 norm that states count in as often as d says."""
    return float(np.sqrt(np.sum(weights * np.square(x))))


def contraction_ratio(
    operator: Callable[[np.ndarray], np.ndarray],
    one: Float[np.ndarray, "*N"],
    other: Float[np.ndarray, "*N"],
    norm: Callable[[np.ndarray], float] = sup_norm,
) -> float:
    """||F x - F y|| / ||x - y||: a contraction's is below 1 for every pair (item 5.23). Raises `ValueError` for two equal points."""
    apart = norm(np.asarray(one) - np.asarray(other))
    if apart == 0:
        raise ValueError("the two points are the same, so there is no distance to contract: give two different ones")
    return norm(operator(np.asarray(one)) - operator(np.asarray(other))) / apart


def projection(
    features: Float[np.ndarray, "S F"], weights: Float[np.ndarray, "S"] | None = None
) -> Float[np.ndarray, "S S"]:
    r"""$\Pi = \Phi (\Phi^T D \Phi)^{-1} \Phi^T D$: the nearest that the features can say, in the norm of D = diag(weights) (item 5.25).

    A *non-expansion* in that norm, not a contraction (erratum E5.10), and in the sup norm not even that. Dependent features are allowed.
    Raises `ValueError` for weights that are negative or all 0.
    """
    features = np.asarray(features, np.float64)
    weights = np.ones(len(features)) if weights is None else np.asarray(weights, np.float64)
    if weights.shape != features.shape[:1] or not (np.all(weights >= 0) and weights.any()):
        raise ValueError(
            f"the weights of a projection must be one number of at least 0 for each of {len(features)} states, and not all 0"
        )
    root = np.sqrt(weights)
    # The pseudo-inverse of the scaled features: no normal equations, so that it is idempotent to rounding.
    return features @ np.linalg.pinv(root[:, None] * features) * root


def projected_backup(
    problem: Problem, features: Float[np.ndarray, "S F"], weights: Float[np.ndarray, "S"] | None = None
) -> Callable[[np.ndarray], np.ndarray]:
    """V -> Π B V, fitted value iteration with linear features: in general a contraction in no norm (item 5.27)."""
    matrix = projection(features, weights)
    return lambda value: matrix @ bellman_backup(problem, value)


def projected_q_backup(
    problem: Problem, features: Float[np.ndarray, "N F"], weights: Float[np.ndarray, "N"] | None = None
) -> Callable[[np.ndarray], np.ndarray]:
    """Q -> Π B Q on tables `[S, A]`, fitted Q-iteration (item 5.30). Features and weights are of pairs, S A rows in that order."""
    matrix = projection(features, weights)
    return lambda q: (matrix @ q_backup(problem, q.max(-1)).ravel()).reshape(q.shape)
