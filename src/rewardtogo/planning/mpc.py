r"""Model predictive control: plan, do the first action, look, plan again (notes 8.3.1; item 8.45).

    s = encode(o);   A = argmin J(s, A);   a = A_1;   next time start from A_2, ..., A_H, A_H

A plan is open-loop; replanning closes the loop (erratum E8.19). `MPC` is a `Policy`, so that whatever plays, films or evaluates policies
can do it
with a planner: its memory is the rest of the last plan, from which the next search starts.

A planner's recipe (`CrossEntropy()`, `ILQR()`, ...) holds its settings, as `MLP(64, 64)` holds those of a network.
"""

from abc import abstractmethod
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..core import Action, Carry, Configured, Number, Observation, Policy, PRNGKey, Solution, State, number, setting
from .cross_entropy import cem, mppi
from .flat import FlatProblem
from .iterated_lqr import ilqr
from .problem import ModelProblem, Problem
from .shooting import gradient_shooting, newton_shooting, random_shooting
from .sqp import collocation


class Planner(Configured):
    """A recipe for a plan."""

    @abstractmethod
    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        """A `Solution` whose value is a `Plan`, searched from a first guess where the method uses one."""


class RandomShooting(Planner):
    """The best of many random sequences."""

    samples: int = setting(1000, "sequences", at_least=1)
    law: Literal["uniform", "gaussian"] = setting(
        "uniform", "what they are drawn from", choices=("uniform", "gaussian")
    )
    particles: int = setting(1, "samples of random dynamics that a cost is the mean of", at_least=1)

    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        del guess
        return random_shooting(problem, state, key, samples=self.samples, law=self.law, particles=self.particles)


class CrossEntropy(Planner):
    """The cross-entropy method, from the last plan."""

    samples: int = setting(200, "sequences in a generation", at_least=2)
    elites: int = setting(20, "the best ones, that the next generation is like", at_least=1)
    iterations: int = setting(5, "generations", at_least=1)
    smoothing: Number = number(0.1, "share of the old parameters that stays", at_least=0, below=1)
    floor: Number = number(0.05, "least deviation, or probability of a choice", at_least=0)
    tolerance: Number = number(0.0, "stops once the spread is below it", at_least=0)
    particles: int = setting(1, "samples of random dynamics that a cost is the mean of", at_least=1)
    result: Literal["best", "mean"] = setting(
        "mean", "what is done: the best sequence seen, or the centre", choices=("best", "mean")
    )

    def __check_init__(self) -> None:
        if self.elites >= self.samples:
            raise ValueError(
                f"CrossEntropy cannot choose {self.elites} elites among {self.samples} samples: give it more samples or fewer elites"
            )

    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        return cem(
            problem, state, key, samples=self.samples, elites=self.elites, iterations=self.iterations, guess=guess,
            smoothing=self.smoothing,
            floor=self.floor, tolerance=self.tolerance, particles=self.particles, result=self.result,
        )  # fmt: skip


class PathIntegral(Planner):
    """MPPI, from the last plan."""

    samples: int = setting(200, "sequences in a generation", at_least=2)
    temperature: Number = number(1.0, "towards 0 only the best sequence counts; in units of cost", above=0)
    iterations: int = setting(3, "generations", at_least=1)
    floor: Number = number(0.2, "least deviation, or probability of a choice", at_least=0)
    particles: int = setting(1, "samples of random dynamics that a cost is the mean of", at_least=1)

    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        return mppi(
            problem, state, key, samples=self.samples, temperature=self.temperature, iterations=self.iterations, guess=guess,
            floor=self.floor, particles=self.particles,
        )  # fmt: skip


class GradientShooting(Planner):
    """Adam on the actions, through the dynamics."""

    iterations: int = setting(100, "gradient steps", at_least=1)

    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        del key
        return gradient_shooting(problem, state, guess, iterations=self.iterations)


class NewtonShooting(Planner):
    """Newton's method on the actions."""

    iterations: int = setting(20, "steps", at_least=1)
    gauss_newton: bool = setting(False, "leave out the second derivatives of the dynamics")

    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        del key
        return newton_shooting(problem, state, guess, iterations=self.iterations, gauss_newton=self.gauss_newton)


class ILQR(Planner):
    """Iterated regulators, or differential dynamic programming. A little noise on the guess leaves points of rest."""

    iterations: int = setting(50, "regulators at most", at_least=1)
    ddp: bool = setting(False, "with the second derivatives of the dynamics")
    noise: Number = number(0.01, "deviation of noise on the first guess", at_least=0)

    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        return ilqr(problem, state, _shaken(guess, self.noise, key), iterations=self.iterations, ddp=self.ddp)


class Collocation(Planner):
    """Sequential quadratic programming over states and actions, from the states that the last plan leads to."""

    iterations: int = setting(50, "quadratic programmes at most", at_least=1)
    noise: Number = number(0.01, "deviation of noise on the first guess", at_least=0)

    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        guess = _shaken(guess, self.noise, key)
        flat, x0 = FlatProblem.of(problem, state)
        actions = flat.first_actions(guess, x0.dtype)
        states = flat.follow(x0, lambda _, u: u, actions)[0]
        return collocation(problem, state, guess, states, iterations=self.iterations)


def _shaken(guess: Action, sd: Number, key: PRNGKey) -> Action:
    """A guess that rests nowhere by accident, such as a pendulum that hangs."""
    return (
        guess + sd * jax.random.normal(key, guess.shape, guess.dtype)
        if jnp.issubdtype(guess.dtype, jnp.inexact)
        else guess
    )


class Warm(eqx.Module):
    """The memory of an `MPC`: the last plan, and how many of its actions are done."""

    actions: Action
    done: Int[Array, ""]
    planned: Bool[Array, ""]


class MPC(Policy):
    """Plans in `problem.model` from every observation and does the first action.

    - `problem`: a `ModelProblem`: the model, the horizon, the actions and what is to be paid in the end.
    - `every`: actions of a plan that are done before the next is made (item 8.46); 1 replans at each step.
    """

    problem: ModelProblem
    planner: Planner
    every: int = eqx.field(default=1, static=True)

    def __check_init__(self) -> None:
        if not 1 <= self.every <= self.problem.horizon:
            raise ValueError(
                f"a plan of {self.problem.horizon} actions can be followed for 1 to {self.problem.horizon} of them, not for {self.every}"
            )

    def init(self, key: PRNGKey) -> Carry:
        del key
        zeros = self.problem.action.clip(self.problem.action.zeros())
        actions = jnp.broadcast_to(zeros, (self.problem.horizon, *zeros.shape))
        return Warm(actions, jnp.zeros((), jnp.int32), jnp.zeros((), bool))

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        replan = ~carry.planned | (carry.done >= self.every)
        state = self.problem.model.encode(observation)

        def plan(warm: Warm) -> Warm:
            solution = self.planner(self.problem, state, shifted(warm.actions, warm.done), key)
            return Warm(solution.value.actions, jnp.zeros((), jnp.int32), jnp.ones((), bool))

        warm = plan(carry) if self.every == 1 else jax.lax.cond(replan, plan, lambda warm: warm, carry)
        action = warm.actions[warm.done]
        return Warm(warm.actions, warm.done + 1, warm.planned), action, {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        state = self.problem.model.encode(observation)
        solution = self.planner(self.problem, state, shifted(carry.actions, carry.done), jax.random.key(0))
        return {"value": -solution.value.cost, "mean": solution.value.actions[0]}


def shifted(actions: Action, done: Array | int) -> Action:
    """What is left of a plan after some of its actions, the last one repeated."""
    return jax.tree.map(lambda x: x[jnp.minimum(jnp.arange(len(x)) + done, len(x) - 1)], actions)


PLANNERS: dict[str, tuple[type[Planner], dict[str, Any]]] = {
    "random_shooting": (RandomShooting, {}),
    "cem": (CrossEntropy, {}),
    "mppi": (PathIntegral, {}),
    "gradient_shooting": (GradientShooting, {}),
    "newton_shooting": (NewtonShooting, {}),
    "ilqr": (ILQR, {}),
    "ddp": (ILQR, {"ddp": True}),
    "collocation": (Collocation, {}),
}
"""Recipes by name, and what a name sets."""
