r"""The Bellman error, and what the loss of fitted Q-iteration is in its place (notes, section 5.3.3; erratum E5.7).

$$\mathcal E = \tfrac12\, \mathbb{E}_{(s, a) \sim \beta} \big( Q(s, a) - r - \gamma\, \mathbb{E}_{s'} \max_{a'} Q(s', a') \big)^2$$

has an expectation *inside* the square. The mean of squared TD errors over samples has it outside and is larger by

$$\tfrac12\, \gamma^2\, \mathbb{E}_\beta\, \mathrm{Var}_{s'} \big[\max_{a'} Q(s', a')\big],$$

so that it is not 0 at $Q^\star$, and who minimises it through the target finds another Q. With two independent next states for one
$(s, a)$, the product of their two errors is unbiased. An error of 0 makes the greedy policy optimal only where $\beta$ covers what that
policy can meet: all pairs, to be safe (item 5.17).
"""

import numpy as np
from jaxtyping import Float, Int

from .operators import Problem, q_backup, stepwise


def bellman_error(problem: Problem, q: Float[np.ndarray, "S A"], beta: Float[np.ndarray, "S A"]) -> float:
    """½ E_β (Q - BQ)², exactly."""
    return float(0.5 * np.sum(beta * np.square(q - q_backup(problem, q.max(-1)))))


def squared_td_error(problem: Problem, q: Float[np.ndarray, "S A"], beta: Float[np.ndarray, "S A"]) -> float:
    """½ E of the squared TD error of a sample, exactly: the Bellman error and the variance of the target."""
    return bellman_error(problem, q, beta) + target_variance(problem, q, beta)


def target_variance(problem: Problem, q: Float[np.ndarray, "S A"], beta: Float[np.ndarray, "S A"]) -> float:
    """½ γ² E_β Var[max_a' Q(s', a')]: what the mean over samples has too much. Rewards of r(s, a) add nothing to it."""
    gamma, ahead, value = float(problem.discount), stepwise(problem), q.max(-1)
    if gamma == 0:
        return 0.0
    # What ends has the value 0, and its probability is what the weights lack.
    there = value[None, None] if ahead.successors is None else value[ahead.successors]
    mean = (ahead.weights / gamma * there).sum(-1)
    square = (ahead.weights / gamma * there**2).sum(-1)
    return float(0.5 * gamma**2 * np.sum(beta * (square - mean**2)))


def double_sample_error(
    q_taken: Float[np.ndarray, "N"],
    rewards: Float[np.ndarray, "N"],
    discounts: Float[np.ndarray, "N"],
    first_next: Float[np.ndarray, "N A"],
    second_next: Float[np.ndarray, "N A"],
) -> Float[np.ndarray, "N"]:
    """½ δ δ' of each sample, with Q at two independent next states: its mean is the Bellman error (item 5.16)."""
    error, other = (q_taken - rewards - discounts * q.max(-1) for q in (first_next, second_next))
    return 0.5 * error * other


def greedy_support(problem: Problem, actions: Int[np.ndarray, "S"], start: Float[np.ndarray, "S"]) -> np.ndarray:
    """The pairs that a deterministic policy meets from a start distribution, `[S, A]` flags: what β must cover at least."""
    ahead, here = stepwise(problem), np.asarray(start) > 0
    while True:
        weights = np.take_along_axis(ahead.weights, actions[:, None, None], 1)[:, 0] > 0
        reached = here.copy()
        if ahead.successors is None:
            reached |= weights[here].any(0)
        else:
            to = np.take_along_axis(ahead.successors, actions[:, None, None], 1)[:, 0]
            reached[to[here][weights[here]]] = True
        if np.array_equal(reached, here):
            return here[:, None] & (np.arange(problem.num_actions) == actions[:, None])
        here = reached
