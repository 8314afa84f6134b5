r"""Collocation: states and actions are chosen together, and the dynamics are constraints (notes 8.2.6).

$$\min_{x_1 .. x_H,\, u_0 .. u_{H-1}} \sum_t c_t(x_t, u_t) + c_H(x_H) \quad \text{subject to} \quad x_{t+1} = f_t(x_t, u_t).$$

Shooting keeps the actions only, so that a change of the first one is multiplied through all the steps that follow; here every step is
held by its own state, and on unstable dynamics the problem stays well conditioned. A first guess of the states says where the plan
should go.

Sequential quadratic programming: with defects $f_t = f_t(\hat x_t, \hat u_t) - \hat x_{t+1}$ the subproblem

$$\min_{\delta z} \sum_t c_t^\top \delta z_t + \tfrac12 \delta z_t^\top C_t \delta z_t
\quad \text{subject to} \quad \delta x_{t+1} = F_t \delta z_t + f_t$$

is a linear-quadratic regulator, solved in time proportional to H by the recursion of Algorithm 17; its costates $\lambda_t$ are the
multipliers.
Bounds on the actions are kept by a logarithmic barrier $-\tau \sum \log (u - u_{low}) + \log (u_{high} - u)$ whose weight $\tau$ goes to
0, and
steps go at most 0.99 of the way to a bound. A step is taken as far as $J + \rho \sum_t |f_t|_1$ falls, with $\rho$ above the largest
multiplier (Han 1977; Nocedal and Wright, section 18.3).

Source: notes 8.2.6, which name the problem and no method.
"""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core import Action, PRNGKey, Solution, Spec, State
from .flat import FlatProblem, finished, require_finite
from .iterated_lqr import ENOUGH, LEAST_MU, MOST_MU, STEP_LENGTHS, backward, expand
from .problem import CONVERGED, LINE_SEARCH_FAILED, MAX_ITERS, NOT_POSITIVE_DEFINITE, Problem

TO_THE_BOUND = 0.99
LESS = 0.2
"""What the weight of the barrier is multiplied by once the iteration has settled under it."""


class Barrier(Problem):
    """`problem` with a price on coming near the bounds of the actions in place of the bounds."""

    problem: Problem
    weight: Float[Array, ""]

    @property
    def horizon(self) -> int:
        return self.problem.horizon

    @property
    def action(self) -> Spec:
        return dataclasses.replace(self.problem.action, low=(-np.inf,), high=(np.inf,))

    def with_horizon(self, horizon: int) -> "Barrier":
        return Barrier(self.problem.with_horizon(horizon), self.weight)

    def step(self, state: State, action: Action, t: Array | int, key: PRNGKey) -> tuple[State, Float[Array, ""]]:
        following, cost = self.problem.step(state, action, t, key)
        low, high = self.problem.action.bounds()
        gaps = [action - low, high - action]
        price = sum(
            -jnp.log(jnp.where(np.isfinite(bound), gap, 1.0)).sum()
            for gap, bound in zip(gaps, (low, high), strict=True)
        )
        return following, cost + self.weight * price

    def final_cost(self, state: State) -> Float[Array, ""]:
        return self.problem.final_cost(state)


class Iterate(eqx.Module):
    """Where the programme stands."""

    states: Float[Array, "T X"]
    actions: Float[Array, "H U"]
    gains: Float[Array, "H U X"]
    cost: Float[Array, ""]
    defect: Float[Array, ""]
    penalty: Float[Array, ""]
    mu: Float[Array, ""]
    barrier: Float[Array, ""]
    iteration: Int[Array, ""]
    reason: Int[Array, ""]
    costs: Float[Array, "N"]
    defects: Float[Array, "N"]


def _weigh(problem: FlatProblem, states: Array, actions: Array) -> tuple[Float[Array, ""], Float[Array, "H X"]]:
    """J along the states as they are, and the defects."""
    following, costs = jax.vmap(problem.step)(states[:-1], actions, jnp.arange(problem.horizon))
    return costs.sum() + problem.final_cost(states[-1]), following - states[1:]


@partial(jax.jit, static_argnames="iterations")
def _programme(
    bounded: FlatProblem,
    states: Float[Array, "T X"],
    actions: Float[Array, "H U"],
    iterations: int,
    tolerance: Float[Array, ""],
) -> Iterate:
    """Sequential quadratic programming from states and actions, the actions strictly inside their bounds."""
    low, high = bounded.bounds()
    running = -1
    zero = jnp.zeros((), states.dtype)
    under = lambda weight: FlatProblem(Barrier(bounded.problem, weight), bounded.first)  # noqa: E731

    def iterate(s: Iterate) -> Iterate:
        problem = under(s.barrier)
        e = expand(problem, s.states, s.actions)
        sweep = backward(problem, e, s.states, s.actions, s.mu, False)

        def linear(dx: Array, now: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
            K, k, F, f = now
            du = K @ dx + k
            return F @ jnp.concatenate([dx, du]) + f, (dx, du)

        last, (dx, du) = jax.lax.scan(linear, jnp.zeros_like(s.states[0]), (sweep.K, sweep.k, e.F, e.f))
        dx = jnp.concatenate([dx, last[None]])
        slope = (e.c * jnp.concatenate([dx[:-1], du], 1)).sum() + e.c_final @ last

        # Costates: lambda_t = the gradient of the model's cost to go along the step.
        def costate(after: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
            F, c, C, dz = now
            return (c + C @ dz + F.T @ after)[: s.states.shape[-1]], after

        end = e.c_final + e.C_final @ last
        _, multipliers = jax.lax.scan(costate, end, (e.F, e.c, e.C, jnp.concatenate([dx[:-1], du], 1)), reverse=True)
        penalty = jnp.maximum(0.3 * s.penalty, 1.2 * jnp.max(jnp.abs(multipliers)))

        def tried(alpha: Array) -> tuple[Array, Array, Array, Array]:
            states, actions = s.states + alpha * dx, s.actions + alpha * du
            cost, defects = _weigh(problem, states, actions)
            return states, actions, cost, jnp.abs(defects).sum()

        room = jnp.where(du > 0, high[None] - s.actions, s.actions - low[None])
        furthest = jnp.min(jnp.where(du == 0, jnp.inf, TO_THE_BOUND * room / jnp.abs(du)))
        alphas = 0.5 ** jnp.arange(STEP_LENGTHS, dtype=s.cost.dtype) * jnp.minimum(1.0, furthest)
        states_, actions_, costs, defects = jax.vmap(tried)(alphas)
        merit, merits = s.cost + penalty * s.defect, costs + penalty * defects
        promised = alphas * (penalty * s.defect - slope)
        # What is left once nothing but rounding changes.
        rounding = 10.0 * jnp.finfo(s.cost.dtype).eps * (1.0 + jnp.abs(merit))
        good = (merit - merits >= ENOUGH * promised - rounding) & jnp.isfinite(merits) & (sweep.bad_step < 0)
        first = jnp.argmax(good)
        better = good[first]
        length = jnp.maximum(jnp.max(jnp.abs(dx)), jnp.max(jnp.abs(du)))
        small = (length <= tolerance * (1.0 + jnp.max(jnp.abs(s.states)))) & (s.mu <= 1e-3)
        settled = small & (jnp.where(better, defects[first], s.defect) <= tolerance * s.states.size)
        least = tolerance * (1.0 + jnp.abs(s.cost)) / s.actions.size if bounded.is_bounded else 0.0
        done = settled & (s.barrier <= least)
        # Far from the end it is enough to come near.
        near = (length <= jnp.sqrt(s.barrier) * (1.0 + jnp.max(jnp.abs(s.states)))) & better
        barrier = jnp.where(
            settled | near, jnp.where(s.barrier * LESS < least, 0.99 * least, s.barrier * LESS), s.barrier
        )
        mu = jnp.where(better & (first < 4), s.mu / 4.0, jnp.maximum(s.mu * 8.0, LEAST_MU))
        mu = jnp.where(mu < LEAST_MU, 0.0, mu)
        failed = jnp.where(sweep.bad_step >= 0, NOT_POSITIVE_DEFINITE, LINE_SEARCH_FAILED)
        reason = jnp.where(done, CONVERGED, jnp.where(mu > MOST_MU, failed, running))
        keep = lambda new, old: jnp.where(better, new, old)  # noqa: E731
        now_states, now_actions = keep(states_[first], s.states), keep(actions_[first], s.actions)
        defect = keep(defects[first], s.defect)
        # Under the next weight.
        cost = _weigh(under(barrier), now_states, now_actions)[0]
        return Iterate(
            now_states,
            now_actions,
            jnp.where(sweep.bad_step < 0, sweep.K, s.gains),
            cost,
            defect,
            penalty,
            mu,
            barrier,
            s.iteration + 1,
            reason,
            s.costs.at[s.iteration].set(cost),
            s.defects.at[s.iteration].set(defect),
        )

    plain, defects = _weigh(bounded, states, actions)
    weight = (0.1 * jnp.abs(plain) / bounded.horizon + 1e-3).astype(states.dtype) if bounded.is_bounded else zero
    cost = _weigh(under(weight), states, actions)[0]
    gains = jnp.zeros((bounded.horizon, bounded.controls, states.shape[-1]), states.dtype)
    history = jnp.zeros(iterations, states.dtype)
    start = Iterate(
        states, actions, gains, cost.astype(states.dtype), jnp.abs(defects).sum(), zero, zero, weight, jnp.zeros((), jnp.int32),
        jnp.asarray(running), history, history
    )  # fmt: skip
    going = lambda s: (s.reason == running) & (s.iteration < iterations) & jnp.isfinite(s.cost)  # noqa: E731
    return jax.lax.while_loop(going, iterate, start)


def collocation(
    problem: Problem,
    state: Any,
    actions: Any = None,
    states: Any = None,
    *,
    iterations: int = 200,
    tolerance: float | None = None,
) -> Solution:
    """A locally best plan from a state, with the states as unknowns.

    - `actions`: the first guess, `[H, *U]`; zeros where it is left out.
    - `states`: the first guess of all H + 1 states, vectors `[H + 1, X]`; it need not obey the dynamics, and its first one is replaced by
      `state`. Where it is left out every state is guessed to be the first.
    - `tolerance`: stops once a whole step moves nothing by more than this share; 1e-4 in float32, 1e-9 in float64 unless given.

    `value` is a `Plan` with gains. `stats`: `iterations`, `reason`, `residual` (the largest |x_{t+1} - f(x_t, u_t)| left), `costs` and
    `defects` `[iterations]`. Raises `ValueError` for discrete actions, shapes that do not fit, and a guess whose cost is no finite number.
    """
    if iterations < 1:
        raise ValueError(f"there must be at least one iteration, not {iterations}")
    flat, x0 = FlatProblem.of(problem, state)
    guess = flat.first_actions(actions, x0.dtype)
    shape = (problem.horizon + 1, len(x0))
    if states is not None and jnp.shape(states) != shape:
        raise ValueError(f"the guess of the states has shape {jnp.shape(states)}, and {shape} is wanted")
    states = jnp.broadcast_to(x0, shape) if states is None else jnp.asarray(states, x0.dtype)
    states = states.at[0].set(x0)
    guess = _inside(flat, guess)
    if tolerance is None:
        tolerance = 1e-9 if x0.dtype == jnp.float64 else 1e-4
    found = _programme(flat, states, guess, iterations, jnp.asarray(tolerance, x0.dtype))
    require_finite(found.cost + found.defect, "the first guess")
    reason = jnp.where(found.reason < 0, MAX_ITERS, found.reason)
    _, defects = _weigh(flat, found.states, found.actions)
    done = jnp.arange(iterations) < found.iteration
    stats = {
        "iterations": found.iteration,
        "reason": reason,
        "residual": jnp.max(jnp.abs(defects)),
        "costs": jnp.where(done, found.costs, found.cost),
        "defects": jnp.where(done, found.defects, found.defect),
    }
    return Solution(finished(flat, found.states, found.actions, found.gains), reason == CONVERGED, stats)


def _inside(flat: FlatProblem, actions: Float[Array, "H U"]) -> Float[Array, "H U"]:
    """The actions, moved off their bounds by a hundredth of the way across, or by a hundredth where there is no other side."""
    low, high = flat.bounds()
    across = np.where(np.isfinite(high - low), high - low, 1.0)
    return jnp.clip(actions, (low + 0.01 * across)[None], (high - 0.01 * across)[None])
