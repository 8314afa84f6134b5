"""Targets of several steps from another policy's actions: every sequence of a small problem, weighted by its probability, in float64."""

import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithms_under_test import jit
from rewardtogo.core import Transition
from rewardtogo.data.n_step import DISCOUNT, IMPORTANCE, n_step
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import optimal_q_values, q_values
from rewardtogo.ops import n_step_transition, retrace, trace_coefficients
from rewardtogo.value.targets import corrections

S, A, N, GAMMA = 3, 2, 3, 0.9
MDP = random_mdp(4, S, A, discount=GAMMA)
PI, MU = random_policy(1, S, A), random_policy(2, S, A)
Q_PI, Q_STAR = q_values(MDP, PI), optimal_q_values(MDP)
PATHS = np.array(list(itertools.product(*[range(S), range(A)] * N, range(S)))).T
STATES, ACTIONS = PATHS[0::2], PATHS[1::2]
"""All sequences of N steps: states `[N + 1, K]` and actions `[N, K]`."""
TRACES = ("retrace", "tree_backup", "importance")


@pytest.fixture(scope="module", autouse=True)
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def probabilities(mu: np.ndarray) -> np.ndarray:
    """Of each sequence, given its first state and action."""
    p = np.prod(np.asarray(MDP.transitions)[STATES[:-1], ACTIONS, STATES[1:]], axis=0)
    return p * np.prod(mu[STATES[1:-1], ACTIONS[1:]], axis=0)


def steps(mu: np.ndarray) -> Transition:
    never = jnp.zeros(ACTIONS.shape, bool)
    reward = jnp.asarray(MDP.rewards)[STATES[:-1], ACTIONS]
    log_prob = jnp.log(jnp.asarray(mu)[STATES[:-1], ACTIONS])
    here, ahead = jnp.asarray(STATES[:-1]), jnp.asarray(STATES[1:])
    return Transition(here, jnp.asarray(ACTIONS), reward, never, never, ahead, {"log_prob": log_prob})


def average(y: jax.Array, mu: np.ndarray) -> jax.Array:
    """The expected target of each state and action."""
    p = jnp.asarray(probabilities(mu))
    return jnp.zeros((S, A), y.dtype).at[STATES[0], ACTIONS[0]].add(p * y)


def corrected(kind: Any, q: jax.Array) -> jax.Array:
    """What N-step targets of Q-learning make of Q on average, from the actions of MU."""
    t = steps(MU)
    stop, ratio = corrections(kind, q[t.observation], t.observation, t)
    t = n_step(t, GAMMA, stop, ratio)
    y = t.reward + t.extras[DISCOUNT] * q[t.next_observation].max(-1)
    if kind != "importance":
        return average(y, MU)
    weight = t.extras[IMPORTANCE]
    # An error weighted by w is nought on average at E[w y] / E[w].
    return average(weight * y, MU) / average(weight, MU)


def uncorrected(mu: np.ndarray, q: jax.Array) -> jax.Array:
    """N rewards of mu, then the value of PI."""
    t = steps(mu)
    discount = jnp.full(t.reward.shape, GAMMA)
    total, product, last = jax.vmap(n_step_transition, 1)(t.reward, discount, t.done)
    v = (jnp.asarray(PI) * q).sum(-1)
    return average(total + product * v[t.next_observation[last, jnp.arange(len(last))]], mu)


def with_traces(kind: Any, q: jax.Array, decay: float = 1.0) -> jax.Array:
    t, pi = steps(MU), jnp.asarray(PI)
    trace = trace_coefficients(kind, decay, pi[t.observation, t.action], jnp.exp(t.extras["log_prob"]))
    v, discount = (pi * q).sum(-1)[t.next_observation], jnp.full(t.reward.shape, GAMMA)
    y = jax.vmap(retrace, 1, 1)(t.reward, discount, q[t.observation, t.action], v, trace, t.done)
    return average(y[0], MU)


def fixed_point(operator: Any, *given: Any) -> np.ndarray:
    body = lambda _, q: operator(*given, q)  # noqa: E731
    return np.asarray(jit(lambda q: jax.lax.fori_loop(0, 300, body, q))(jnp.zeros((S, A))))


def gap(a: Any, b: Any) -> float:
    return float(np.abs(np.asarray(a) - np.asarray(b)).max())


def test_corrections_lead_to_the_optimum(item):
    with item("6.18") as check:
        check(
            gap(fixed_point(corrected, "adaptive"), Q_STAR), "<=", 1e-10, "stopping before actions that are not greedy"
        )
        check(gap(fixed_point(corrected, "importance"), Q_STAR), "<=", 1e-10, "weighting by pi / mu")
        check(gap(fixed_point(corrected, "none"), Q_STAR), ">", 0.1, "ignoring the mismatch")


def test_n_steps_are_of_the_policy_that_acted(item):
    """E6.5: N = 1 or mu = pi is right, anything else is not."""
    with item("6.17") as check:
        check(gap(fixed_point(uncorrected, MU), Q_PI), ">", 0.1, "3-step fixed point off-policy, distance from Q^pi")
        check(gap(fixed_point(uncorrected, PI), Q_PI), "<=", 1e-10, "on-policy")


@pytest.mark.parametrize("kind", TRACES)
def test_traces_lead_to_the_value_of_their_policy(kind, item):
    def both(q: jax.Array, other: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        found = jax.lax.fori_loop(0, 300, lambda _, q: with_traces(kind, q, 0.9), q)
        return found, with_traces(kind, q), with_traces(kind, other)

    rng = np.random.default_rng(0)
    pairs = jnp.asarray(rng.normal(size=(20, 2, S, A)))
    found, one, other = jit(jax.vmap(both))(pairs[:, 0], pairs[:, 1])
    size = lambda x: np.abs(np.asarray(x)).max((1, 2))  # noqa: E731
    with item("6.19") as check:
        check(gap(found, np.broadcast_to(Q_PI, found.shape)), "<=", 1e-10, f"{kind}: fixed point Q^pi")
        shrinks = (size(one - other) / size(pairs[:, 0] - pairs[:, 1])).max()
        check(shrinks, "<=", GAMMA, f"{kind}: contraction")


def test_n_step_return_by_hand(item):
    """E6.4: reward 1 for ever is worth 10; as printed, gamma^(t - t'), 12.15."""
    ones, never = jnp.ones(5), jnp.zeros(5, bool)
    total, product, _ = n_step_transition(ones, 0.9 * ones, never)
    printed = sum(0.9**-k for k in range(5)) + 0.9**5 * 10
    with item("6.16") as check:
        check(abs(float(total + product * 10) - 10), "<=", 1e-12, "five steps of a loop of reward 1")
        check(abs(printed - 10), ">", 2, "as printed")


def test_n_step_return_on_a_random_episode(item):
    """Against a loop over the definition, with an end in the middle and a time limit."""
    rng = np.random.default_rng(1)
    reward, value, n = rng.normal(size=9), rng.normal(size=9), 4
    terminated, truncated = np.arange(9) == 3, np.arange(9) == 6
    discount = 0.9 * (1 - terminated)
    error = 0.0
    for t in range(9 - n + 1):
        y, scale = 0.0, 1.0
        for k in range(t, t + n):
            y, scale = y + scale * reward[k], scale * discount[k]
            if terminated[k] or truncated[k] or k == t + n - 1:
                y += scale * value[k]
                break
        window = slice(t, t + n)
        cut = jnp.asarray(terminated[window] | truncated[window])
        total, product, last = n_step_transition(jnp.asarray(reward[window]), jnp.asarray(discount[window]), cut)
        error = max(error, abs(float(total + product * value[window][int(last)]) - y))
    with item("6.16") as check:
        check(error, "<=", 1e-12, "random episode, terminal-aware, against the definition")
