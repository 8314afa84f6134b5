"""One measurement of this library in a process of its own; prints one JSON line."""

import argparse
import json
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import rewardtogo as rtg
from rewardtogo.cli.commands import use_cache
from rewardtogo.runner.engine import Program
from rewardtogo.runner.threads import used_threads

ENV = "CartPole-v1"
TWO = {"network": {"sizes": [64, 64]}}
PPO: dict[str, Any] = {"learning_rate": 3e-4, "epochs": 4, "minibatches": 4, **TWO}
EVERY_STEP: dict[str, Any] = {
    "batch_size": 256,
    "unroll": 1,
    "updates": 1,
    "warm_up": 1000,
    "replay": {"capacity": 100_000},
}
OFF: dict[str, Any] = {"batch_size": 64, "unroll": 4, "updates": 1, "warm_up": 1000, "replay": {"capacity": 100_000}}


@dataclass
class Task:
    """What is trained: the peers' scripts have the same settings."""

    algorithm: str
    learner: dict[str, Any]
    loop: dict[str, Any]
    num_envs: int = 8
    env: str = ENV


TRAINED = {
    "ppo": Task("ppo", PPO, {"unroll": 128}),
    "dqn": Task("dqn", {"learning_rate": 1e-3, "target_period": 250}, OFF, num_envs=1),
    "a2c": Task("a2c", TWO, {"unroll": 5}),
    # 160 steps of the value function a rollout, as sb3-contrib takes: ten passes of 128 samples each.
    "trpo": Task("trpo", {"value_epochs": 10, "minibatches": 16, "cg_iterations": 15, **TWO}, {"unroll": 256}),
    "recurrent": Task(
        "ppo",
        {"learning_rate": 3e-4, "epochs": 4, "minibatches": 4, "network": {"class": "lstm", "size": 64}},
        {"unroll": 128},
        env="CartPoleNoVel-v1",
    ),
    **{
        name: Task(name, {"network": {"sizes": [256, 256]}}, EVERY_STEP, num_envs=1, env="Pendulum-v1")
        for name in ("sac", "td3")
    },
}


def algorithm(name: str, capacity: int = 100_000) -> rtg.Algorithm:
    """The algorithm of a row, put together."""
    if name in ("sac", "td3"):
        learner = {"sac": rtg.SAC, "td3": rtg.TD3}[name](network=rtg.MLP(256, 256, activation="relu"))
        env, replay = rtg.make("Pendulum-v1", num_envs=1), rtg.UniformReplay(capacity)
        whole = rtg.OffPolicy(env, learner, replay, batch_size=256, unroll=1, warm_up=1000)
    elif name == "ppo":
        learner = rtg.PPO(learning_rate=3e-4, epochs=4, minibatches=4, network=rtg.MLP(64, 64))
        whole = rtg.OnPolicy(rtg.make(ENV, num_envs=8), learner, unroll=128)
    else:
        replay = rtg.UniformReplay(capacity)
        learner = rtg.DQN(learning_rate=1e-3, target_period=250)
        whole = rtg.OffPolicy(rtg.make(ENV, num_envs=1), learner, replay, batch_size=64, unroll=4, warm_up=1000)
    return whole.with_horizon(10_000)


def train(given: argparse.Namespace) -> dict[str, Any]:
    """A whole run with its folder, metrics and evaluations: steps a second as the library itself reports them."""
    seen: list[tuple[int, float, float]] = []
    task = TRAINED[given.name]
    with tempfile.TemporaryDirectory() as folder:
        run = rtg.train(
            task.algorithm,
            task.env,
            steps=given.steps + task.loop.get("warm_up", 0),
            seed=given.seed,
            num_envs=task.num_envs,
            out=f"{folder}/run",
            backend=given.backend,
            preset="none",
            learner=task.learner,
            loop=task.loop,
            callbacks=[lambda moment: seen.append((moment.env_steps, moment.seconds, moment.compile_seconds))],
            quiet=True,
        )
    # The first chunk, a single iteration, is the warm-up.
    (first_steps, first_seconds, _), (steps, seconds, compile_seconds) = seen[0], seen[-1]
    return {
        "rate": (steps - first_steps) / (seconds - first_seconds),
        "return": run.evaluation["return_mean"],
        "compile_seconds": compile_seconds,
    }


def clock(program: Program, iterations: int) -> Callable[[], float]:
    """A function that goes on training and says how long an iteration took; compiled and warm."""
    state = program.init()
    state, sums, _ = program.advance(state, program.fresh_sums(state), 0, 2)
    now = [state, sums, 2]

    def lap() -> float:
        started = time.perf_counter()
        now[0], now[1], _ = program.advance(now[0], now[1], now[2], now[2] + iterations)
        now[2] += iterations
        return (time.perf_counter() - started) / iterations

    return lap


def seeds(given: argparse.Namespace) -> dict[str, Any]:
    """64 seeds in one program against 64 runs of one seed, one after another."""
    number = 64
    whole = algorithm(given.name)
    keys = jax.vmap(jax.random.key)(np.arange(number))
    few, many = (4, 60) if given.name == "ppo" else (100, 2000)
    rows = 10**6
    together = clock(Program(whole, keys, rows), few)
    alone = clock(Program(whole, keys[0], rows), many)
    # In turns, so that a busy moment of the machine hits both.
    laps = [(together(), alone()) for _ in range(given.repeats)]
    times = [statistics.median(side) for side in zip(*laps, strict=True)]
    return {"together": times[0], "alone": number * times[1], "ratio": times[0] / (number * times[1])}


def door(given: argparse.Namespace) -> dict[str, Any]:
    """Milliseconds of one step of 8 environments: through the door inside a compiled loop, and in a plain Python loop."""
    import gymnasium
    from gymnasium.vector import AutoresetMode, SyncVectorEnv

    steps, number = 2000, 8
    env = rtg.GymnasiumEnv(ENV, number)
    make = lambda: gymnasium.make(ENV, disable_env_checker=True)  # noqa: E731
    plain = SyncVectorEnv([make] * number, autoreset_mode=AutoresetMode.DISABLED)

    @jax.jit
    def program(key: jax.Array) -> Any:
        keys = jax.random.split(key, number)

        def body(i: jax.Array, loop: tuple) -> tuple:
            state, _, total = loop
            state, step = env.step(state, jax.numpy.full(number, i % 2, jax.numpy.int32), keys)
            return state, step.observation, total + step.reward.sum()

        return jax.lax.fori_loop(0, steps, body, (*env.reset(keys), 0.0))

    def through() -> float:
        started = time.perf_counter()
        jax.block_until_ready(program(jax.random.key(given.seed)))
        return 1e3 * (time.perf_counter() - started) / steps

    def outside() -> float:
        plain.reset(seed=given.seed)
        started = time.perf_counter()
        for i in range(steps):
            _, _, terminated, truncated, _ = plain.step(np.full(number, i % 2))
            done = terminated | truncated
            if done.any():
                plain.reset(options={"reset_mask": done})
        return 1e3 * (time.perf_counter() - started) / steps

    through()
    laps = [(through(), outside()) for _ in range(given.repeats)]
    # The difference of neighbours: the load of a shared machine moves slowly.
    return {
        "through": statistics.median(a for a, _ in laps),
        "plain": statistics.median(b for _, b in laps),
        "door": statistics.median(a - b for a, b in laps),
    }


def start(given: argparse.Namespace) -> dict[str, Any]:
    """Seconds of `init` and of the first chunk in this fresh process, with the command's cache."""
    use_cache()
    program = Program(algorithm(given.name), jax.random.key(given.seed), 1)
    jax.block_until_ready(program.key)
    began = time.perf_counter()
    state = program.init()
    initial = time.perf_counter() - began
    program.advance(state, program.fresh_sums(state), 0, 1)
    return {"init": initial, "seconds": time.perf_counter() - began}


def memory(given: argparse.Namespace) -> dict[str, Any]:
    """Peak memory of a run with a replay of a million transitions, and how much of it is arrays."""
    state, _ = rtg.run(algorithm("dqn", capacity=1_000_000), jax.random.key(given.seed), given.steps // 4)
    arrays = sum(
        (jax.random.key_data(x) if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key) else x).nbytes
        for x in jax.tree.leaves(state)
    )
    # Linux counts in kilobytes, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return {"peak": peak / 1e6, "arrays": arrays / 1e6, "beside": (peak - arrays) / 1e6}


def products(name: str) -> list[tuple[tuple[int, int, int], float]]:
    """The products of matrices `(m, k, n)` that a step of SAC or TD3 cannot do without, and how many of each a step takes.

    Two critics of 4 inputs, an actor of 3; a hidden width of 256 and a batch of 256; TD3's actor learns in every other step.
    """
    n, h, outputs = 256, 256, 2 if name == "sac" else 1
    forward = lambda inputs, outputs: [(n, inputs, h), (n, h, h), (n, h, outputs)]  # noqa: E731
    weights = lambda inputs, outputs: [(inputs, n, h), (h, n, h), (h, n, outputs)]  # noqa: E731
    inside = lambda outputs: [(n, h, h), (n, outputs, h)]  # noqa: E731
    targets = forward(3, outputs) + 2 * forward(4, 1)
    critics = 2 * (forward(4, 1) + weights(4, 1) + inside(1))
    judges, share = (2, 1.0) if name == "sac" else (1, 0.5)
    actor = forward(3, outputs) + weights(3, outputs) + inside(outputs)
    actor += judges * (forward(4, 1) + inside(1) + [(n, h, 1)])  # down to the action
    return [(shape, 1.0) for shape in targets + critics] + [(shape, share) for shape in actor]


def stopwatch_of(shapes: list[tuple[int, int, int]], length: int) -> Callable[[], float]:
    """Seconds of one `jnp.dot` of each shape, one after another in a scan, every result kept."""
    keys = jax.random.split(jax.random.key(0), 2 * len(shapes))
    left = [jax.random.normal(k, (m, inner)) for k, (m, inner, _) in zip(keys[::2], shapes, strict=True)]
    right = [jax.random.normal(k, (inner, n)) for k, (_, inner, n) in zip(keys[1::2], shapes, strict=True)]

    @jax.jit
    def program(left: Any, right: Any) -> Any:
        def body(loop: Any, _: None) -> Any:
            left, old = loop
            # A number of the last results goes into the operands, so that nothing can be taken out of the loop.
            left = [a.at[0, 0].set(1e-3 * y[0, 0]) for a, y in zip(left, old, strict=True)]
            return (left, [jax.numpy.dot(a, b) for a, b in zip(left, right, strict=True)]), None

        first = [jax.numpy.dot(a, b) for a, b in zip(left, right, strict=True)]
        return jax.lax.scan(body, (left, first), None, length=length)[0]

    jax.block_until_ready(program(left, right))

    def lap() -> float:
        started = time.perf_counter()
        jax.block_until_ready(program(left, right))
        return (time.perf_counter() - started) / length

    return lap


def dots(given: argparse.Namespace) -> dict[str, Any]:
    """A whole step of SAC or TD3 (act, store, draw, learn) against nothing but the products of matrices that it needs."""
    step = clock(Program(algorithm(given.name), jax.random.key(given.seed), 10**6), 200)
    needed = products(given.name)
    always = stopwatch_of([shape for shape, share in needed if share == 1.0], 200)
    sometimes = [shape for shape, share in needed if share < 1.0]
    rest = stopwatch_of(sometimes, 200) if sometimes else lambda: 0.0
    share = min(share for _, share in needed)
    laps = [(step(), always() + share * rest()) for _ in range(given.repeats)]
    operations = sum(2 * m * k * n * share for (m, k, n), share in needed)
    # Neighbours in time are compared: the load of a shared machine moves slowly.
    return {
        "step_ms": 1e3 * statistics.median(a for a, _ in laps),
        "dots_ms": 1e3 * statistics.median(b for _, b in laps),
        "ratio": statistics.median(b / a for a, b in laps),
        "gflops": operations / 1e9 / statistics.median(a for a, _ in laps),
    }


def dp(given: argparse.Namespace) -> dict[str, Any]:
    """Seconds of value iteration on the process that `peers/run_dp.py` solves: stopped by the norm, by bounds, and with compilation."""
    from rewardtogo.envs.sparse import SparseMDP
    from rewardtogo.value import value_iteration

    states, actions, width = 10_000, 10, 10
    rng = np.random.default_rng(0)
    successors = rng.integers(0, states, (states, actions, width))
    probabilities = rng.dirichlet(np.ones(width), (states, actions))
    problem = SparseMDP(successors, probabilities, rng.normal(size=(states, actions)), discount=0.95)
    found: dict[str, Any] = {}
    for stop in ("norm", "bounds"):
        times = []
        for _ in range(1 + given.repeats):
            began = time.perf_counter()
            solution = value_iteration(problem, tolerance=0.01, stop=stop)
            times.append(time.perf_counter() - began)
        found |= {
            stop: statistics.median(times[1:]),
            f"{stop}_first": times[0],
            f"{stop}_sweeps": int(solution.stats["sweeps"]),
        }
    return {**found, "value": float(solution.value.values.mean())}


def mcts(given: argparse.Namespace) -> dict[str, Any]:
    """Seconds of a search by PUCT in the positions of `search_task.py`, all of them in one program."""
    import search_task as task

    from rewardtogo.planning import PUCT, Guided, TreeSearch, mcts

    key = jax.random.key(0)
    search = TreeSearch(
        simulations=task.SIMULATIONS, rule=PUCT(noise=0.25), guide=Guided(task.network(key)), bounds=(-1.0, 1.0)
    )

    @jax.jit
    def decide(states: Any, key: jax.Array) -> Any:
        def one(state: Any, key: jax.Array) -> Any:
            found = mcts(task.GAME, state, key, search).value
            return found.action, found.probabilities

        return jax.vmap(one)(states, jax.random.split(key, task.ROOTS))

    states, times = task.roots(key), []
    jax.block_until_ready(decide(states, key))
    for i in range(given.repeats):
        began = time.perf_counter()
        jax.block_until_ready(decide(states, jax.random.key(i)))
        times.append(time.perf_counter() - began)
    return {"seconds": statistics.median(times)}


TASKS = {
    "train": train,
    "dots": dots,
    "dp": dp,
    "mcts": mcts,
    "seeds": seeds,
    "door": door,
    "start": start,
    "memory": memory,
}


def main() -> None:
    """Measure one thing."""
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("name", nargs="?", choices=TRAINED, default="ppo")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--backend", default="jax")
    given = parser.parse_args()
    if given.task != "seeds" and used_threads() is None:
        rtg.use_threads(1)  # as `rtg train` does for one seed
    print(json.dumps(TASKS[given.task](given)))


if __name__ == "__main__":
    main()
