r"""Dynamic programming on known decision processes, in full matrices or in lists of successors (notes, section 5.2.2).

    policy_evaluation        V <- E_a[r + γ E V]  in sweeps, or  (I - γ P_π) V = r_π  solved
    policy_iteration         Algorithm 6: solve V^π, π <- argmax_a r + γ E V^π, until π stays (erratum E5.2: the notes evaluate "V^π(s, a)"
                             and give no end)
    value_iteration          Algorithm 7: Q <- r + γ E V, V <- max_a Q
    modified_policy_iteration   between the two: k evaluation sweeps for every improvement (Puterman and Shin 1978)
    gauss_seidel             value iteration that uses each new value at once, state by state or block by block
    backward_induction       a finite horizon: V_T = 0, V_t = B V_{t+1}

Each returns a `Solution`: `value` holds V, Q and the greedy policy; `stats` the number of sweeps, the residual of each, and a bound on
the error of V that holds whatever the method: for $V = BV'$

$$\Vert V - V^\star \Vert_\infty \le \frac{\gamma}{1 - \gamma} \Vert BV' - V' \Vert_\infty.$$

When to stop. Algorithm 7 has no end. `stop="norm"` is the textbook's, which makes the greedy policy ε-optimal:

$$\Vert V_{k+1} - V_k \Vert_\infty < \epsilon\, \frac{1 - \gamma}{2 \gamma}.$$

The default, `stop="bounds"`, promises the same and needs fewer sweeps: where every row of P sums to 1,

$$V^\star - BV \in \frac{\gamma}{1 - \gamma} \big[\min (BV - V),\, \max (BV - V)\big] \qquad \text{(MacQueen 1966)},$$

so that only the *spread* of the change has to be small, and the middle of the interval is added. Elsewhere it is the norm. With discount 1
nothing is promised, and sweeps go on until they change nothing by more than ε.

Everything is float64. Sweeps run compiled, a hundred to a call, so that Ctrl-C is heard.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core import Solution
from ..envs.sparse import SparseMDP
from ..envs.tabular import MDP
from ..exact import first_actions, improve_until_stable, q_values, v_values
from .operators import Lookahead, Problem, greedy_actions, lookahead, stepwise, under_policy

HISTORY, CHUNK = 10_000, 100
"""How many residuals are kept, the first ones, and sweeps to a compiled call."""
STOPS = ("bounds", "norm")
ROUNDING = 4 * np.finfo(np.float64).eps
"""Changes of less than this, relative to the largest value, are rounding, and no more sweeps will shrink them."""


class Tables(eqx.Module):
    """What a solver found: V, Q and the greedy actions (the first of equals). With a horizon, of the first step; actions `[T, S]`."""

    values: Float[np.ndarray, "S"]
    q_values: Float[np.ndarray, "S A"]
    actions: Int[np.ndarray, "*T S"]


class Sweep(eqx.Module):
    """One pass over the states."""

    @abstractmethod
    def __call__(self, ahead: Lookahead, value: Float[Array, "S"]) -> tuple[Float[Array, "S"], Float[Array, "S"]]:
        """What the pass makes of the values, by which `stop` judges it, and the values to go on from."""


class Jacobi(Sweep):
    """All states from the old values."""

    def __call__(self, ahead: Lookahead, value: Float[Array, "S"]) -> tuple[Float[Array, "S"], Float[Array, "S"]]:
        new = ahead.best(value)
        return new, new


class GaussSeidel(Sweep):
    """Blocks of states one after the other, each from the newest values; the last block may repeat states of the one before."""

    block: int = eqx.field(static=True)

    def __call__(self, ahead: Lookahead, value: Float[Array, "S"]) -> tuple[Float[Array, "S"], Float[Array, "S"]]:
        states = value.shape[0]

        def one(i: Array, new: Float[Array, "S"]) -> Float[Array, "S"]:
            start = jnp.minimum(i * self.block, states - self.block)
            part = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, self.block), ahead)
            return jax.lax.dynamic_update_slice_in_dim(new, part.best(new), start, 0)

        new = jax.lax.fori_loop(0, -(-states // self.block), one, value)
        return new, new


class Modified(Sweep):
    """An improvement, and `evaluations` sweeps that evaluate the improved policy."""

    evaluations: int = eqx.field(static=True)

    def __call__(self, ahead: Lookahead, value: Float[Array, "S"]) -> tuple[Float[Array, "S"], Float[Array, "S"]]:
        q = ahead.q(value)
        actions, best = q.argmax(-1), q.max(-1)
        pick = lambda x: jnp.take_along_axis(x, actions.reshape(-1, *[1] * (x.ndim - 1)), 1)  # noqa: E731
        chain = jax.tree.map(pick, ahead)
        return best, jax.lax.fori_loop(0, self.evaluations, lambda _, v: chain.best(v), best)


class Progress(eqx.Module):
    """Where the sweeps stand."""

    value: Float[Array, "S"]
    improved: Float[Array, "S"]
    change: Float[Array, "S"]
    residuals: Float[Array, "H"]
    sweeps: Int[Array, ""]
    done: Bool[Array, ""]


@eqx.filter_jit
def _sweep_on(
    sweep: Sweep, ahead: Lookahead, state: Progress, threshold: Array, spread: Array, limit: Array
) -> Progress:
    """Sweeps until `limit` of them, or until the residual (the spread of changes, if so asked) is below the threshold."""

    def one(state: Progress) -> Progress:
        improved, value = sweep(ahead, state.value)
        change = improved - state.value
        residual = jnp.where(spread, 0.5 * (change.max() - change.min()), jnp.abs(change).max())
        floor = ROUNDING * jnp.abs(value).max()
        residuals = state.residuals.at[jnp.minimum(state.sweeps, HISTORY)].set(residual, mode="drop")
        return Progress(value, improved, change, residuals, state.sweeps + 1, residual <= jnp.maximum(threshold, floor))

    return jax.lax.while_loop(lambda s: ~s.done & (s.sweeps < limit), one, state)


@jax.jit
def _look(ahead: Lookahead, value: Float[Array, "S"]) -> Float[Array, "S A"]:
    return ahead.q(value)


def _sweeps(
    problem: Problem,
    sweep: Sweep,
    tolerance: float,
    stop: str,
    max_sweeps: int,
    initial: Float[np.ndarray, "S"] | None,
    ahead: Lookahead,
) -> tuple[Float[np.ndarray, "S"], Float[np.ndarray, "S A"], bool, dict[str, Any]]:
    """Sweep until it is good enough: values, one more look ahead from them, whether it was, and how it went."""
    gamma, states = float(problem.discount), problem.num_states
    check_settings(tolerance, stop, max_sweeps)
    # Bounds by the spread want every row to sum to γ; then constants are scaled by γ exactly.
    spread = stop == "bounds" and 0 < gamma < 1 and bool(np.all(ahead.weights.sum(-1) > gamma * (1 - 1e-12)))
    threshold = tolerance if gamma == 1 else np.inf if gamma == 0 else tolerance * (1 - gamma) / (2 * gamma)
    with jax.enable_x64(True):
        value = jnp.asarray(first_values(initial, states))
        on_device = jax.tree.map(jnp.asarray, ahead)
        state = Progress(value, value, value, jnp.full(HISTORY + 1, jnp.nan), jnp.asarray(0), jnp.asarray(False))
        swept = 0
        while not bool(state.done) and swept < max_sweeps:
            limit = jnp.asarray(min(swept + CHUNK, max_sweeps))
            state = _sweep_on(sweep, on_device, state, jnp.asarray(threshold), jnp.asarray(spread), limit)
            swept = int(state.sweeps)
        value = np.asarray(state.improved)
        if spread and bool(state.done):
            change = np.asarray(state.change)
            value = value + gamma / (1 - gamma) * 0.5 * (change.max() + change.min())
        q = np.asarray(_look(on_device, jnp.asarray(value)))
    stats = {"sweeps": np.asarray(swept), "residuals": np.asarray(state.residuals)[: min(swept, HISTORY)]}
    return value, q, bool(state.done), stats


def solution_of(
    problem: Problem,
    value: Float[np.ndarray, "S"],
    q: Float[np.ndarray, "S A"],
    converged: bool,
    stats: dict[str, Any],
) -> Solution:
    """Q, V = max_a Q and the greedy policy of values that a solver ended with, and a bound on the error of V."""
    gamma, residual = float(problem.discount), float(np.abs(q.max(-1) - value).max())
    bound = gamma / (1 - gamma) * residual if gamma < 1 else (0.0 if residual == 0 else np.inf)
    stats = {**stats, "bellman_residual": np.asarray(residual), "error_bound": np.asarray(bound)}
    return Solution(Tables(q.max(-1), q, greedy_actions(problem, q)), np.asarray(converged), stats)


def check_settings(tolerance: float, stop: str, max_sweeps: int) -> None:
    """Raise `ValueError` for settings that make no sense."""
    if not tolerance > 0:
        raise ValueError(f"the tolerance is {tolerance} and must be more than 0, such as 1e-8")
    if stop not in STOPS:
        raise ValueError(f"sweeps stop by one of {', '.join(STOPS)}, not by {stop!r}")
    if max_sweeps < 1:
        raise ValueError(f"{max_sweeps} sweeps find nothing: allow at least 1")


def first_values(initial: Float[np.ndarray, "S"] | None, states: int) -> Float[np.ndarray, "S"]:
    """The values to begin with: 0 unless given. Raises `ValueError` for other than one finite number a state."""
    value = np.zeros(states) if initial is None else np.asarray(initial, np.float64)
    if value.shape != (states,) or not np.all(np.isfinite(value)):
        raise ValueError(
            f"the values to begin with have shape {value.shape} and must be {states} finite numbers, one a state"
        )
    return value


def value_iteration(
    problem: Problem,
    *,
    tolerance: float = 1e-8,
    stop: str = "bounds",
    max_sweeps: int = 1_000_000,
    initial: Float[np.ndarray, "S"] | None = None,
) -> Solution:
    """Algorithm 7: V <- max_a (r + γ E V), all states at once, until the greedy policy is `tolerance`-optimal (item 5.7).

    Raises `ValueError` for a finite horizon, and for settings that make no sense.
    """
    return solution_of(problem, *_sweeps(problem, Jacobi(), tolerance, stop, max_sweeps, initial, lookahead(problem)))


def gauss_seidel(
    problem: Problem,
    *,
    block: int = 1,
    tolerance: float = 1e-8,
    max_sweeps: int = 1_000_000,
    initial: Float[np.ndarray, "S"] | None = None,
) -> Solution:
    """Value iteration in place: each block of `block` states from the newest values (item 5.8).

    News is used at once, so that it takes fewer sweeps, fewest where the order of the states is that of the way back from a goal. Stops by
    the norm: the spread says nothing of a sweep that is not one of B.
    """
    if not 1 <= block <= problem.num_states:
        raise ValueError(f"a block of {block} states cannot be: give a number from 1 to {problem.num_states}")
    return solution_of(
        problem, *_sweeps(problem, GaussSeidel(block), tolerance, "norm", max_sweeps, initial, lookahead(problem))
    )


def modified_policy_iteration(
    problem: Problem,
    *,
    evaluations: int = 20,
    tolerance: float = 1e-8,
    stop: str = "bounds",
    max_sweeps: int = 1_000_000,
    initial: Float[np.ndarray, "S"] | None = None,
) -> Solution:
    """Improve, evaluate by `evaluations` sweeps of the one action a state that was chosen, and again (item 5.8).

    With 0 evaluations it is value iteration. A sweep of the stats is one improvement with its evaluations.
    """
    if evaluations < 0:
        raise ValueError(f"{evaluations} evaluation sweeps cannot be: give 0 (value iteration) or more")
    return solution_of(
        problem, *_sweeps(problem, Modified(evaluations), tolerance, stop, max_sweeps, initial, lookahead(problem))
    )


def policy_evaluation(
    problem: Problem,
    policy: Float[np.ndarray, "S A"] | Int[np.ndarray, "S"],
    *,
    method: str = "solve",
    tolerance: float = 1e-10,
    max_sweeps: int = 1_000_000,
    initial: Float[np.ndarray, "S"] | None = None,
) -> Solution:
    """V^π of probabilities `[S, A]` or of an action for each state, by a linear solve or by sweeps (items 5.4 and 5.5).

    `value.q_values` is Q^π, and `value.actions` greedy for it: one improvement. Raises `ValueError` where the policy has no value.
    """
    table = np.asarray(policy)
    if table.ndim == 1:
        table = np.eye(problem.num_actions)[table]
    if table.shape != (problem.num_states, problem.num_actions):
        raise ValueError(
            f"the policy has shape {table.shape} and must be [{problem.num_states}, {problem.num_actions}]: "
            "a probability for each action in each state"
        )
    if method not in ("solve", "sweeps"):
        raise ValueError(f"a policy is evaluated by one of solve, sweeps, not by {method!r}")
    ahead = lookahead(problem)
    if method == "solve":
        dense = problem.to_dense() if isinstance(problem, SparseMDP) else problem
        padded = np.concatenate([table, np.broadcast_to(table[:1], (dense.num_states - len(table), table.shape[1]))])
        value, stats, converged = v_values(dense, padded)[: len(table)], {"sweeps": np.asarray(0)}, True
    else:
        chain = under_policy(ahead, np.asarray(policy))
        before, q, converged, stats = _sweeps(problem, Jacobi(), tolerance, "norm", max_sweeps, initial, chain)
        value, stats = q[:, 0], {**stats, "bellman_residual": np.asarray(np.abs(q[:, 0] - before).max())}
    q = np.asarray(ahead.q(value))
    return Solution(Tables(value, q, q.argmax(-1)), np.asarray(converged), stats)


def policy_iteration(
    problem: Problem, *, evaluation: str = "solve", tolerance: float = 1e-10, max_rounds: int = 10_000
) -> Solution:
    """Algorithm 6: evaluate, improve, until the policy stays (item 5.6); no more rounds than there are policies.

    - `evaluation`: `"solve"`, exact, for as many states as fit into matrices; `"sweeps"`, to `tolerance`, for a discount below 1.

    `stats["sweeps"]` counts improvements, `stats["path"]` holds the values of each policy `[K, S]`.
    """
    if evaluation not in ("solve", "sweeps"):
        raise ValueError(f"policies are evaluated by one of solve, sweeps, not by {evaluation!r}")
    if evaluation == "solve":
        dense = problem.to_dense() if isinstance(problem, SparseMDP) else problem
        lookahead(dense)
        one_hot = np.eye(dense.num_actions)
        evaluate, start, slack = lambda actions: q_values(dense, one_hot[actions]), first_actions(dense), 1e-13
    else:
        if problem.discount == 1:
            raise ValueError(
                "with discount 1 the sweeps of a policy that never ends would not end either: use evaluation='solve', "
                "or a discount below 1"
            )
        last = [np.zeros(problem.num_states)]

        def evaluate(actions: Int[np.ndarray, "S"]) -> Float[np.ndarray, "S A"]:
            found = policy_evaluation(problem, actions, method="sweeps", tolerance=tolerance, initial=last[0])
            last[0] = found.value.values
            return found.value.q_values

        start, slack = np.asarray(problem.rewards).argmax(-1), tolerance
    rounds = [0]

    def counted(actions: Int[np.ndarray, "S"]) -> Float[np.ndarray, "S A"]:
        rounds[0] += 1
        if rounds[0] > max_rounds:
            raise ValueError(
                f"policy iteration did not settle in {max_rounds} rounds: allow more, or use value_iteration"
            )
        return evaluate(actions)

    _, path = improve_until_stable(counted, start, slack)
    states = problem.num_states
    value = path[-1][:states]
    q = np.asarray(lookahead(problem).q(value))
    stats = {"sweeps": np.asarray(len(path)), "path": np.stack(path)[:, :states]}
    return solution_of(problem, value, q, True, stats)


def backward_induction(problem: Problem, horizon: int | None = None) -> Solution:
    """The optimum of a finite horizon T, the problem's own unless given: values of the first step, actions `[T, S]` (erratum E1.2)."""
    own = problem.horizon if isinstance(problem, MDP) else None
    steps = own if horizon is None else horizon
    if steps is None or steps < 1:
        raise ValueError(
            "the problem has no horizon of its own: say how many actions there are, such as horizon=100"
            if steps is None
            else f"the horizon is {steps} and must be a number of actions, at least 1"
        )

    def one(value: Float[Array, "S"], _: None) -> tuple[Float[Array, "S"], Int[Array, "S"]]:
        q = ahead.q(value)
        return q.max(-1), q.argmax(-1).astype(jnp.int32)

    with jax.enable_x64(True):
        ahead = jax.tree.map(jnp.asarray, stepwise(problem))
        after, later = jax.jit(lambda v: jax.lax.scan(one, v, None, steps - 1))(jnp.zeros(problem.num_states))
        q = np.asarray(ahead.q(after))
    actions = np.concatenate([q.argmax(-1)[None], np.asarray(later)[::-1]])
    stats = {"sweeps": np.asarray(steps), "bellman_residual": np.asarray(0.0), "error_bound": np.asarray(0.0)}
    return Solution(Tables(q.max(-1), q, actions), np.asarray(True), stats)
