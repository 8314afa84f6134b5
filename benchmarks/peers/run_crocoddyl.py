"""crocoddyl's DDP on the tasks of `control_task.py`, their dynamics written by a user in Python; prints one JSON line.

The derivatives are exact: sympy's, with common subexpressions taken out, as compiled Python functions of scalars. `unicycle` is the model
that crocoddyl has in C++.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

import crocoddyl
import numpy as np
import sympy

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import control_task


class Model(crocoddyl.ActionModelAbstract):
    """One step of a task, or its end."""

    def __init__(self, task, functions, end=False):
        n, k = len(task.start), len(task.r)
        super().__init__(crocoddyl.StateVector(n), k, 0)
        self.task, self.functions, self.end = task, functions, end
        scale = 1.0 if end else task.dt
        self.weights = scale * np.array(task.p if end else task.q)
        self.effort = scale * np.array(task.r)
        self.goal = np.array(task.target)

    def calc(self, data, x, u=None):
        away = x - self.goal
        data.cost = 0.5 * float(self.weights @ (away * away))
        if self.end or u is None:
            data.xnext[:] = x
            return
        data.cost += 0.5 * float(self.effort @ (u * u))
        try:
            data.xnext[:] = self.functions[0](*x, *u)
        except (OverflowError, ValueError):  # a step that was too long; the search tries a shorter one
            data.xnext[:] = np.nan

    def calcDiff(self, data, x, u=None):
        data.Lx[:] = self.weights * (x - self.goal)
        data.Lxx[:, :] = np.diag(self.weights)
        if self.end or u is None:
            return
        data.Lu[:] = self.effort * u
        data.Luu[...] = np.diag(self.effort).reshape(data.Luu.shape)
        n = len(x)
        whole = np.array(self.functions[1](*x, *u)).reshape(n, -1)
        # A single action's derivatives have one axis.
        data.Fx[...], data.Fu[...] = whole[:, :n], whole[:, n:].reshape(data.Fu.shape)


def functions_of(task):
    """Dynamics and their Jacobian as Python functions of scalars."""
    x = list(sympy.symbols(f"x:{len(task.start)}"))
    u = list(sympy.symbols(f"u:{len(task.r)}"))
    after = sympy.Matrix(task.f(sympy, x, u))
    flat = list(after.jacobian(x + u))
    return [sympy.lambdify(x + u, e, modules="math", cse=True) for e in (list(after), flat)]


def problem_of(name):
    """The shooting problem."""
    task = control_task.TASKS[name]
    if name == "unicycle":
        running, end = crocoddyl.ActionModelUnicycle(), crocoddyl.ActionModelUnicycle()
        running.costWeights = end.costWeights = np.array([10.0, 1.0])
    else:
        functions = functions_of(task)
        running, end = Model(task, functions), Model(task, functions, end=True)
    return crocoddyl.ShootingProblem(np.array(task.start), [running] * task.horizon, end)


def main():
    """Solve, measure."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name", choices=["pendulum", "cartpole", "quadrotor", "unicycle"])
    parser.add_argument("--repeats", type=int, default=7)
    given = parser.parse_args()
    problem = problem_of(given.name)
    task = control_task.TASKS[given.name]
    solver = crocoddyl.SolverDDP(problem)
    solver.th_stop = 1e-9
    us = [np.zeros(len(task.r)) for _ in range(task.horizon)]
    times = []
    for _ in range(1 + given.repeats):
        xs = problem.rollout(us)
        began = time.perf_counter()
        solver.solve(xs, us, 200, False)
        times.append(time.perf_counter() - began)
    print(json.dumps({"seconds": statistics.median(times[1:]), "cost": solver.cost, "iterations": solver.iter}))


if __name__ == "__main__":
    main()
