r"""The iterative linear-quadratic regulator and differential dynamic programming (notes 8.2.8, Algorithm 18).

About a nominal trajectory $(\hat x, \hat u)$, with $\delta z = z - \hat z$,

$$\delta x_{t+1} = F_t \delta z_t, \qquad
c_t(z) \approx c_t(\hat z) + c_t^\top \delta z + \tfrac12 \delta z^\top C_t \delta z, \qquad
F_t = \nabla f_t(\hat z), \; c_t = \nabla c_t(\hat z), \; C_t = \nabla^2 c_t(\hat z),$$

is linear-quadratic; its regulator gives the next trajectory on the real dynamics,

$$u_t = \hat u_t + \alpha k_t + K_t (x_t - \hat x_t).$$

It is Newton's method on the actions with $f_{xx}$ left out (Gauss and Newton's); DDP puts it back: $Q_t$ gains
$\sum_i v_{t+1,i} \nabla^2 f_{t,i}$ (item 8.39).

As the notes print it (the full step, always) it diverges in practice (erratum E8.8). Here (Tassa, Erez and Todorov 2012):

- $\alpha$ is the first of 1, 1/2, 1/4, ... whose cost falls by a share of what the model promises.
- $\mu I$ is added to $Q_{uu}$, and grows while that is not positive definite or no $\alpha$ will do, and falls again after.
- With bounds on the actions $k_t$ solves the box-constrained quadratic programme, and rows of $K_t$ whose action rests on its bound are 0
  (Tassa,
  Mansard and Todorov 2014).

Sources: notes 8.2.8 with errata E8.7 and E8.8. Expansions are at the nominal point, where the notes write them at $(\delta x, \delta u)$.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core import Solution
from ..ops.linalg import definite_solve, small_product
from .flat import FlatProblem, finished, require_finite
from .problem import CONVERGED, LINE_SEARCH_FAILED, MAX_ITERS, NOT_POSITIVE_DEFINITE, Problem

STEP_LENGTHS = 11
"""1, 1/2, 1/4, ...: how many are tried."""
LEAST_MU, MOST_MU = 1e-6, 1e10
ENOUGH = 1e-4
"""The share of the promised fall of the cost that a step must bring."""
NEWTON_STEPS = 8
"""Projected Newton steps for the bounded action of one time step."""


class Expansion(eqx.Module):
    """Taylor expansion of dynamics and cost along a trajectory (item 8.38), z = (x, u).

    `f` is f_t(z_t) - x_{t+1}: 0 where the trajectory obeys the dynamics (erratum E8.7).
    """

    F: Float[Array, "H X Z"]
    f: Float[Array, "H X"]
    c: Float[Array, "H Z"]
    C: Float[Array, "H Z Z"]
    c_final: Float[Array, "X"]
    C_final: Float[Array, "X X"]


def expand(problem: FlatProblem, states: Float[Array, "T X"], actions: Float[Array, "H U"]) -> Expansion:
    """First derivatives of the dynamics, first and second of the cost, at the nominal points."""
    x = states.shape[-1]

    def at(z: Array, t: Array) -> tuple[Array, Array, Array, Array]:
        step = lambda z: problem.step(z[:x], z[x:], t)  # noqa: E731
        cost = lambda z: step(z)[1]  # noqa: E731
        return jax.jacfwd(lambda z: step(z)[0])(z), step(z)[0], jax.grad(cost)(z), jax.hessian(cost)(z)

    z = jnp.concatenate([states[:-1], actions], 1)
    F, following, c, C = jax.vmap(at)(z, jnp.arange(problem.horizon))
    last = states[-1]
    return Expansion(
        F, following - states[1:], c, C, jax.grad(problem.final_cost)(last), jax.hessian(problem.final_cost)(last)
    )


class Sweep(eqx.Module):
    """What a backward pass finds."""

    K: Float[Array, "H U X"]
    k: Float[Array, "H U"]
    slope: Float[Array, ""]
    curvature: Float[Array, ""]
    gradient: Float[Array, "H U"]
    bad_step: Int[Array, ""]


def backward(
    problem: FlatProblem,
    e: Expansion,
    states: Float[Array, "T X"],
    actions: Float[Array, "H U"],
    mu: Float[Array, ""],
    ddp: bool,
) -> Sweep:
    """The backward pass with mu added to Q_uu. The model's cost at alpha is J + alpha slope + alpha^2/2 curvature.

    `gradient`: dJ/du at the nominal trajectory, by its adjoint; `bad_step`: the last t at which Q_uu + mu I is not positive definite, or
    -1.
    """
    x, u = states.shape[-1], actions.shape[-1]
    low, high = map(jnp.asarray, problem.bounds())

    def step(loop: tuple[Array, ...], now: tuple[Array, ...]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        V, v, costate = loop
        F, f, c, C, point, action, t = now
        ahead = V @ f + v
        Q, q = C + small_product(F.T, small_product(V, F)), c + F.T @ ahead
        if ddp:
            bend = jax.hessian(lambda z: problem.step(z[:x], z[x:], t)[0] @ ahead)(jnp.concatenate([point, action]))
            Q = Q + bend
        Q_ux, Q_uu = Q[x:, :x], Q[x:, x:]
        held = Q_uu + mu * jnp.eye(u, dtype=Q.dtype)
        if problem.is_bounded:
            k, K, pivot = _bounded(held, q[x:], Q_ux, low - action, high - action)
        else:
            solved, pivot = definite_solve(held, jnp.concatenate([q[x:, None], Q_ux], 1))
            k, K = -solved[:, 0], -solved[:, 1:]
        half = 0.5 * Q[:x, :x] + small_product(Q_ux.T + 0.5 * small_product(K.T, Q_uu), K)
        V = half + half.T
        v = q[:x] + Q_ux.T @ k + K.T @ (q[x:] + Q_uu @ k)
        adjoint = c + F.T @ costate
        return (V, v, adjoint[:x]), (K, k, q[x:] @ k, k @ Q_uu @ k, adjoint[x:], pivot)

    inputs = (e.F, e.f, e.c, e.C, states[:-1], actions, jnp.arange(problem.horizon))
    _, (K, k, slope, curvature, gradient, pivots) = jax.lax.scan(
        step, (e.C_final, e.c_final, e.c_final), inputs, reverse=True
    )
    good = (pivots > 0) & jnp.isfinite(pivots) & jnp.isfinite(k).all(-1)
    bad_step = jnp.max(jnp.where(good, -1, jnp.arange(problem.horizon)))
    return Sweep(K, k, slope.sum(), curvature.sum(), gradient, bad_step)


def _bounded(
    Q: Float[Array, "U U"],
    q: Float[Array, "U"],
    Q_ux: Float[Array, "U X"],
    low: Float[Array, "U"],
    high: Float[Array, "U"],
) -> tuple[Float[Array, "U"], Float[Array, "U X"], Float[Array, ""]]:
    """The k in the box that minimises k' Q k / 2 + q' k, by projected Newton steps, and the gains of the entries that rest on no bound."""

    def free_at(k: Array) -> Array:
        slope = Q @ k + q
        return ~(((k <= low) & (slope > 0)) | ((k >= high) & (slope < 0)))

    def masked(free: Array, right: Array) -> tuple[Array, Array]:
        both = free[:, None] & free[None, :]
        return definite_solve(jnp.where(both, Q, jnp.eye(len(Q), dtype=Q.dtype)), jnp.where(free[:, None], right, 0.0))

    def newton(_: Array, k: Array) -> Array:
        free = free_at(k)
        step, _ = masked(free, -(Q @ k + q)[:, None])
        # A step that overshoots a bound may miss the least cost; halving finds the way along the face.
        tried = jnp.clip(
            k[None] + jnp.asarray([1.0, 0.5, 0.25, 0.1], k.dtype)[:, None] * step[None, :, 0], low[None], high[None]
        )
        costs = jax.vmap(lambda k: 0.5 * k @ Q @ k + q @ k)(tried)
        return tried[jnp.argmin(costs)]

    k = jnp.clip(jnp.zeros_like(q), low, high)
    k = (
        jax.lax.fori_loop(0, NEWTON_STEPS, newton, k)
        if len(q) > 1
        else newton(jnp.zeros((), int), newton(jnp.zeros((), int), k))
    )
    free = free_at(k)
    gains, _ = masked(free, Q_ux)
    _, pivot = definite_solve(Q, q[:, None])
    return k, -gains, pivot


class Search(eqx.Module):
    """Where the iteration stands."""

    states: Float[Array, "T X"]
    actions: Float[Array, "H U"]
    cost: Float[Array, ""]
    gains: Float[Array, "H U X"]
    mu: Float[Array, ""]
    growth: Float[Array, ""]
    gradient: Float[Array, ""]
    iteration: Int[Array, ""]
    reason: Int[Array, ""]
    bad_step: Int[Array, ""]
    costs: Float[Array, "N"]


@partial(jax.jit, static_argnames=("iterations", "ddp"))
def _search(
    problem: FlatProblem,
    x0: Float[Array, "X"],
    actions: Float[Array, "H U"],
    mu: Float[Array, ""],
    iterations: int,
    tolerance: Float[Array, ""],
    ddp: bool,
) -> Search:
    low, high = map(jnp.asarray, problem.bounds())
    running = -1
    # What is lost in a sum of so many costs: a fall that is promised to be less cannot be seen.
    rounding = 8 * float(jnp.finfo(x0.dtype).eps) * problem.horizon**0.5

    def iterate(s: Search) -> Search:
        sweep = backward(problem, expand(problem, s.states, s.actions), s.states, s.actions, s.mu, ddp)

        def forward(alpha: Array) -> tuple[Array, Array, Array]:
            choose = lambda x, now: jnp.clip(now[1] + alpha * now[3] + now[2] @ (x - now[0]), low, high)  # noqa: E731
            return problem.follow(x0, choose, (s.states[:-1], s.actions, sweep.K, sweep.k))

        def enough(alpha: Array, cost: Array) -> Array:
            promised = -(alpha * sweep.slope + 0.5 * alpha**2 * sweep.curvature)
            return (s.cost - cost >= ENOUGH * promised) & (promised > 0) & jnp.isfinite(cost) & (sweep.bad_step < 0)

        # A bounded action may rest where the gradient points outwards: what counts is the part that can be followed.
        stuck = ((s.actions <= low[None]) & (sweep.gradient > 0)) | ((s.actions >= high[None]) & (sweep.gradient < 0))
        gradient = jnp.max(jnp.abs(jnp.where(stuck, 0.0, sweep.gradient)))
        small = 1.0 + jnp.abs(s.cost)
        flat = (sweep.bad_step < 0) & (
            (-sweep.slope <= jnp.maximum(tolerance, rounding) * small) & (s.mu <= 1e-3)
            | (gradient <= 1e-3 * tolerance * small)
        )
        # Where the model promises nothing that could be seen, the full step decides.
        worth = ~flat & (sweep.bad_step < 0) & (s.reason == running)

        def shorten(loop: tuple[Array, ...]) -> tuple[Array, ...]:
            alpha = 0.5 ** loop[0].astype(s.cost.dtype)
            states, tried, cost = forward(alpha)
            return loop[0] + 1, states, tried, cost, enough(alpha, cost)

        unfinished = lambda loop: (loop[0] == 0) | (worth & ~loop[-1] & (loop[0] < STEP_LENGTHS))  # noqa: E731
        loop = (jnp.zeros((), jnp.int32), s.states, s.actions, s.cost, jnp.zeros((), bool))
        _, states, tried, cost, better = jax.lax.while_loop(unfinished, shorten, loop)
        # Rounding of the cost is all that is left: neither better nor worse.
        fall = jnp.where(better, s.cost - cost, 0.0)
        growth = jnp.where(better, jnp.minimum(s.growth / 2.0, 0.5), jnp.maximum(s.growth * 2.0, 2.0))
        mu = jnp.where(better, s.mu * growth, jnp.maximum(s.mu * growth, LEAST_MU))
        mu = jnp.where(mu < LEAST_MU, 0.0, mu)
        reason = jnp.where(
            flat & (~better | (fall <= tolerance * small)),
            CONVERGED,
            jnp.where(mu > MOST_MU, jnp.where(sweep.bad_step >= 0, NOT_POSITIVE_DEFINITE, LINE_SEARCH_FAILED), running),
        )
        keep = lambda new, old: jnp.where(better, new, old)  # noqa: E731
        cost = keep(cost, s.cost)
        return Search(
            keep(states, s.states),
            keep(tried, s.actions),
            cost,
            jnp.where(sweep.bad_step < 0, sweep.K, s.gains),
            mu,
            growth,
            gradient,
            s.iteration + 1,
            reason,
            sweep.bad_step,
            s.costs.at[s.iteration].set(cost),
        )

    states, actions, cost = problem.follow(x0, lambda _, u: u, actions)
    dtype = cost.dtype
    gains = jnp.zeros((problem.horizon, problem.controls, len(x0)), dtype)
    start = Search(
        states,
        actions,
        cost,
        gains,
        jnp.asarray(mu, dtype),
        jnp.ones((), dtype),
        jnp.asarray(jnp.inf, dtype),
        jnp.zeros((), jnp.int32),
        jnp.asarray(running),
        jnp.asarray(-1),
        jnp.full(iterations, cost, dtype),
    )
    going = lambda s: (s.reason == running) & (s.iteration < iterations) & jnp.isfinite(s.cost)  # noqa: E731
    return jax.lax.while_loop(going, iterate, start)


def ilqr(
    problem: Problem,
    state: Any,
    actions: Any = None,
    *,
    iterations: int = 200,
    tolerance: float | None = None,
    mu: float = 0.0,
    ddp: bool = False,
) -> Solution:
    """A locally best plan from a state, by iterated regulators (Algorithm 18); with `ddp` by differential dynamic programming.

    - `actions`: the first guess, `[H, *U]`; zeros where it is left out.
    - `tolerance`: stops once the cost is promised to fall, and falls, by less than this share of 1 + |J|; 1e-6 in float32, 1e-10 in
      float64 unless given.
    - `mu`: the regularisation to begin with.

    `value` is a `Plan` with gains that answer deviations. `stats`: `iterations`, `reason`, `gradient` (largest entry of dJ/du that a bound
    does not hold), `costs` `[iterations]` after each iteration, `mu`, and `step` (the last t at which Q_uu was not positive definite, -1
    where it always was).

    May be compiled and mapped over states. Raises `ValueError` for discrete actions, shapes that do not fit, and a first guess whose cost
    is not a finite number.
    """
    if iterations < 1:
        raise ValueError(f"there must be at least one iteration, not {iterations}")
    flat, x0 = FlatProblem.of(problem, state)
    guess = flat.first_actions(actions, x0.dtype)
    if tolerance is None:
        tolerance = 1e-10 if x0.dtype == jnp.float64 else 1e-6
    found = _search(flat, x0, guess, jnp.asarray(mu, x0.dtype), iterations, jnp.asarray(tolerance, x0.dtype), ddp)
    require_finite(found.cost, "the first guess")
    reason = jnp.where(found.reason < 0, MAX_ITERS, found.reason)
    stats = {
        "iterations": found.iteration,
        "reason": reason,
        "gradient": found.gradient,
        "costs": jnp.where(jnp.arange(iterations) < found.iteration, found.costs, found.cost),
        "mu": found.mu,
        "step": found.bad_step,
    }
    return Solution(finished(flat, found.states, found.actions, found.gains), reason == CONVERGED, stats)
