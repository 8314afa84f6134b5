"""Values as targets: Q out of V, advantages, n-step returns with their exact bias and variance, rollouts from a state.

    Q(s, a) = r(s, a) + γ Σ_s' P(s' | s, a) V(s'),      A(s, a) = Q(s, a) - V(s),      V(terminal) = 0

    G^(n)_t = Σ_{k < n} γ^k r_{t+k} + γ^n V(s_{t+n}):      E[G^(n) | s, a] - Q^π(s, a) = γ^n E[V(s_{t+n}) - V^π(s_{t+n})]

The first is an equation between expectations; with one sampled s' in place of the sum it is an unbiased estimate and
no equality (erratum E4.2). An n-step return has n rewards (erratum E4.9).

Source: notes, sections 4.2, 4.3, 4.4.2 and 4.9.
"""

import gymnasium.spaces as spaces
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..core import Action, Environment, Observation, Policy, PRNGKey, State, Timestep
from ..envs.tabular import MDP
from .dynamic_programming import horizon_of, q_values, v_values
from .estimators import Moments
from .monte_carlo import Estimate, monte_carlo_return
from .policies import check_policy


def q_from_v(mdp: MDP, values: Float[Array | np.ndarray, "... S"]) -> Float[np.ndarray, "... S A"]:
    """Q = r + γ P V (item 4.5), whatever V says of terminal states. Values `[T + 1, S]` over time give Q `[T, S, A]`."""
    table = np.asarray(values, np.float64)
    ahead = table if table.ndim == 1 else table[1:]
    expected = np.einsum("sax,...x->...sa", np.asarray(mdp.continuation, np.float64), ahead)
    return np.asarray(mdp.rewards, np.float64) + float(mdp.discount) * expected


def advantage_values(
    mdp: MDP, policy: Float[Array | np.ndarray, "... S A"], horizon: int | None = None
) -> Float[np.ndarray, "... S A"]:
    """A^π = Q^π - V^π (item 4.4), `[T, S, A]` with a horizon and the discounted `[S, A]` without."""
    steps = horizon_of(mdp, horizon)
    values = v_values(mdp, policy, steps)
    return q_values(mdp, policy, steps) - (values if steps is None else values[:-1])[..., None]


def n_step_return_moments(
    mdp: MDP,
    policy: Float[Array | np.ndarray, "S A"],
    values: Float[Array | np.ndarray, "S"],
    n: int,
) -> Moments:
    """Mean and variance of G^(n), given s_t = s and a_t = a, as an estimate of the discounted Q^π(s, a) (item 4.31).

    Its bias is the mean less `q_values(mdp, policy)`. Shorter where a terminal state comes first. Horizons have no part
    in it. Raises `ValueError` for n below 1.
    """
    if n < 1:
        raise ValueError(f"a return of {n} steps has no reward in it: give n of at least 1")
    table, discount = check_policy(mdp, policy, None), float(mdp.discount)
    transitions = np.asarray(mdp.transitions, np.float64)
    given = np.asarray(mdp.rewards, np.float64)[..., None] if mdp.outcome_rewards is None else mdp.outcome_rewards
    live = ~np.asarray(mdp.terminal)
    mean = np.where(live, np.asarray(values, np.float64), 0.0)
    square, action_mean, action_square = mean**2, np.zeros(table.shape), np.zeros(table.shape)
    for _ in range(n):
        action_mean = (transitions * (given + discount * mean)).sum(-1)
        action_square = (transitions * (given**2 + 2 * discount * given * mean + discount**2 * square)).sum(-1)
        mean, square = (table * action_mean).sum(-1), (table * action_square).sum(-1)
    return Moments(action_mean, np.maximum(action_square - action_mean**2, 0.0))


class ResumeAt(Environment):
    """An environment whose every episode starts in one saved state: a simulator that can be set back (notes, 4.4.2)."""

    env: Environment
    state: State
    observation: PyTree[Array]

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        return self.state, self.observation

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        return self.env.step(state, action, key)


def rollout_value(
    env: Environment,
    state: State,
    observation: PyTree[Array],
    policy: Policy,
    key: PRNGKey,
    num_rollouts: int,
    horizon: int,
    discount: float = 1.0,
) -> Estimate:
    """V(s) as the mean return of rollouts that all start from a saved `state`, where `observation` is seen (item 4.10).

    One rollout is the Monte-Carlo value of item 4.9; N of them have 1/N of its variance. The policy starts without a
    memory. The standard error of a single rollout is not a number.
    """
    return monte_carlo_return(ResumeAt(env, state, observation), policy, key, num_rollouts, horizon, discount)
