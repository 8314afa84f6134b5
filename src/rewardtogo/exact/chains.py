"""State distributions: Markov chains, what a policy visits, and a test of the Markov property.

    d_{t+1} = d_t P, so d_t = d_0 P^t;   stationary: d = d P;   ρ(s, a) = Σ_t γ^t p(s_t = s, a_t = a),   J = Σ_{s,a}
    ρ(s, a) r(s, a).

The Markov property is a conditional independence: given (s_t, a_t), s_{t+1} does not depend on s_{0:t-1}, a_{0:t-1}.
It does not say that s_t "only contributes to s_{t+1}", nor that arrows are causes (erratum E1.4).

Source: notes, section 1.1 and figure 1.1.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.special
import numpy as np
from jaxtyping import Array, Float, Int

from ..core import PRNGKey
from ..envs.tabular import MDP, check_distributions, draw
from .dynamic_programming import discounted_system, horizon_of
from .policies import check_policy


def chain_distributions(
    transitions: Float[Array | np.ndarray, "S S"], initial: Float[Array | np.ndarray, "S"], steps: int
) -> Float[np.ndarray, "K S"]:
    """d_t = d_0 P^t for t = 0..`steps`: `[steps + 1, S]` (item 1.13)."""
    matrix = _check_chain(transitions)
    distributions = [np.asarray(initial, np.float64)]
    for _ in range(steps):
        distributions.append(distributions[-1] @ matrix)
    return np.stack(distributions)


def stationary_distribution(transitions: Float[Array | np.ndarray, "S S"]) -> Float[np.ndarray, "S"]:
    """The d with d = d P.

    Raises `ValueError` where there are several, because the chain has more than one closed class.
    """
    matrix = _check_chain(transitions)
    size = len(matrix)
    reach = (matrix > 0) | np.eye(size, dtype=bool)
    for _ in range(size.bit_length()):
        reach = reach @ reach
    recurrent = np.all(~reach | reach.T, axis=1)
    if not reach[np.ix_(recurrent, recurrent)].all():
        raise ValueError("the chain has several closed classes of states and so several stationary distributions: "
                         "give one that can reach a common state from everywhere")  # fmt: skip
    closed = matrix[np.ix_(recurrent, recurrent)]
    system = np.concatenate([closed.T - np.eye(len(closed)), np.ones((1, len(closed)))])
    distribution = np.zeros(size)
    distribution[recurrent] = np.linalg.lstsq(system, np.append(np.zeros(len(closed)), 1.0), rcond=None)[0]
    return distribution


def simulate_chain(
    transitions: Float[Array | np.ndarray, "S S"],
    initial: Float[Array | np.ndarray, "S"],
    key: PRNGKey,
    num_chains: int,
    steps: int,
) -> Int[Array, "N K"]:
    """Sampled states `[num_chains, steps + 1]` of a Markov chain."""
    rows = jnp.asarray(_check_chain(transitions).cumsum(-1), jnp.float32)
    return _simulate_chain(rows, jnp.cumsum(jnp.asarray(initial, jnp.float32)), key, num_chains, steps)


@eqx.filter_jit
def _simulate_chain(rows: Array, start: Array, key: PRNGKey, num_chains: int, steps: int) -> Array:
    uniform = jax.random.uniform(key, (steps + 1, num_chains), jnp.float32)
    first = jax.vmap(draw, (None, 0))(start, uniform[0])

    def move(states: Array, numbers: Array) -> tuple[Array, Array]:
        following = jax.vmap(draw)(rows[states], numbers)
        return following, following

    return jnp.concatenate([first[None], jax.lax.scan(move, first, uniform[1:])[1]]).T


def _check_chain(transitions: Array | np.ndarray) -> np.ndarray:
    given = np.asarray(transitions)
    check_distributions("transitions", given)
    return given.astype(np.float64)


def state_distributions(
    mdp: MDP, policy: Float[Array | np.ndarray, "... S A"], horizon: int | None = None
) -> Float[np.ndarray, "K S"]:
    """d_t(s) = p(s_t = s) for t = 0..T: `[T + 1, S]`. Episodes that ended stay in their terminal state.

    Raises `ValueError` without a horizon.
    """
    steps = horizon_of(mdp, horizon)
    if steps is None:
        raise ValueError("distributions at each time need to know how many: give a horizon")
    table = check_policy(mdp, policy, steps)
    distributions = [np.asarray(mdp.initial, np.float64)]
    for t in range(steps):
        distributions.append(np.einsum("s,sa,sax->x", distributions[-1], table[t], mdp.transitions))
    return np.stack(distributions)


def discounted_occupancy(
    mdp: MDP, policy: Float[Array | np.ndarray, "... S A"], horizon: int | None = None
) -> Float[np.ndarray, "S A"]:
    """ρ(s, a) = Σ_t γ^t p(s_t = s, a_t = a), up to the horizon or for ever, over steps that are taken; J = Σ ρ r.

    Not normalised: without terminal states it sums to 1 / (1 - γ).
    """
    steps = horizon_of(mdp, horizon)
    live = ~np.asarray(mdp.terminal)
    if steps is None:
        table = check_policy(mdp, policy, None)
        return (np.linalg.solve(discounted_system(mdp, table).T, mdp.initial) * live)[:, None] * table
    weights = float(mdp.discount) ** np.arange(steps)
    visits = state_distributions(mdp, policy, steps)[:-1] * live
    return np.einsum("t,ts,tsa->sa", weights, visits, check_policy(mdp, policy, steps))


class MarkovTest(eqx.Module):
    """Outcome of `markov_test`. A small `p_value` speaks against the Markov property."""

    statistic: float
    degrees_of_freedom: int
    p_value: float


def markov_test(
    observations: Int[Array | np.ndarray, "N K"],
    actions: Int[Array | np.ndarray, "N T"],
    lengths: Int[Array | np.ndarray, "N"] | None = None,
) -> MarkovTest:
    """Pearson's χ² of o_{t+1} against (o_{t-1}, a_{t-1}) given (o_t, a_t), summed over all (o_t, a_t) (item 1.12).

    `observations` `[N, T + 1]` and `actions` `[N, T]` are episodes of `lengths` actions (all T by default). Rows seen
    too seldom are left out and rare outcomes pooled, so that the expected counts, about 5 or more, bear out the χ²
    approximation.
    """
    observations, actions = np.asarray(observations), np.asarray(actions)
    steps = actions.shape[1]
    taken = np.arange(steps) < (np.full(len(actions), steps) if lengths is None else np.asarray(lengths))[:, None]
    count = int(actions.max()) + 1
    pairs = observations[:, :-1] * count + actions
    before, given, after = (x[taken[:, 1:]] for x in (pairs[:, :-1], pairs[:, 1:], observations[:, 2:]))
    statistic, freedom = 0.0, 0
    for pair in np.unique(given):
        chosen = given == pair
        rows, columns = (np.unique(x[chosen], return_inverse=True)[1] for x in (before, after))
        table = np.zeros((rows.max() + 1, columns.max() + 1))
        np.add.at(table, (rows, columns), 1)
        one, two = _pearson(_pool(table))
        statistic, freedom = statistic + one, freedom + two
    if not freedom:
        raise ValueError("the data are too few or too uniform to test the Markov property: no pair "
                         "(o_t, a_t) was reached often enough from two pasts; give more episodes")  # fmt: skip
    return MarkovTest(statistic, freedom, chi_square_tail(statistic, freedom))


def _pool(table: np.ndarray) -> np.ndarray:
    """Without rows of fewer than 10 per column, and with the columns where the least row expects under 5 as one."""
    table = table[table.sum(1) >= 10 * table.shape[1]]
    if len(table) < 2:
        return np.zeros((1, 1))
    rare = table.sum(1).min() * table.sum(0) < 5 * table.sum()
    pooled = np.concatenate([table[:, ~rare], table[:, rare].sum(1, keepdims=True)], 1)
    return pooled[:, pooled.sum(0) > 0]


def _pearson(table: np.ndarray) -> tuple[float, int]:
    expected = table.sum(1, keepdims=True) * table.sum(0) / max(table.sum(), 1)
    freedom = (table.shape[0] - 1) * (table.shape[1] - 1)
    return (float(((table - expected) ** 2 / expected).sum()), freedom) if freedom else (0.0, 0)


def chi_square_tail(statistic: float, degrees_of_freedom: int) -> float:
    """P(χ² >= `statistic`), in float64 so that small values are right."""
    with jax.enable_x64(True):
        half = jnp.asarray([degrees_of_freedom / 2, statistic / 2], jnp.float64)
        return float(jax.scipy.special.gammaincc(half[0], half[1]))
