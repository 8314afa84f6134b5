"""J(θ), its exact gradient and the Fisher matrix of a softmax policy, by dynamic programming.

    ∇J = Σ_t γ^t Σ_s d_t(s) Σ_a ∇π(a | s) Q_t(s, a)          "option_2", the gradient of the discounted J (item 4.19)
         Σ_t     Σ_s d_t(s) Σ_a ∇π(a | s) Q_t(s, a)          "option_1", what is used in practice (item 4.18)

Option 1 discounts rewards but not states. It is not the gradient of the discounted J, and in general of no function at
all (erratum E4.6; Thomas 2014, Nota and Thomas 2020). Without a discount they are one.

    F = E_{s, a ~ π}[∇ log π ∇ log π^T],      KL(π_θ || π_{θ+d}) ≈ ½ d^T F d      (erratum E3.12)

Source: notes, sections 3.1, 3.9.1 and 4.6; Sutton et al. 2000, Policy Gradient Methods for Reinforcement Learning.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core import PRNGKey
from ..envs.tabular import MDP, POMDP, TabularEnv, can_end
from .chains import state_distributions
from .dynamic_programming import discounted_system, expected_return, horizon_of, induced_chain, q_values
from .enumeration import enumerated_return
from .monte_carlo import monte_carlo_return
from .observed import shared_rows
from .policies import TablePolicy, check_policy
from .softmax import expected_scores, score_table, softmax_policy

Discounting = Literal["option_1", "option_2"]


class PolicyReturn(eqx.Module):
    """J(θ), and its standard error: 0 where it was computed and not sampled."""

    value: float
    standard_error: float


def policy_return(
    problem: MDP | POMDP,
    logits: Float[Array | np.ndarray, "... O A"],
    horizon: int | None = None,
    *,
    method: Literal["dynamic_programming", "enumeration", "monte_carlo"] = "dynamic_programming",
    num_episodes: int = 10_000,
    key: PRNGKey | None = None,
) -> PolicyReturn:
    """J(θ) = E[Σ_t γ^t r_t] of a softmax policy, in one of three ways (item 3.1).

    Raises `ValueError` for sampling without a key or a horizon, and for enumeration without a horizon.
    """
    mdp, rows = shared_rows(problem)
    policy = softmax_policy(logits)
    if method == "dynamic_programming":
        return PolicyReturn(expected_return(mdp, policy[..., rows, :], horizon), 0.0)
    if method == "enumeration":
        return PolicyReturn(enumerated_return(mdp, policy[..., rows, :], horizon), 0.0)
    steps = horizon_of(mdp, horizon)
    if key is None or steps is None:
        raise ValueError(
            f"sampling episodes needs a key and a horizon to stop at, and got {key} and {steps}: give both"
        )
    table = TablePolicy(jnp.asarray(policy, jnp.float32))
    found = monte_carlo_return(TabularEnv(problem), table, key, num_episodes, steps, float(mdp.discount))
    return PolicyReturn(float(found.mean), float(found.standard_error))


def state_visits(
    mdp: MDP,
    policy: Float[Array | np.ndarray, "... S A"],
    horizon: int | None = None,
    discounting: Discounting = "option_2",
) -> Float[np.ndarray, "... S"]:
    """How often actions are taken in each state: w_t d_t(s) `[T, S]`, or summed over all times `[S]` without a horizon.

    w_t is γ^t ("option_2") or 1 ("option_1"); terminal states count 0. Raises `ValueError` where the sum diverges.
    """
    steps = horizon_of(mdp, horizon)
    live = ~np.asarray(mdp.terminal)
    if steps is not None:
        factor = float(mdp.discount) if discounting == "option_2" else 1.0
        return factor ** np.arange(steps)[:, None] * state_distributions(mdp, policy, steps)[:-1] * live
    table = check_policy(mdp, policy, None)
    if discounting == "option_1":
        stuck = np.flatnonzero(~can_end(induced_chain(mdp, table)[0], mdp.terminal))
        if len(stuck):
            raise ValueError(
                f"undiscounted visits have no finite sum, because from state {stuck[0]} this policy never reaches a "
                'terminal state: give a horizon or use "option_2"'
            )
        mdp = eqx.tree_at(lambda m: m.discount, mdp, np.asarray(1.0))
    return np.linalg.solve(discounted_system(mdp, table).T, np.asarray(mdp.initial, np.float64)) * live


def expected_gradient(
    logits: Float[Array | np.ndarray, "... S A"],
    visits: Float[Array | np.ndarray, "... S"],
    values: Float[Array | np.ndarray, "... S A"],
) -> Float[np.ndarray, "... S A"]:
    """Σ_t Σ_s visits_t(s) Σ_a ∇π(a | s) values_t(s, a): what every estimator of the policy gradient aims at.

    With the policy's own visits and Q it is ∇J. With another's visits, or another's Q, it is what importance weights
    that leave something out estimate (items 3.34 to 3.36). Logits that vary with time need both with a time axis.
    """
    theta = np.asarray(logits, np.float64)
    each = np.asarray(visits, np.float64)[..., None] * expected_scores(theta, values)
    return each.sum(tuple(range(each.ndim - theta.ndim)))


def policy_gradient(
    problem: MDP | POMDP,
    logits: Float[Array | np.ndarray, "... O A"],
    horizon: int | None = None,
    discounting: Discounting = "option_2",
) -> Float[np.ndarray, "... O A"]:
    """∇_θ J(θ) (item 3.3), or with "option_1" the direction that is used in its place (item 4.18).

    Of a `POMDP` the logits are those of a policy of the observation, `[Z, A]` (item 3.13).
    """
    mdp, rows = shared_rows(problem)
    theta = np.asarray(logits, np.float64)
    shared = theta[..., rows, :]
    policy = softmax_policy(shared)
    visits = state_visits(mdp, policy, horizon, discounting)
    each = expected_gradient(shared, visits, q_values(mdp, policy, horizon))
    gradient = np.zeros_like(theta)
    np.add.at(np.moveaxis(gradient, -2, 0), rows, np.moveaxis(each, -2, 0))
    return gradient


def fisher_matrix(
    problem: MDP | POMDP,
    logits: Float[Array | np.ndarray, "O A"],
    horizon: int | None = None,
    discounting: Discounting = "option_2",
) -> Float[np.ndarray, "P P"]:
    """F = E[∇ log π ∇ log π^T] over the steps that the policy takes, `[O A, O A]` (item 3.40).

    Steps are weighted as `state_visits` and the weights divided by their sum: F is the second derivative of the mean
    KL(π_θ(· | s) || π_θ'(· | s)) over states. Times the number of steps, T, it is with "option_1" and episodes that do
    not end early the Fisher matrix of whole trajectories. Logits that vary with time are not taken.
    """
    mdp, rows = shared_rows(problem)
    theta = np.asarray(logits, np.float64)
    policy, size = softmax_policy(theta), theta.size
    visits = state_visits(mdp, policy[rows], horizon, discounting).reshape(-1, mdp.num_states).sum(0)
    share = np.bincount(rows, visits, len(theta)) / visits.sum()
    blocks = np.einsum("o,oa,oab,oac->obc", share, policy, score_table(theta), score_table(theta))
    matrix = np.zeros((len(theta), theta.shape[1], len(theta), theta.shape[1]))
    every = np.arange(len(theta))
    matrix[every, :, every, :] = blocks
    return matrix.reshape(size, size)
