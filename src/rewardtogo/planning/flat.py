"""Problems seen as vectors: what methods that differentiate or solve linear systems need."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core import State
from .problem import Plan, Problem, typed


class FlatProblem(eqx.Module):
    """`problem` with states and actions as vectors. What in a state is no real number (a flag, a count) stays as it is in `first`."""

    problem: Problem
    first: State

    @staticmethod
    def of(problem: Problem, state: State) -> tuple["FlatProblem", Float[Array, "X"]]:
        """The flat problem and the flat first state.

        Raises `ValueError` for discrete actions, states without real numbers, and dynamics whose states change shape.
        """
        if problem.action.kind != "box":
            raise ValueError(
                f"this planner differentiates with respect to the actions, and these are {problem.action.kind.replace('_', '-')}: "
                "use a planner for them, such as cem or random_shooting"
            )
        state = jax.tree.map(jnp.asarray, state)
        if not any(_is_real(leaf) for leaf in jax.tree.leaves(state)):
            raise ValueError(
                "the state holds no real numbers, so there is nothing to differentiate: use another planner"
            )
        check_dynamics(problem, state)
        state = typed(problem, state, problem.action.zeros())
        flat = FlatProblem(problem, state)
        return flat, flat.split(state)

    @property
    def horizon(self) -> int:
        """H."""
        return self.problem.horizon

    @property
    def controls(self) -> int:
        """U."""
        return self.problem.action.size

    def split(self, state: State) -> Float[Array, "X"]:
        """The real numbers of a state."""
        return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(state) if _is_real(leaf)])

    def join(self, vector: Float[Array, "X"]) -> State:
        """The state with these real numbers."""
        leaves, structure = jax.tree.flatten(self.first)
        place, found = 0, []
        for leaf in leaves:
            if _is_real(leaf):
                found.append(vector[place : place + leaf.size].reshape(leaf.shape))
                place += leaf.size
            else:
                found.append(leaf)
        return jax.tree.unflatten(structure, found)

    def shape_action(self, u: Float[Array, "*H U"]) -> Float[Array, "..."]:
        """Actions in the shape the problem wants, from vectors."""
        return u.reshape(*u.shape[:-1], *self.problem.action.shape)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of u as vectors."""
        low, high = self.problem.action.bounds()
        return low.ravel(), high.ravel()

    @property
    def is_bounded(self) -> bool:
        """Whether any bound is finite."""
        return bool(np.any(np.isfinite(self.bounds())))

    def step(self, x: Float[Array, "X"], u: Float[Array, "U"], t: Array | int) -> tuple[Array, Float[Array, ""]]:
        """x_{t+1} and c_t, without noise that changes: the key is always the same."""
        following, cost = self.problem.step(self.join(x), self.shape_action(u), t, jax.random.key(0))
        return self.split(following), cost

    def final_cost(self, x: Float[Array, "X"]) -> Float[Array, ""]:
        """c_H."""
        return self.problem.final_cost(self.join(x))

    def follow(
        self, x: Float[Array, "X"], choose: Callable[[Array, Any], Array], inputs: Any
    ) -> tuple[Float[Array, "T X"], Float[Array, "H U"], Float[Array, ""]]:
        """A rollout under u_t = choose(x_t, inputs_t): states `[H + 1, X]`, actions, total cost."""

        def step(loop: tuple[Array, Array], now: tuple[Any, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
            x, total = loop
            u = choose(x, now[0])
            following, cost = self.step(x, u, now[1])
            return (following, total + cost), (following, u)

        start = (x, jnp.zeros((), x.dtype))
        (last, total), (states, actions) = jax.lax.scan(step, start, (inputs, jnp.arange(self.horizon)))
        return jnp.concatenate([x[None], states]), actions, total + self.final_cost(last)

    def total(self, x: Float[Array, "X"], actions: Float[Array, "H U"]) -> Float[Array, ""]:
        """J."""
        return self.follow(x, lambda _, u: u, actions)[2]

    def first_actions(self, actions: Any, dtype: Any) -> Float[Array, "H U"]:
        """A first guess as vectors: the given one, or zeros, inside the bounds. Raises `ValueError` for a guess of another shape."""
        shape = (self.horizon, *self.problem.action.shape)
        if actions is None:
            actions = jnp.zeros(shape, dtype)
        if jnp.shape(actions) != shape:
            raise ValueError(f"the first guess has shape {jnp.shape(actions)}, and {shape} actions are wanted")
        low, high = self.bounds()
        return jnp.clip(jnp.asarray(actions, dtype).reshape(self.horizon, self.controls), low[None], high[None])


@jax.jit
def finished(
    flat: FlatProblem, states: Float[Array, "T X"], actions: Float[Array, "H U"], gains: Array | None = None
) -> Plan:
    """The `Plan` of vectors, its cost counted again; with gains as they answer deviations.

    Without noise there are none but those of rounding, and on an unstable system these grow until the actions alone lead elsewhere.
    """
    if gains is None:
        cost = flat.total(states[0], actions)
    else:
        answer = lambda x, now: now[1] + now[2] @ (x - now[0])  # noqa: E731
        cost = flat.follow(states[0], answer, (states[:-1], actions, gains))[2]
    return Plan(flat.shape_action(actions), jax.vmap(flat.join)(states), cost, gains)


@jax.jit
def followed(flat: FlatProblem, x0: Float[Array, "X"], actions: Float[Array, "H U"]) -> Plan:
    """The `Plan` of actions alone."""
    return finished(flat, flat.follow(x0, lambda _, u: u, actions)[0], actions)


def _is_real(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact)


def check_dynamics(problem: Problem, state: State) -> None:
    """Raise `ValueError` unless a step leads to a state of the same shape and costs one number."""
    following, cost = jax.eval_shape(
        lambda x, u: problem.step(x, u, 0, jax.random.key(0)), state, problem.action.zeros()
    )
    shapes = lambda tree: jax.tree.map(lambda x: x.shape, tree)  # noqa: E731
    if jax.tree.structure(following) != jax.tree.structure(state) or shapes(following) != shapes(state):
        raise ValueError(f"the dynamics lead from a state of shape {shapes(state)} to one of shape {shapes(following)}")
    if shapes(cost) != ():
        raise ValueError(f"the cost of a step must be one number, not an array of shape {shapes(cost)}")


def require_finite(cost: Any, what: str) -> None:
    """Raise `ValueError` where a cost is known and no number."""
    if not isinstance(cost, Tracer) and not np.all(np.isfinite(cost)):
        raise ValueError(
            f"the cost of {what} is {float(np.max(np.asarray(cost))):g}: the dynamics or the cost give numbers that are not finite; "
            "start elsewhere, or shorten the horizon"
        )
