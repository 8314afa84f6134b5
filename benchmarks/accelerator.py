"""How fast this machine's own device trains: one table, every row a compiled program that is warm. Meant for GPUs; a CPU runs it too.

    .venv/bin/python benchmarks/accelerator.py                       all rows on JAX's default device
    JAX_PLATFORMS=cpu .venv/bin/python benchmarks/accelerator.py     the same on the CPU
    .venv/bin/python benchmarks/accelerator.py --only sac ppo        rows whose name begins so

Prints one JSON line a row: `rate` is environment steps a second, learning included, of all seeds together (searches a second for
`search`, problems a second for `ilqr`).
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import rewardtogo as rtg
from rewardtogo.runner.engine import Program

SIXTY_FOUR, WIDE = rtg.MLP(64, 64), rtg.MLP(256, 256, activation="relu")


def on_policy(learner: Any, env: str, num_envs: int, unroll: int) -> rtg.Algorithm:
    return rtg.OnPolicy(rtg.make(env, num_envs=num_envs), learner, unroll=unroll)


def off_policy(learner: Any, env: str, num_envs: int = 1, unroll: int = 1, **options: Any) -> rtg.Algorithm:
    options = {"batch_size": 256, "warm_up": 1024, **options}
    return rtg.OffPolicy(
        rtg.make(env, num_envs=num_envs), learner, rtg.UniformReplay(100_000), unroll=unroll, **options
    )


def ppo(num_envs: int, unroll: int, network: Any = SIXTY_FOUR, env: str = "CartPole-v1") -> rtg.Algorithm:
    learner = rtg.PPO(learning_rate=3e-4, epochs=4, minibatches=4, network=network)
    return on_policy(learner, env, num_envs, unroll)


def dqn() -> rtg.Algorithm:
    return off_policy(rtg.DQN(target_period=250), "CartPole-v1", unroll=4, batch_size=64)


TRAINED: dict[str, tuple[Callable[[], rtg.Algorithm], int]] = {
    "ppo CartPole, 8 environments x 128": (lambda: ppo(8, 128), 1),
    "ppo CartPole, 4096 environments x 32": (lambda: ppo(4096, 32), 1),
    "ppo CartPole, 8 x 128, 512 seeds": (lambda: ppo(8, 128), 512),
    "ppo CartPole without velocities, LSTM, 1024 x 64": (
        lambda: ppo(1024, 64, rtg.LSTM(64, SIXTY_FOUR), "CartPoleNoVel-v1"),
        1,
    ),
    "a2c CartPole, 4096 x 5": (lambda: on_policy(rtg.PolicyGradient(returns="gae"), "CartPole-v1", 4096, 5), 1),
    "trpo Pendulum, 1024 x 32": (lambda: on_policy(rtg.TRPO(network=SIXTY_FOUR), "Pendulum-v1", 1024, 32), 1),
    "dqn CartPole, 1 environment, an update every 4 steps": (dqn, 1),
    "dqn CartPole, the same, 256 seeds": (dqn, 256),
    "sac Pendulum, 256x256, an update a step": (lambda: off_policy(rtg.SAC(network=WIDE), "Pendulum-v1"), 1),
    "sac Pendulum, the same, 64 seeds": (lambda: off_policy(rtg.SAC(network=WIDE), "Pendulum-v1"), 64),
    "td3 Pendulum, 256x256, an update a step": (lambda: off_policy(rtg.TD3(network=WIDE), "Pendulum-v1"), 1),
    "pets Pendulum, 64 planning at once": (
        lambda: off_policy(rtg.ModelBased(sizes=(200, 200)), "Pendulum-v1", num_envs=64, updates=4),
        1,
    ),
}


def trained(make: Callable[[], rtg.Algorithm], seeds: int, seconds: float) -> dict[str, float]:
    """Steps a second of a program that goes on training, its median over three laps of about `seconds`."""
    keys = jax.random.key(0) if seeds == 1 else jax.random.split(jax.random.key(0), seeds)
    program = Program(make().with_horizon(10**6), keys, 10**9)
    began = time.perf_counter()
    state = program.init()
    sums = program.fresh_sums(state)
    done = 0

    def go(iterations: int) -> float:
        nonlocal state, sums, done
        started = time.perf_counter()
        state, sums, _ = program.advance(state, sums, done, done + iterations)
        jax.block_until_ready(jax.tree.leaves(state))
        done += iterations
        return (time.perf_counter() - started) / iterations

    go(2)
    compiling = time.perf_counter() - began
    iterations = max(1, int(seconds / go(3)))
    lap = statistics.median(go(iterations) for _ in range(3))
    return {"rate": program.algorithm.steps_per_iteration * seeds / lap, "compile_seconds": compiling}


def timed(function: Callable[[jax.Array], Any], number: int) -> dict[str, float]:
    """Calls of a compiled function that does `number` things at once: things a second."""
    began = time.perf_counter()
    jax.block_until_ready(function(jax.random.key(0)))
    compiling, times = time.perf_counter() - began, []
    for i in range(5):
        started = time.perf_counter()
        jax.block_until_ready(function(jax.random.key(i)))
        times.append(time.perf_counter() - started)
    return {"rate": number / statistics.median(times), "compile_seconds": compiling}


def search(roots: int = 1024, simulations: int = 64) -> dict[str, float]:
    """UCT in Connect Four from its opening position, random playouts, all roots in one program."""
    from rewardtogo.envs.board_games import ConnectFour
    from rewardtogo.planning import TreeSearch, mcts

    game, options = ConnectFour(), TreeSearch(simulations=simulations, bounds=(-1.0, 1.0))
    start = game.start(jax.random.key(0))
    one = lambda key: mcts(game, start, key, options).value.action  # noqa: E731
    return timed(jax.jit(lambda key: jax.vmap(one)(jax.random.split(key, roots))), roots)


def ilqr(problems: int = 4096) -> dict[str, float]:
    """iLQR on swing-ups of a pendulum from random states, horizon 50."""
    from rewardtogo.planning import FunctionProblem, box
    from rewardtogo.planning import ilqr as solve

    def f(x: jax.Array, u: jax.Array) -> jax.Array:
        speed = x[1] + 0.05 * (15.0 * jnp.sin(x[0]) + 3.0 * u[0])
        return jnp.stack([x[0] + 0.05 * speed, speed])

    def c(x: jax.Array, u: jax.Array) -> jax.Array:
        return 0.05 * (1.0 - jnp.cos(x[0]) + 0.1 * x[1] ** 2 + 0.01 * u[0] ** 2)

    problem = FunctionProblem(f, c, horizon=50, action=box(1, -2.0, 2.0))

    def one(key: jax.Array) -> jax.Array:
        return solve(problem, jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)).value.cost

    return timed(jax.jit(lambda key: jax.vmap(one)(jax.random.split(key, problems))), problems)


def main() -> None:
    """Measure row after row; one that fails says why and the next goes on."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[""])
    parser.add_argument("--seconds", type=float, default=2.0, help="length of a lap, of which there are three")
    given = parser.parse_args()
    device = jax.devices()[0]
    print(json.dumps({"device": device.device_kind, "platform": device.platform, "jax": jax.__version__}), flush=True)
    rows: dict[str, Callable[[], dict[str, float]]] = {
        name: lambda make=make, seeds=seeds: trained(make, seeds, given.seconds)
        for name, (make, seeds) in TRAINED.items()
    }
    rows |= {"search, Connect Four, 1024 roots x 64 simulations": search, "ilqr, pendulum, 4096 problems": ilqr}
    failed = False
    for name, measure in rows.items():
        if not name.startswith(tuple(given.only)):
            continue
        try:
            print(json.dumps({"what": name, **measure()}), flush=True)
        except Exception as error:
            failed = True
            print(json.dumps({"what": name, "error": f"{type(error).__name__}: {str(error)[:300]}"}), flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
