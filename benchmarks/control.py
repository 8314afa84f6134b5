"""One measurement of planning and control by this library in a process of its own; prints one JSON line.

- `ilqr NAME` solves a task of `control_task.py`, alone and 64 at once.
- `lqr`: the regulators of a thousand problems, at once by this library and one after another in NumPy.
- `cem`: one decision by the cross-entropy method through an ensemble of networks, beside the products of matrices it needs.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import control_task as task
import jax
import jax.numpy as jnp
import numpy as np
from ours import stopwatch_of

from rewardtogo.core import EnvSpec, env_spec
from rewardtogo.envs import Pendulum
from rewardtogo.model_based import ModelBased
from rewardtogo.planning import CrossEntropy, FunctionProblem, LQProblem, ilqr, lqr


def median(function: Callable[[], Any], repeats: int) -> float:
    """Seconds of a call, once it is compiled."""
    jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def problem_of(name: str) -> FunctionProblem:
    """A task as this library's problem."""
    given = task.TASKS[name]
    q, r, p, target = (jnp.asarray(v) for v in (given.q, given.r, given.p, given.target))

    def f(x: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.stack(given.f(jnp, list(x), list(u)))

    def c(x: jax.Array, u: jax.Array) -> jax.Array:
        return 0.5 * given.dt * ((q * (x - target) ** 2).sum() + (r * u**2).sum())

    return FunctionProblem(f, c, given.horizon, len(given.r), lambda x: 0.5 * (p * (x - target) ** 2).sum())


def solve(name: str, repeats: int) -> dict[str, float]:
    """A task from its start, and from 64 starts nearby in one program."""
    problem, start = problem_of(name), jnp.asarray(task.TASKS[name].start)
    one = jax.jit(lambda x: ilqr(problem, x))
    many = jax.jit(jax.vmap(lambda x: ilqr(problem, x).value.cost))
    starts = start + 0.05 * jax.random.normal(jax.random.key(0), (task.BATCH, len(start)))
    found = one(start)
    return {
        "seconds": median(lambda: one(start), repeats),
        "each": median(lambda: many(starts), repeats) / task.BATCH,
        "cost": float(found.value.cost),
        "iterations": int(found.stats["iterations"]),
    }


def regulators(repeats: int) -> dict[str, float]:
    """A thousand regulators: mapped, and by the same recursion in NumPy, one problem at a time."""
    x, u, horizon, number = task.LQR_STATES, task.LQR_ACTIONS, task.LQR_HORIZON, task.LQR_BATCH
    rng = np.random.default_rng(0)
    F = np.concatenate([np.eye(x) + 0.05 * rng.normal(size=(number, x, x)), rng.normal(size=(number, x, u))], -1)
    C, starts = np.eye(x + u), rng.normal(size=(number, x))
    stack, states = jnp.asarray(F), jnp.asarray(starts)
    ours = jax.jit(jax.vmap(lambda F, x: lqr(LQProblem(F, C, horizon), x).value.cost))

    def recursion(F: np.ndarray, state: np.ndarray) -> float:
        """Algorithm 17 as one writes it."""
        V, gains = np.zeros((x, x)), []
        for _ in range(horizon):
            Q = C + F.T @ V @ F
            K = -np.linalg.solve(Q[x:, x:], Q[x:, :x])
            V = Q[:x, :x] + Q[:x, x:] @ K + K.T @ Q[x:, :x] + K.T @ Q[x:, x:] @ K
            V = 0.5 * (V + V.T)
            gains.append(K)
        cost = 0.0
        for K in reversed(gains):
            z = np.concatenate([state, K @ state])
            cost += 0.5 * z @ C @ z
            state = F @ z
        return float(cost)

    some = 50  # a twentieth of them says how long all take

    def numpy_laps() -> tuple[float, np.ndarray]:
        began = time.perf_counter()
        costs = np.array([recursion(F[i], starts[i]) for i in range(some)])
        return (time.perf_counter() - began) * number / some, costs

    laps = [(median(lambda: ours(stack, states), 1), numpy_laps()) for _ in range(repeats)]
    error = np.abs(np.asarray(ours(stack, states))[:some] / laps[0][1][1] - 1).max()
    return {
        "seconds": statistics.median(a for a, _ in laps),
        "numpy": statistics.median(b for _, (b, _) in laps),
        "relative_error": float(error),
    }


def decide(repeats: int) -> dict[str, float]:
    """One decision by CEM through five networks of 200x200, and nothing but the products of matrices in it, in a scan."""
    spec: EnvSpec = env_spec(Pendulum())
    planner = CrossEntropy(samples=task.CANDIDATES, elites=task.ELITES, iterations=task.ROUNDS)
    learner = ModelBased(sizes=(task.WIDTH, task.WIDTH), members=task.MEMBERS, planner=planner, horizon=task.PLAN)
    state = learner.init(spec, jax.random.key(0))
    policy = learner.policy(state, explore=False)
    act = jax.jit(lambda carry, o, key: policy(carry, o, key)[:2])
    carry, observation = policy.init(jax.random.key(0)), jnp.array([1.0, 0.0, 0.0])
    inputs, outputs = task.OBSERVATION + task.ACTION, 2 * (task.OBSERVATION + 1)
    n, h = task.CANDIDATES, task.WIDTH
    shapes = task.MEMBERS * [(n, inputs, h), (n, h, h), (n, h, outputs)]
    steps = task.PLAN * task.ROUNDS
    dots = stopwatch_of(shapes, steps)
    laps = [(median(lambda: act(carry, observation, jax.random.key(1)), 1), steps * dots()) for _ in range(repeats)]
    operations = steps * sum(2 * a * b * c for a, b, c in shapes)
    seconds = statistics.median(a for a, _ in laps)
    return {
        "seconds": seconds,
        "dots": statistics.median(b for _, b in laps),
        "ratio": statistics.median(b / a for a, b in laps),
        "gflops": operations / 1e9 / seconds,
    }


def main() -> None:
    """Measure one thing."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["ilqr", "lqr", "cem"])
    parser.add_argument("name", nargs="?", choices=task.TASKS, default="pendulum")
    parser.add_argument("--repeats", type=int, default=7)
    given = parser.parse_args()
    measures = {
        "ilqr": lambda: solve(given.name, given.repeats),
        "lqr": lambda: regulators(given.repeats),
        "cem": lambda: decide(given.repeats),
    }
    print(json.dumps(measures[given.what]()))


if __name__ == "__main__":
    main()
