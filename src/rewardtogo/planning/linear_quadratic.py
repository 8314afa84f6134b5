r"""Linear dynamics, quadratic cost: the case that dynamic programming solves in closed form (notes 8.2.7, Algorithm 17).

With $z = (x, u)$,

$$x_{t+1} = F_t z_t + f_t + w_t, \quad w_t \sim N(0, \Sigma_t), \qquad
c_t = \tfrac12 z_t^\top C_t z_t + c_t^\top z_t, \qquad c_H = \tfrac12 x^\top C_H x + c_H^\top x.$$

Backwards from $V_H = C_H$, $v_H = c_H$:

$$Q_t = C_t + F_t^\top V_{t+1} F_t, \qquad q_t = c_t + F_t^\top V_{t+1} f_t + F_t^\top v_{t+1},$$
$$K_t = -Q_{uu}^{-1} Q_{ux}, \qquad k_t = -Q_{uu}^{-1} q_u,$$
$$V_t = Q_{xx} + Q_{xu} K + K^\top Q_{ux} + K^\top Q_{uu} K, \qquad v_t = q_x + Q_{xu} k + K^\top q_u + K^\top Q_{uu} k,$$

and the constants of the values

$$n_t = n_{t+1} + \tfrac12 f^\top V f + f^\top v + \tfrac12 k^\top Q_{uu} k + q_u^\top k + \tfrac12 \mathrm{tr}(V_{t+1} \Sigma_t),$$

so that $\tfrac12 x^\top V_t x + v_t^\top x + n_t$ is what is still to be paid. Noise changes the constants and nothing else (certainty
equivalence,
erratum E8.6), but the gains must then be used on the states that come: the plan alone is worse.

Source: notes 8.2.7 with errata E8.1 to E8.6 (the printed $k = -Q_{uu} q_u$ lacks the inverse, among others). $C$ is made symmetric.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, ScalarLike

from ..core import Action, Carry, Observation, Policy, PRNGKey, Solution, Spec, State
from ..ops.linalg import definite_solve, small_product
from .problem import CONVERGED, NOT_FINITE, NOT_POSITIVE_DEFINITE, Problem, box, plan_of, whole


def _array(name: str, value: Any, shape: tuple[int, ...], horizon: int) -> Array:
    """`value` in a shape, or one of it for each step."""
    value = jnp.asarray(value)
    value = value if jnp.issubdtype(value.dtype, jnp.inexact) else value.astype(float)
    if value.shape not in (shape, (horizon, *shape)):
        raise ValueError(
            f"{name} has shape {value.shape}: with these dynamics and {horizon} steps it must be {shape}, or {(horizon, *shape)} where it "
            "changes with time"
        )
    return value


class LQProblem(Problem):
    """Linear dynamics and quadratic cost over `horizon` steps.

    - `F` `[X, X + U]`, `C` `[X + U, X + U]`: as above, or with a leading axis of the horizon where they change with time.
    - `f` `[X]`, `c` `[X + U]`: zeros where they are left out.
    - `C_final` `[X, X]`, `c_final` `[X]`: of the last state, likewise.
    - `noise` `[X, X]`: covariance Sigma_t of w_t; None without noise.

    Raises `ValueError` for shapes that do not fit each other.
    """

    F: Float[Array, "*H X Z"]
    C: Float[Array, "*H Z Z"]
    f: Float[Array, "*H X"]
    c: Float[Array, "*H Z"]
    C_final: Float[Array, "X X"]
    c_final: Float[Array, "X"]
    noise: Float[Array, "*H X X"] | None
    steps: int = eqx.field(static=True)
    controls: Spec = eqx.field(static=True)

    def __init__(
        self,
        F: Any,
        C: Any,
        horizon: int,
        f: Any = None,
        c: Any = None,
        C_final: Any = None,
        c_final: Any = None,
        noise: Any = None,
        action: Spec | None = None,
    ):
        self.steps = whole(horizon)
        shape = np.shape(F)
        if len(shape) not in (2, 3) or shape[-1] <= shape[-2]:
            raise ValueError(
                f"F maps a state and an action to a state, so it is [X, X + U], not {shape}: are there no actions?"
            )
        x, z = shape[-2:]
        zeros = lambda value, *size: jnp.zeros(size) if value is None else value  # noqa: E731
        self.F = _array("F", F, (x, z), horizon)
        C = _array("C", C, (z, z), horizon)
        self.C = 0.5 * (C + jnp.swapaxes(C, -1, -2))
        self.f = _array("f", zeros(f, x), (x,), horizon)
        self.c = _array("c", zeros(c, z), (z,), horizon)
        final = _array("C_final", zeros(C_final, x, x), (x, x), -1)
        self.C_final = 0.5 * (final + final.T)
        self.c_final = _array("c_final", zeros(c_final, x), (x,), -1)
        self.noise = None if noise is None else _array("noise", noise, (x, x), horizon)
        self.controls = box(z - x) if action is None else action

    @property
    def horizon(self) -> int:
        return self.steps

    @property
    def action(self) -> Spec:
        return self.controls

    def with_horizon(self, horizon: int) -> "LQProblem":
        return self._with(horizon, self.noise)

    def without_noise(self) -> "LQProblem":
        """The mean of the dynamics."""
        return self._with(self.steps, None)

    def _with(self, horizon: int, noise: Array | None) -> "LQProblem":
        return LQProblem(self.F, self.C, horizon, self.f, self.c, self.C_final, self.c_final, noise, self.controls)

    @property
    def state_size(self) -> int:
        """X."""
        return self.F.shape[-2]

    def at(self, t: Array | int) -> tuple[Array, Array, Array, Array]:
        """F, f, C and c of a step."""
        pick = lambda value, rank: value[t] if value.ndim > rank else value  # noqa: E731
        return pick(self.F, 2), pick(self.f, 1), pick(self.C, 2), pick(self.c, 1)

    def noise_at(self, t: Array | int) -> Array:
        """Sigma_t."""
        if self.noise is None:
            return jnp.zeros((self.state_size, self.state_size), self.F.dtype)
        return self.noise[t] if self.noise.ndim > 2 else self.noise

    def step(self, state: State, action: Action, t: Array | int, key: PRNGKey) -> tuple[State, Float[Array, ""]]:
        F, f, C, c = self.at(t)
        z = jnp.concatenate([state, action])
        following = F @ z + f
        if self.noise is not None:
            following = following + _square_root(self.noise_at(t)) @ jax.random.normal(key, f.shape, f.dtype)
        return following, 0.5 * z @ C @ z + c @ z

    def final_cost(self, state: State) -> Float[Array, ""]:
        return 0.5 * state @ self.C_final @ state + self.c_final @ state


def _square_root(covariance: Float[Array, "X X"]) -> Float[Array, "X X"]:
    """S with S S' the covariance, which may be singular."""
    values, vectors = jnp.linalg.eigh(covariance)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]


class Regulator(eqx.Module):
    """What Algorithm 17 finds: gains, and the quadratic value of every step.

    - `K` `[H, U, X]`, `k` `[H, U]`: u_t = K_t x + k_t.
    - `V` `[H + 1, X, X]`, `v` `[H + 1, X]`, `constant` `[H + 1]`: the cost to go.
    - `Q` `[H, Z, Z]`, `q` `[H, Z]`: the cost to go after an action, up to a constant; minus the Q function of reinforcement learning
      (item 1.22).
    """

    K: Float[Array, "H U X"]
    k: Float[Array, "H U"]
    V: Float[Array, "T X X"]
    v: Float[Array, "T X"]
    constant: Float[Array, "T"]
    Q: Float[Array, "H Z Z"]
    q: Float[Array, "H Z"]

    def cost_to_go(self, state: Any, t: int = 0) -> Float[Array, ""]:
        """What is still to be paid from a state on, in the mean over noise."""
        state = jnp.asarray(state)
        return 0.5 * state @ self.V[t] @ state + self.v[t] @ state + self.constant[t]

    def controller(self) -> "LinearController":
        """The gains as a policy."""
        return LinearController(self.K, self.k)


class LinearController(Policy):
    """u_t = K_t x + k_t, with noise of covariance S_t S_t' where `spread` S is given (item 8.7). Its memory is the time.

    After the last step it goes on with the last gains.
    """

    K: Float[Array, "H U X"]
    k: Float[Array, "H U"]
    spread: Float[Array, "H U U"] | None = None

    def init(self, key: PRNGKey) -> Carry:
        del key
        return jnp.zeros((), jnp.int32)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        t = jnp.minimum(carry, len(self.K) - 1)
        mean = self.K[t] @ observation + self.k[t]
        action = mean
        if self.spread is not None:
            action = mean + self.spread[t] @ jax.random.normal(key, mean.shape, mean.dtype)
        return carry + 1, action, {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return {"mean": self(carry, observation, jax.random.key(0))[1]}


class Backup(eqx.Module):
    """One step of the recursion."""

    K: Array
    k: Array
    V: Array
    v: Array
    added: Array
    Q: Array
    q: Array
    pivot: Float[Array, ""]


def backup(
    F: Float[Array, "X Z"],
    f: Float[Array, "X"],
    C: Float[Array, "Z Z"],
    c: Float[Array, "Z"],
    V: Float[Array, "X X"],
    v: Float[Array, "X"],
) -> Backup:
    """From the value of the next step to the gains and the value of this one; `pivot` is positive where Q_uu is positive definite."""
    x = len(F)
    Q = C + small_product(F.T, small_product(V, F))
    q = c + F.T @ (V @ f + v)
    Q_xx, Q_ux, Q_uu = Q[:x, :x], Q[x:, :x], Q[x:, x:]
    solved, pivot = definite_solve(Q_uu, jnp.concatenate([Q_ux, q[x:, None]], 1))
    K, k = -solved[:, :x], -solved[:, x]
    # Symmetric to the last bit, or rounding grows from step to step.
    half = 0.5 * Q_xx + small_product(Q_ux.T + 0.5 * small_product(K.T, Q_uu), K)
    V_new = half + half.T
    v_new = q[:x] + Q_ux.T @ k + K.T @ (q[x:] + Q_uu @ k)
    added = 0.5 * f @ V @ f + f @ v + (0.5 * Q_uu @ k + q[x:]) @ k
    return Backup(K, k, V_new, v_new, added, Q, q, pivot)


@jax.jit
def _recursion(problem: LQProblem) -> tuple[Regulator, Float[Array, "H"]]:
    def step(loop: tuple[Array, Array, Array], t: Array) -> tuple[tuple[Array, Array, Array], tuple[Backup, Array]]:
        V, v, constant = loop
        now = backup(*problem.at(t), V, v)
        if problem.noise is not None:
            now = eqx.tree_at(lambda b: b.added, now, now.added + 0.5 * (V * problem.noise_at(t)).sum())
        constant = constant + now.added
        return (now.V, now.v, constant), (now, constant)

    dtype = jnp.result_type(problem.F, problem.C)
    last = (problem.C_final.astype(dtype), problem.c_final.astype(dtype), jnp.zeros((), dtype))
    _, (steps, constants) = jax.lax.scan(step, last, jnp.arange(problem.horizon), reverse=True)
    after = lambda rest, end: jnp.concatenate([rest, end[None]])  # noqa: E731
    V, v, constant = after(steps.V, last[0]), after(steps.v, last[1]), after(constants, last[2])
    return Regulator(steps.K, steps.k, V, v, constant, steps.Q, steps.q), steps.pivot


def riccati(problem: LQProblem) -> Solution:
    """The backward pass: a `Regulator`, whatever the first state (Algorithm 17, lines 2 to 12).

    `stats`: `step` the last t at which Q_uu is not positive definite (-1 where there is none), and `least_pivot`. Raises `ValueError`
    there, unless
    it is called inside a compiled function, where `converged` says it.
    """
    regulator, pivots = _recursion(problem)
    good = (pivots > 0) & jnp.isfinite(pivots)
    step = jnp.max(jnp.where(good, -1, jnp.arange(problem.horizon)))
    converged = jnp.all(good)
    stats = {
        "step": step,
        "least_pivot": pivots.min(),
        "reason": jnp.where(converged, CONVERGED, NOT_POSITIVE_DEFINITE),
    }
    if not isinstance(converged, Tracer) and not np.all(converged):
        if not np.all(np.isfinite(pivots)):
            raise ValueError(
                f"the value of step {int(np.max(step))} is not a finite number: look at F, C and the horizon"
            )
        raise ValueError(
            f"Q_uu of step {int(np.max(step))} is not positive definite (least pivot {float(pivots.min()):.3g}), so the cost has no "
            f"least value: "
            "make C_uu positive definite, or add a multiple of the identity to it"
        )
    return Solution(regulator, converged, stats)


def lqr(problem: LQProblem, state: Any) -> Solution:
    """The linear-quadratic regulator: the best plan from a state, with its gains (Algorithm 17, both passes).

    `value` is a `Plan` along the mean of the dynamics; its cost includes what noise adds. `stats["regulator"]` holds the values. Errors
    as in `riccati`.
    """
    state = jnp.asarray(state)
    if state.shape != (problem.state_size,):
        raise ValueError(f"the state has shape {state.shape} and F wants ({problem.state_size},)")
    solution = riccati(problem)
    regulator: Regulator = solution.value
    quiet = problem.without_noise()
    actions = _follow(quiet, regulator, state)
    plan = plan_of(quiet, state, actions, gains=regulator.K)
    if problem.noise is not None:
        plan = eqx.tree_at(lambda p: p.cost, plan, plan.cost + _paid_to_noise(problem, regulator.V))
    return Solution(
        plan, solution.converged, solution.stats | {"regulator": regulator, "iterations": jnp.ones((), int)}
    )


@jax.jit
def _follow(problem: LQProblem, regulator: Regulator, state: Float[Array, "X"]) -> Float[Array, "H U"]:
    """The forward pass: the gains on the states they lead to."""

    def step(x: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        K, k, t = now
        u = K @ x + k
        F, f, _, _ = problem.at(t)
        return F @ jnp.concatenate([x, u]) + f, u

    start = state.astype(regulator.V.dtype)
    return jax.lax.scan(step, start, (regulator.K, regulator.k, jnp.arange(problem.horizon)))[1]


@jax.jit
def _paid_to_noise(problem: LQProblem, V: Float[Array, "T X X"]) -> Float[Array, ""]:
    """Sum over t of tr(V_{t+1} Sigma_t) / 2: what noise adds to the cost (item 8.35)."""
    return 0.5 * jax.vmap(lambda t: (V[t + 1] * problem.noise_at(t)).sum())(jnp.arange(problem.horizon)).sum()


def lqr_infinite(F: Any, C: Any, tolerance: float = 1e-12, iterations: int = 64) -> Solution:
    """The regulator of an endless horizon: `Regulator` of one step with the K and V that the recursion settles at (item 8.34).

    V solves the discrete algebraic Riccati equation, by doubling: k iterations are 2^k steps of the recursion (Chu, Fan and Lin 2005).
    Raises `ValueError` where no gain stabilises the system (naming the eigenvalue that no action reaches), and where C_uu is not positive
    definite.
    """
    one = LQProblem(F, C, 1)
    x = one.state_size
    if one.F.ndim > 2 or one.C.ndim > 2:
        raise ValueError("an endless horizon needs dynamics and cost that do not change with time")
    A, B, Q = np.split(np.asarray(one.F), [x], 1)[0], np.asarray(one.F)[:, x:], np.asarray(one.C)
    if np.min(np.linalg.eigvalsh(Q[x:, x:])) <= 0:
        raise ValueError(
            "C_uu is not positive definite, so actions are not all paid for: add a multiple of the identity to it"
        )
    _require_stabilisable(A, B)
    V, converged, count = _doubling(jnp.asarray(A), jnp.asarray(B), jnp.asarray(Q), tolerance, iterations)
    now = backup(one.F, one.f, one.C, one.c, V, jnp.zeros(x, V.dtype))
    radius = np.max(np.abs(np.linalg.eigvals(A + B @ np.asarray(now.K))))
    if not (np.all(np.isfinite(V)) and radius < 1):
        raise ValueError(
            f"the recursion does not settle at a stabilising gain (spectral radius of A + B K {radius:.3g}): does the cost see "
            f"every unstable state?"
        )
    v, constant = jnp.zeros((2, x), V.dtype), jnp.zeros(2, V.dtype)
    regulator = Regulator(now.K[None], now.k[None], jnp.stack([V, V]), v, constant, now.Q[None], now.q[None])
    reason = jnp.where(converged, CONVERGED, NOT_FINITE)
    return Solution(regulator, converged, {"iterations": count, "reason": reason, "spectral_radius": radius})


def _require_stabilisable(A: np.ndarray, B: np.ndarray) -> None:
    """Popov, Belevitch and Hautus: every mode that does not die out must be reached by some action."""
    for value in np.linalg.eigvals(A):
        if abs(value) >= 1 and np.linalg.matrix_rank(np.hstack([value * np.eye(len(A)) - A, B]), tol=1e-9) < len(A):
            shown = f"{value.real:.4g}" if abs(value.imag) < 1e-12 else f"{value:.4g}"
            raise ValueError(f"no gain stabilises this system: no action reaches its mode of eigenvalue {shown}")


@partial(jax.jit, static_argnums=4)
def _doubling(A: Array, B: Array, C: Array, tolerance: ScalarLike, iterations: int) -> tuple[Array, Array, Array]:
    """V, whether it settled, and after how many doublings."""
    x = len(A)
    Q, N, R = C[:x, :x], C[:x, x:], C[x:, x:]
    # Without the cross term: u = w - R^-1 N' x.
    A = A - B @ jnp.linalg.solve(R, N.T)
    H = Q - N @ jnp.linalg.solve(R, N.T)
    G = B @ jnp.linalg.solve(R, B.T)

    def unsettled(loop: tuple[Array, Array, Array, Array, Array]) -> Array:
        _, _, H, change, count = loop
        return (change > tolerance * (1.0 + jnp.abs(H).max())) & (count < iterations)

    def double(loop: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array, Array]:
        A, G, H, _, count = loop
        W = jnp.eye(x, dtype=A.dtype) + G @ H
        left = jnp.linalg.solve(W, A)
        right = jnp.linalg.solve(W, G)
        new = H + A.T @ H @ left
        return A @ left, G + A @ right @ A.T, 0.5 * (new + new.T), jnp.abs(new - H).max(), count + 1

    start = (A, G, H, jnp.asarray(jnp.inf, A.dtype), jnp.zeros((), int))
    _, _, V, change, count = jax.lax.while_loop(unsettled, double, start)
    return V, change <= tolerance * (1.0 + jnp.abs(V).max()), count
