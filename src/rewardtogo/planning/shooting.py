r"""Direct shooting: the actions are the unknowns, the states follow from them (notes 8.2.1 and 8.2.5).

    random_shooting     the best of N random sequences
    gradient_shooting   first order: dJ/du by backpropagation through the dynamics, in any optimiser of optax
    newton_shooting     second order: the whole Hessian over u_0 .. u_{H-1}, damped; with `gauss_newton` without f_xx

For the first-order method the notes name its flaw: J mixes actions whose effects differ by factors that grow with the horizon, so that the
condition number of the Hessian does, too (item 8.27).

Source: notes 8.2.1 (guess and check), 8.2.5 (shooting). Step sizes and damping, which the notes leave open: steps are projected on the
bounds
and the best sequence seen is kept; Newton's method is damped in the manner of Levenberg and Marquardt.
"""

from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, ScalarLike

from ..core import Action, PRNGKey, Solution, Spec, State
from ..ops.linalg import definite_solve
from .flat import FlatProblem, check_dynamics, followed, require_finite
from .problem import CONVERGED, LINE_SEARCH_FAILED, MAX_ITERS, Problem, plan_of, total_cost


def mean_costs(
    problem: Problem, state: State, candidates: Action, key: PRNGKey, particles: int = 1
) -> Float[Array, "N"]:
    """J of each candidate `[N, H, *U]` in the mean over `particles` samples of the dynamics, the same noise for all (item 8.16)."""

    def one(actions: Action) -> Float[Array, ""]:
        if particles == 1:
            return total_cost(problem, state, actions, key)
        return jax.vmap(lambda k: total_cost(problem, state, actions, k))(jax.random.split(key, particles)).mean()

    return jax.vmap(one)(candidates)


def random_actions(action: Spec, horizon: int, number: int, key: PRNGKey, law: str, sd: ScalarLike) -> Action:
    """`number` random sequences; the first ones are the same for every larger number.

    `law`: uniform over the space, or Gaussian around 0 with deviation `sd`, clipped to the bounds.
    """
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(number))
    if law == "uniform":
        return jax.vmap(lambda k: jax.vmap(action.sample)(jax.random.split(k, horizon)))(keys)
    draw = lambda k: sd * jax.random.normal(k, (horizon, *action.shape), action.dtype)  # noqa: E731
    return action.clip(jax.vmap(draw)(keys))


@partial(jax.jit, static_argnames=("samples", "law", "particles"))
def _shoot(
    problem: Problem, state: State, key: PRNGKey, samples: int, law: str, sd: Array, particles: int
) -> tuple[Action, Float[Array, "N"], PRNGKey]:
    draw_key, noise_key = jax.random.split(key)
    candidates = random_actions(problem.action, problem.horizon, samples, draw_key, law, sd)
    costs = mean_costs(problem, state, candidates, noise_key, particles)
    best = jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))
    return jax.tree.map(lambda x: x[best], candidates), costs, noise_key


def random_shooting(
    problem: Problem,
    state: Any,
    key: PRNGKey,
    *,
    samples: int = 1000,
    law: Literal["uniform", "gaussian"] = "uniform",
    sd: ScalarLike = 1.0,
    particles: int = 1,
) -> Solution:
    """Guess and check (item 8.9): the best of `samples` random sequences of actions, continuous or discrete.

    `stats`: `iterations` 1, `evaluations`, `costs` `[samples]`, `reason`. Raises `ValueError` for less than one sample, for a Gaussian
    law of discrete
    actions, and where no sequence costs a finite number.
    """
    if samples < 1 or particles < 1:
        raise ValueError(f"random shooting needs at least one sample and one particle, not {samples} and {particles}")
    if law == "gaussian" and problem.action.kind != "box":
        raise ValueError("discrete actions have no Gaussian: use law='uniform'")
    check_dynamics(problem, state)
    actions, costs, noise_key = _shoot(problem, state, key, samples, law, jnp.asarray(sd, jnp.float32), particles)
    require_finite(jnp.nanmin(jnp.where(jnp.isinf(costs), jnp.nan, costs)), "every sequence that was tried")
    stats = {
        "iterations": jnp.ones((), int),
        "evaluations": jnp.asarray(samples),
        "costs": costs,
        "reason": jnp.asarray(MAX_ITERS),
    }
    return Solution(sampled_plan(problem, state, actions, noise_key, particles), jnp.ones((), bool), stats)


@partial(jax.jit, static_argnames="particles")
def sampled_plan(problem: Problem, state: State, actions: Action, key: PRNGKey, particles: int) -> Any:
    """The plan of some actions; with particles its cost is their mean, and its states are those of the first."""
    if particles == 1:
        return plan_of(problem, state, actions, key)
    plan = plan_of(problem, state, actions, jax.random.split(key, particles)[0])
    cost = mean_costs(problem, state, jax.tree.map(lambda x: x[None], actions), key, particles)[0]
    return eqx.tree_at(lambda p: p.cost, plan, cost)


@partial(jax.jit, static_argnames=("optimiser", "iterations"))
def _descend(
    problem: FlatProblem,
    x0: Float[Array, "X"],
    actions: Float[Array, "H U"],
    optimiser: optax.GradientTransformation,
    iterations: int,
    tolerance: Array,
) -> tuple[Array, Array, Array, Array]:
    low, high = problem.bounds()
    rule = optax.with_extra_args_support(optimiser)
    value = lambda u: problem.total(x0, u)  # noqa: E731
    inside = lambda u: jnp.clip(u, low[None], high[None])  # noqa: E731

    def held(u: Array, g: Array) -> Array:
        return ((u <= low[None]) & (g > 0)) | ((u >= high[None]) & (g < 0))

    def going(loop: tuple) -> Array:
        _, _, _, _, size, count, _ = loop
        return (count < iterations) & (size > tolerance)

    def step(loop: tuple) -> tuple:
        u, state, best, least, _, count, costs = loop
        cost, gradient = jax.value_and_grad(value)(u)
        gradient = jnp.where(held(u, gradient), 0.0, gradient)
        better = cost < least
        best, least = jnp.where(better, u, best), jnp.where(better, cost, least)
        updates, state = rule.update(gradient, state, u, value=cost, grad=gradient, value_fn=value)
        moved = inside(optax.apply_updates(u, updates))
        return moved, state, best, least, jnp.max(jnp.abs(gradient)), count + 1, costs.at[count].set(cost)

    infinite = jnp.asarray(jnp.inf, x0.dtype)
    start = (
        actions, rule.init(actions), actions, infinite, infinite, jnp.zeros((), jnp.int32), jnp.full(iterations, jnp.nan, x0.dtype)
    )  # fmt: skip
    _, _, best, _, size, count, costs = jax.lax.while_loop(going, step, start)
    return best, size, count, costs


DEFAULT_OPTIMISER = optax.adam(0.05)


def gradient_shooting(
    problem: Problem,
    state: Any,
    actions: Any = None,
    *,
    optimiser: optax.GradientTransformation = DEFAULT_OPTIMISER,
    iterations: int = 500,
    tolerance: float = 1e-4,
) -> Solution:
    """Descent on J by its gradient through the dynamics (item 8.27); the best sequence that was seen.

    - `optimiser`: any of optax's, `optax.lbfgs()` among them. One object compiles once.
    - `tolerance`: stops once no entry of the gradient (of those that no bound holds) is larger.

    `stats`: `iterations`, `reason`, `gradient`, `costs` `[iterations]` (NaN after the end). Errors as in `ilqr`.
    """
    flat, x0 = FlatProblem.of(problem, state)
    guess = flat.first_actions(actions, x0.dtype)
    best, size, count, costs = _descend(flat, x0, guess, optimiser, iterations, jnp.asarray(tolerance, x0.dtype))
    require_finite(costs[0], "the first guess")
    reason = jnp.where(size <= tolerance, CONVERGED, MAX_ITERS)
    stats = {"iterations": count, "reason": reason, "gradient": size, "costs": costs}
    return Solution(followed(flat, x0, best), size <= tolerance, stats)


def shooting_hessian(
    problem: FlatProblem, x0: Float[Array, "X"], actions: Float[Array, "H U"], gauss_newton: bool = False
) -> Float[Array, "N N"]:
    """Second derivatives of J over all actions as one vector of N = H U entries; with `gauss_newton` those of the problem linearised."""
    shape = actions.shape
    if not gauss_newton:
        return jax.hessian(lambda u: problem.total(x0, u.reshape(shape)))(actions.ravel())

    def points(u: Array) -> tuple[Array, Array]:
        states, actions, _ = problem.follow(x0, lambda _, u: u, u.reshape(shape))
        return jnp.concatenate([states[:-1], actions], 1), states[-1]

    z, last = points(actions.ravel())
    dz, dlast = jax.jacfwd(points)(actions.ravel())
    x = len(x0)
    bend = jax.vmap(jax.hessian(lambda z, t: problem.step(z[:x], z[x:], t)[1]))(z, jnp.arange(problem.horizon))
    total = jnp.einsum("tin,tij,tjm->nm", dz, bend, dz)
    return total + dlast.T @ jax.hessian(problem.final_cost)(last) @ dlast


class Descent(eqx.Module):
    """Where Newton's method stands."""

    actions: Float[Array, "H U"]
    cost: Float[Array, ""]
    mu: Float[Array, ""]
    gradient: Float[Array, ""]
    iteration: Int[Array, ""]
    reason: Int[Array, ""]
    costs: Float[Array, "N"]


@partial(jax.jit, static_argnames=("iterations", "gauss_newton"))
def _newton(
    problem: FlatProblem,
    x0: Float[Array, "X"],
    actions: Float[Array, "H U"],
    iterations: int,
    tolerance: Array,
    gauss_newton: bool,
) -> Descent:
    low, high = (np.broadcast_to(bound, actions.shape).ravel() for bound in problem.bounds())
    value = lambda u: problem.total(x0, u.reshape(actions.shape))  # noqa: E731
    running = -1
    dtype = actions.dtype

    def iterate(s: Descent) -> Descent:
        u = s.actions.ravel()
        g = jax.grad(value)(u)
        free = ~(((u <= low) & (g > 0)) | ((u >= high) & (g < 0)))
        hessian = shooting_hessian(problem, x0, s.actions, gauss_newton)
        scale = jnp.maximum(jnp.mean(jnp.abs(jnp.diagonal(hessian))), 1e-12)
        damped = jnp.where(free[:, None] & free[None, :], hessian, 0.0)
        damped = damped + jnp.diag(jnp.where(free, s.mu * scale, 1.0))
        step, pivot = definite_solve(damped, -jnp.where(free, g, 0.0)[:, None])
        tried = jnp.clip(u + step[:, 0], low, high)
        cost = value(tried)
        better = (cost <= s.cost) & (pivot > 0) & jnp.isfinite(cost)
        size = jnp.max(jnp.abs(jnp.where(free, g, 0.0)))
        mu = jnp.where(better, jnp.where(s.mu < 1e-6, 0.0, s.mu / 10.0), jnp.maximum(10.0 * s.mu, 1e-4))
        small = size <= tolerance * (1.0 + jnp.abs(s.cost))
        nothing = better & (s.cost - cost <= jnp.finfo(dtype).eps * (1.0 + jnp.abs(cost))) & (s.mu == 0)
        reason = jnp.where(small | nothing, CONVERGED, jnp.where(mu > 1e12, LINE_SEARCH_FAILED, running))
        cost = jnp.where(better, cost, s.cost)
        return Descent(
            jnp.where(better, tried, u).reshape(actions.shape),
            cost,
            mu,
            size,
            s.iteration + 1,
            reason,
            s.costs.at[s.iteration].set(cost),
        )

    start = Descent(
        actions,
        value(actions.ravel()),
        jnp.zeros((), dtype),
        jnp.asarray(jnp.inf, dtype),
        jnp.zeros((), jnp.int32),
        jnp.asarray(running),
        jnp.full(iterations, jnp.nan, dtype),
    )
    going = lambda s: (s.reason == running) & (s.iteration < iterations) & jnp.isfinite(s.cost)  # noqa: E731
    return jax.lax.while_loop(going, iterate, start)


def newton_shooting(
    problem: Problem,
    state: Any,
    actions: Any = None,
    *,
    iterations: int = 100,
    tolerance: float | None = None,
    gauss_newton: bool = False,
) -> Solution:
    """Newton's method on all actions at once (item 8.28): a linear-quadratic problem takes one step.

    The Hessian is dense, N = H U on a side: time grows with N^3, where `ilqr` needs H. Where it is not positive definite, or a step costs
    more, a
    multiple of the identity is added. `stats` and errors as in `gradient_shooting`; `tolerance` is relative to 1 + |J|.
    """
    flat, x0 = FlatProblem.of(problem, state)
    guess = flat.first_actions(actions, x0.dtype)
    if tolerance is None:
        tolerance = 1e-9 if x0.dtype == jnp.float64 else 1e-5
    found = _newton(flat, x0, guess, iterations, jnp.asarray(tolerance, x0.dtype), gauss_newton)
    require_finite(found.cost, "the first guess")
    reason = jnp.where(found.reason < 0, MAX_ITERS, found.reason)
    stats = {"iterations": found.iteration, "reason": reason, "gradient": found.gradient, "costs": found.costs}
    return Solution(followed(flat, x0, found.actions), reason == CONVERGED, stats)
