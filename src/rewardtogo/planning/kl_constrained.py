r"""A regulator that stays near another: linear-Gaussian controllers improved under a bound on how far trajectories may move.

$$\min_p \; E_p\Big[\sum_t c_t(x_t, u_t)\Big] \quad \text{such that} \quad
KL(p(\tau) \,\Vert\, \hat p(\tau)) = \sum_t E_{x_t \sim p}\, KL(p(u_t \mid x_t) \,\Vert\, \hat p(u_t \mid x_t)) \le \epsilon.$$

Both go through the same dynamics, which therefore cancel. For a multiplier $\eta$ the best p is the regulator of the cost
$c / \eta - \log \hat p(u \mid x)$ with the covariance $Q_{uu}^{-1}$ (an entropy is part of the divergence), and the divergence falls as
$\eta$ grows: one number to be searched for. This is what models that are fitted to samples are good for: they hold near the samples.

About the old controller, $u = \hat K x + \hat k + \hat S e$ with $\hat S \hat S^\top$ its covariance, the old law of e is N(0, I) and the
old cost-to-go is nobody's business: the regulator is that of $F' = F T$, $C' = T^\top C T / \eta + \mathrm{diag}(0, I)$, where T maps
(x, e) to (x, u). Rounding then does not grow as the bound shrinks.

Sources: Levine and Abbeel 2014 (LQR-FLM); notes 9.3.1 with errata E9.6 and E9.7; Zhang et al. 2019 (SOLAR).
"""

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, ScalarLike

from ..core import Number, Solution
from .linear_quadratic import LinearController, LQProblem, riccati
from .problem import CONVERGED, MAX_ITERS

WIDEST = 1e10
"""The multiplier is searched for between this and one over this times the size of the costs."""


class StateLaws(eqx.Module):
    """Means `[H + 1, X]` and covariances `[H + 1, X, X]` of the states that a controller comes to."""

    mean: Float[Array, "T X"]
    covariance: Float[Array, "T X X"]


@jax.jit
def state_laws(
    problem: LQProblem, controller: LinearController, mean: Float[Array, "X"], covariance: Float[Array, "X X"]
) -> StateLaws:
    """The Gaussian law of every state, from that of the first one, under a controller and the problem's noise."""
    x = problem.state_size
    F, f, noise = _each_step(problem)

    def step(law: tuple[Array, Array], now: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        (m, P), (F, f, noise, K, k, spread) = law, now
        A = F[:, :x] + F[:, x:] @ K
        acted = F[:, x:] @ spread
        after = (A @ m + F[:, x:] @ k + f, A @ P @ A.T + acted @ acted.T + noise)
        return after, after

    start = (mean.astype(F.dtype), covariance.astype(F.dtype))
    inputs = (F, f, noise, controller.K, controller.k, spread_of(controller))
    _, (means, covariances) = jax.lax.scan(step, start, inputs)
    join = lambda first, rest: jnp.concatenate([first[None], rest])  # noqa: E731
    return StateLaws(join(start[0], means), join(start[1], covariances))


@jax.jit
def expected_cost(
    problem: LQProblem, controller: LinearController, mean: Float[Array, "X"], covariance: Float[Array, "X X"]
) -> Float[Array, ""]:
    """What a controller pays in the mean, from Gaussian first states."""
    laws = state_laws(problem, controller, mean, covariance)

    def one(t: Array) -> Array:
        _, _, C, c = problem.at(t)
        K, spread = controller.K[t], spread_of(controller)[t]
        m = jnp.concatenate([laws.mean[t], K @ laws.mean[t] + controller.k[t]])
        P = laws.covariance[t]
        cross = K @ P
        full = jnp.block([[P, cross.T], [cross, cross @ K.T + spread @ spread.T]])
        return 0.5 * m @ C @ m + c @ m + 0.5 * (C * full).sum()

    m, P = laws.mean[-1], laws.covariance[-1]
    last = problem.final_cost(m) + 0.5 * (problem.C_final * P).sum()
    return jax.vmap(one)(jnp.arange(problem.horizon)).sum() + last


@jax.jit
def trajectory_kl(
    problem: LQProblem,
    new: LinearController,
    old: LinearController,
    mean: Float[Array, "X"],
    covariance: Float[Array, "X X"],
) -> Float[Array, ""]:
    """KL(p_new(tau) || p_old(tau)) in nats: the sum over time of that of the actions, in the mean over the new controller's states.

    Both need a `spread`, of full rank; the divergence is infinite otherwise.
    """
    laws = state_laws(problem, new, mean, covariance)

    def one(m: Array, P: Array, K: Array, k: Array, S: Array, K_old: Array, k_old: Array, S_old: Array) -> Array:
        whiten = jnp.linalg.inv(S_old)
        relative, gain, shift = whiten @ S, whiten @ (K - K_old), whiten @ (k - k_old + (K - K_old) @ m)
        log_det = jnp.linalg.slogdet(relative @ relative.T)[1]
        return 0.5 * ((relative**2).sum() - len(k) - log_det + shift @ shift + ((gain @ P) * gain).sum())

    old_parts = (old.K, old.k, spread_of(old))
    each = jax.vmap(one)(laws.mean[:-1], laws.covariance[:-1], new.K, new.k, spread_of(new), *old_parts)
    return each.sum()


def spread_of(controller: LinearController) -> Float[Array, "H U U"]:
    """Its noise; zeros where it has none."""
    if controller.spread is None:
        horizon, u, _ = controller.K.shape
        return jnp.zeros((horizon, u, u), controller.K.dtype)
    return controller.spread


def _each_step(problem: LQProblem) -> tuple[Array, Array, Array]:
    """F, f and the covariance of the noise, with an axis of time."""
    steps = jnp.arange(problem.horizon)
    F, f, _, _ = jax.vmap(problem.at)(steps)
    return F, f, jax.vmap(problem.noise_at)(steps)


class _Whitened(eqx.Module):
    """The problem about the old controller, in (x, e)."""

    problem: LQProblem
    size: Float[Array, ""]


def _whitened(problem: LQProblem, old: LinearController) -> _Whitened:
    x = problem.state_size

    def one(t: Array, K: Array, k: Array, S: Array) -> tuple[Array, ...]:
        F, f, C, c = problem.at(t)
        T = jnp.block([[jnp.eye(x, dtype=F.dtype), jnp.zeros((x, len(k)), F.dtype)], [K, S]])
        shift = jnp.concatenate([jnp.zeros(x, F.dtype), k])
        return F @ T, f + F @ shift, T.T @ C @ T, T.T @ (c + C @ shift)

    F, f, C, c = jax.vmap(one)(jnp.arange(problem.horizon), old.K, old.k, spread_of(old))
    made = LQProblem(F, C, problem.horizon, f, c, problem.C_final, problem.c_final, problem.noise)
    size = jnp.abs(C).max() + jnp.abs(c).max() + jnp.abs(problem.C_final).max() + jnp.abs(problem.c_final).max()
    return _Whitened(made, jnp.where(size > 0, size, 1.0))


def kl_constrained_lqr(
    problem: LQProblem,
    previous: LinearController,
    mean: Any,
    covariance: Any,
    epsilon: ScalarLike,
    iterations: int | None = None,
) -> Solution:
    """The controller that costs least among those whose trajectories are within `epsilon` nats of the previous one's.

    - `problem`: dynamics and cost over the horizon. The cost may be indefinite: the divergence bounds it.
    - `previous`: with a `spread` of full rank.
    - `mean` `[X]`, `covariance` `[X, X]`: of the first state.
    - `iterations`: halvings of the interval that log eta lies in; enough for the precision of the numbers unless given.

    `value` is a `LinearController` with a spread. `stats`: `kl`, at most epsilon, and equal to it where anything can be gained;
    `multiplier` eta; `cost`, expected, and `cost_before`, the previous controller's. `converged` says whether the divergence came to
    within 1 % of epsilon; it does not where the cost does not depend on the actions.

    May be compiled. Raises `ValueError` for a controller without spread or of other shapes, and for an epsilon that is not above 0.
    """
    x, u = problem.state_size, problem.F.shape[-1] - problem.state_size
    if previous.spread is None:
        raise ValueError(
            "the previous controller has no spread, so that any other is infinitely far from it: give it some noise"
        )
    if previous.K.shape != (problem.horizon, u, x):
        raise ValueError(
            f"the previous controller has gains {previous.K.shape} and the problem wants {(problem.horizon, u, x)}"
        )
    if not isinstance(epsilon, Tracer) and not np.all(np.asarray(epsilon) > 0):
        raise ValueError(f"epsilon is a divergence in nats above 0, not {epsilon}")
    dtype = problem.F.dtype
    mean, covariance = jnp.asarray(mean, dtype), jnp.asarray(covariance, dtype)
    if iterations is None:
        iterations = 34 if dtype == jnp.float32 else 62
    new, kl, weight = _search(problem, previous, mean, covariance, jnp.asarray(epsilon, dtype), iterations)
    converged = kl >= 0.99 * jnp.asarray(epsilon, dtype)
    stats = {
        "kl": kl,
        "multiplier": 1.0 / weight,
        "cost": expected_cost(problem, new, mean, covariance),
        "cost_before": expected_cost(problem, previous, mean, covariance),
        "reason": jnp.where(converged, CONVERGED, MAX_ITERS),
    }
    return Solution(new, converged, stats)


@partial(jax.jit, static_argnames="iterations")
def _search(
    problem: LQProblem,
    old: LinearController,
    mean: Float[Array, "X"],
    covariance: Float[Array, "X X"],
    epsilon: Float[Array, ""],
    iterations: int,
) -> tuple[LinearController, Float[Array, ""], Float[Array, ""]]:
    """The controller, its divergence, and 1 / eta, by bisection of its logarithm from below: what is returned keeps the bound."""
    white = _whitened(problem, old)
    base, x = white.problem, problem.state_size
    u = problem.F.shape[-1] - x
    entropy = jnp.diag(jnp.concatenate([jnp.zeros(x), jnp.ones(u)])).astype(base.F.dtype)
    white_noise = jnp.broadcast_to(jnp.eye(u, dtype=base.F.dtype), spread_of(old).shape)
    still = LinearController(jnp.zeros_like(old.K), jnp.zeros_like(old.k), white_noise)

    def at(weight: Array) -> tuple[LinearController, Array]:
        """The regulator in e for 1 / eta, and its divergence from N(0, I); infinite where Q_uu is not positive definite."""
        tilted = LQProblem(
            base.F, weight * base.C + entropy[None], base.horizon, base.f, weight * base.c,
            weight * base.C_final, weight * base.c_final, base.noise,
        )  # fmt: skip
        solution = riccati(tilted)
        regulator = solution.value
        good = solution.converged
        Q = jnp.where(good, regulator.Q[:, x:, x:], jnp.eye(u, dtype=base.F.dtype)[None])
        # Q = L L', so that L'^-1 is a root of its inverse.
        spread = jax.vmap(lambda q: jnp.linalg.inv(jnp.linalg.cholesky(q)).T)(Q)
        new = LinearController(regulator.K, regulator.k, spread)
        kl = trajectory_kl(base, new, still, mean, covariance)
        return new, jnp.where(good & jnp.isfinite(kl), kl, jnp.inf)

    span = math.log(WIDEST)
    low, high = -span - jnp.log(white.size), span - jnp.log(white.size)

    def halve(_: Array | int, loop: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = loop
        middle = 0.5 * (low + high)
        within = at(jnp.exp(middle))[1] <= epsilon
        return jnp.where(within, middle, low), jnp.where(within, high, middle)

    low, _ = jax.lax.fori_loop(0, iterations, halve, (low, high))
    weight = jnp.exp(low)
    new, kl = at(weight)
    # A bound that even the least weight breaks leaves everything as it was.
    keep = kl <= epsilon
    new = jax.tree.map(lambda a, b: jnp.where(keep, a, b), new, still)
    spread = spread_of(old)
    K = old.K + spread @ new.K
    k = old.k + jax.vmap(jnp.matmul)(spread, new.k)
    # A root of the new covariance that is triangular again.
    roots = jax.vmap(lambda S: jnp.linalg.cholesky(S @ S.T))(spread @ spread_of(new))
    return LinearController(K, k, roots), jnp.where(keep, kl, 0.0), jnp.where(keep, weight, 0.0)


def adapted_step(multiplier: Number, predicted: Number, actual: Number) -> Float[Array, ""]:
    """The next multiplier of epsilon, from what the last update promised to save and what it saved (Levine et al. 2015, section 4.3).

    The cost along the step is taken for a parabola through both: its least point is at `predicted` / (2 (`predicted` - `actual`)) of the
    step. Changes by a factor in [0.1, 5] at a time, and stays in [0.1, 10].
    """
    predicted, actual = jnp.asarray(predicted, jnp.float32), jnp.asarray(actual, jnp.float32)
    best = predicted / (2.0 * jnp.maximum(predicted - actual, 1e-4 * jnp.abs(predicted) + 1e-30))
    return jnp.clip(jnp.clip(best, 0.1, 5.0) * jnp.asarray(multiplier, jnp.float32), 0.1, 10.0)
