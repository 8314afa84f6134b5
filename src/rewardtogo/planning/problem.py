r"""What a planner is given, dynamics, cost, horizon and bounds, and what it gives back (notes, sections 8.1 and 8.2.5).

In the notation of control $x_{t+1} = f_t(x_t, u_t)$ and

$$J(u_0, \dots, u_{H-1}) = \sum_{t=0}^{H-1} c_t(x_t, u_t) + c_H(x_H),$$

which is to be small: costs are rewards with the other sign, x and u are s and a (item 1.18). Time counts from 0, so that H actions lead
through H + 1 states. Every planner takes a `Problem` and gives a `Solution` whose `value` is a `Plan`.

    FunctionProblem   from functions f(x, u), c(x, u), c_H(x)
    ModelProblem      from a `Model`, known or learned: c = -r, and nothing more to pay after a terminal state
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from ..core import Action, Model, PRNGKey, Spec, State

REASONS = ("converged", "max_iters", "line_search_failed", "not_finite", "not_positive_definite")
"""Why a planner stopped. `Solution.stats["reason"]` is the place in this list, a number, so that planners compile; `why` names it."""
CONVERGED, MAX_ITERS, LINE_SEARCH_FAILED, NOT_FINITE, NOT_POSITIVE_DEFINITE = range(len(REASONS))


def why(reason: Any) -> str:
    """The name of a reason."""
    return REASONS[int(reason)]


class Plan(eqx.Module):
    """A sequence of actions and where it leads.

    - `actions`: `[H, *U]`.
    - `states`: `[H + 1, *X]`, a tree where a state is one. With random dynamics one sample.
    - `cost`: J of the actions, evaluated once more from the first state (item 8.8); minus the return. With random dynamics an estimate.
    - `gains`: K_t `[H, U, X]`: u_t = actions_t + K_t (x_t - states_t) answers deviations. None where the planner has none.
    """

    actions: Action
    states: State
    cost: Float[Array, ""]
    gains: Float[Array, "H U X"] | None = None


class Function(eqx.Module):
    """A plain function as a module without leaves."""

    function: Callable = eqx.field(static=True)

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


def as_module(function: Callable | None) -> Any:
    """A function that may be part of a tree: modules are, whose arrays are then traced; plain functions become static parts of it."""
    return function if function is None or isinstance(function, eqx.Module) else Function(function)


def whole(value: Any) -> int:
    """A horizon. Raises `ValueError` for anything but a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"a horizon is a whole number of actions, at least 1, not {value!r}")
    return int(value)


class Problem(eqx.Module):
    """Minimise a sum of costs over `horizon` actions of the kind that `action` says."""

    @property
    @abstractmethod
    def horizon(self) -> int:
        """H: how many actions there are to choose."""

    @property
    @abstractmethod
    def action(self) -> Spec:
        """Kind, shape and bounds of u."""

    @abstractmethod
    def with_horizon(self, horizon: int) -> "Problem":
        """The same problem with another number of actions. Raises `ValueError` for less than one."""

    @abstractmethod
    def step(self, state: State, action: Action, t: Array | int, key: PRNGKey) -> tuple[State, Float[Array, ""]]:
        """x_{t+1}, a sample where the dynamics are random, and c_t(x_t, u_t)."""

    @abstractmethod
    def final_cost(self, state: State) -> Float[Array, ""]:
        """c_H(x_H)."""


class FunctionProblem(Problem):
    """A problem from functions, in five lines.

        problem = rtg.FunctionProblem(f, c, horizon=50, action=2)
        solution = rtg.ilqr(problem, x0)

    - `dynamics`: f(x, u) -> x'; with `timed` f(x, u, t). x is an array or a tree of arrays.
    - `running`: c(x, u) -> a number, likewise.
    - `final`: c_H(x) -> a number; nothing where it is left out.
    - `action`: how many numbers u is, or a `Spec` with bounds, or that of discrete actions.

    Plain functions are static: what they close over is part of the compiled program. Where a mass or a target changes from solve to solve,
    give an Equinox module that holds it.
    """

    dynamics: Callable
    running: Callable
    final: Callable | None
    steps: int = eqx.field(static=True)
    controls: Spec = eqx.field(static=True)
    timed: bool = eqx.field(static=True)

    def __init__(
        self,
        dynamics: Callable,
        running: Callable,
        horizon: int,
        action: int | Spec,
        final: Callable | None = None,
        timed: bool = False,
    ):
        self.dynamics, self.running, self.final = as_module(dynamics), as_module(running), as_module(final)
        self.steps, self.timed = whole(horizon), timed
        self.controls = action if isinstance(action, Spec) else box(int(action))

    @property
    def horizon(self) -> int:
        return self.steps

    @property
    def action(self) -> Spec:
        return self.controls

    def with_horizon(self, horizon: int) -> "FunctionProblem":
        return FunctionProblem(self.dynamics, self.running, horizon, self.controls, self.final, self.timed)

    def step(self, state: State, action: Action, t: Array | int, key: PRNGKey) -> tuple[State, Array]:
        del key
        arguments = (state, action, t) if self.timed else (state, action)
        return self.dynamics(*arguments), self.running(*arguments)

    def final_cost(self, state: State) -> Float[Array, ""]:
        return jnp.zeros(()) if self.final is None else self.final(state)


class ModelProblem(Problem):
    """Plan in a `Model`: c_t = -gamma^t r(x, u, x'), 0 after a terminal state, which is never left.

    - `final`: what is still to be paid at the end, c_H(x), such as minus a learned value (weighed by gamma^H, and 0 after an end).
    """

    model: Model
    discount: ScalarLike
    final: Callable | None
    steps: int = eqx.field(static=True)
    controls: Spec = eqx.field(static=True)

    def __init__(
        self, model: Model, horizon: int, action: Spec, discount: ScalarLike = 1.0, final: Callable | None = None
    ):
        self.model, self.discount, self.final = model, discount, as_module(final)
        self.steps, self.controls = whole(horizon), action

    @property
    def horizon(self) -> int:
        return self.steps

    @property
    def action(self) -> Spec:
        return self.controls

    def with_horizon(self, horizon: int) -> "ModelProblem":
        return ModelProblem(self.model, horizon, self.controls, self.discount, self.final)

    def step(self, state: State, action: Action, t: Array | int, key: PRNGKey) -> tuple[State, Float[Array, ""]]:
        over = self.model.terminal(state)
        following = self.model.transition(state, action, key)
        reward = self.model.reward(state, action, following)
        following = jax.tree.map(lambda old, new: jnp.where(over, old, new), state, following)
        weight = jnp.power(jnp.asarray(self.discount, reward.dtype), t)
        return following, jnp.where(over, 0.0, -weight * reward)

    def final_cost(self, state: State) -> Float[Array, ""]:
        if self.final is None:
            return jnp.zeros(())
        cost = self.final(state)
        weight = jnp.power(jnp.asarray(self.discount, cost.dtype), self.horizon)
        return jnp.where(self.model.terminal(state), 0.0, weight * cost)


def box(size: int, low: Any = -np.inf, high: Any = np.inf) -> Spec:
    """The spec of `size` real numbers with bounds, numbers or vectors. Raises `ValueError` where a bound does not fit."""
    if isinstance(size, bool) or size < 1:
        raise ValueError(f"an action needs at least one number, not {size}")
    try:
        bounds = [np.broadcast_to(np.asarray(bound, np.float64), (size,)) for bound in (low, high)]
    except ValueError:
        raise ValueError(
            f"the bounds of {size} numbers are a number or {size} of them each, not {low} and {high}"
        ) from None
    if np.any(np.isnan(bounds)) or np.any(bounds[0] >= bounds[1]):
        raise ValueError(f"a lower bound must lie below the upper one, and {low} and {high} do not")
    return Spec("box", (int(size),), low=tuple(bounds[0].tolist()), high=tuple(bounds[1].tolist()))


def typed(problem: Problem, state: Any, action: Any) -> State:
    """The state in the types that a step gives it: float32 becomes float64 where the dynamics are."""
    following = jax.eval_shape(lambda x, u: problem.step(x, u, 0, jax.random.key(0))[0], state, action)
    return jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), state, following)


@jax.jit
def rollout(
    problem: Problem, state: Any, actions: Any, key: PRNGKey | None = None
) -> tuple[State, Float[Array, "H"], Float[Array, ""]]:
    """Follow a plan: states `[H + 1, *X]`, the costs of the H actions, and the final cost."""
    keys = jax.random.split(jax.random.key(0) if key is None else key, problem.horizon)
    state = typed(problem, state, jax.tree.map(lambda u: u[0], actions))

    def step(x: State, now: tuple[Action, Array, PRNGKey]) -> tuple[State, tuple[State, Array]]:
        u, t, k = now
        following, cost = problem.step(x, u, t, k)
        return following, (following, cost)

    last, (states, costs) = jax.lax.scan(step, state, (actions, jnp.arange(problem.horizon), keys))
    states = jax.tree.map(lambda first, rest: jnp.concatenate([jnp.asarray(first)[None], rest]), state, states)
    return states, costs, problem.final_cost(last)


@jax.jit
def total_cost(problem: Problem, state: Any, actions: Any, key: PRNGKey | None = None) -> Float[Array, ""]:
    """J(u_0, ..., u_{H-1}) from a state (items 8.3, 8.26); with random dynamics one sample of it."""
    _, costs, final = rollout(problem, state, actions, key)
    return costs.sum() + final


@jax.jit
def plan_of(problem: Problem, state: Any, actions: Any, key: PRNGKey | None = None, gains: Array | None = None) -> Plan:
    """The plan of a sequence of actions, followed and its cost counted."""
    states, costs, final = rollout(problem, state, actions, key)
    return Plan(actions, states, costs.sum() + final, gains)
