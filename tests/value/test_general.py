"""The general view of Q-learning: presets of one learner and one loop, against Algorithms 9 to 13 written out."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import Transition
from rewardtogo.envs.tabular import MDP, TabularEnv
from rewardtogo.figures import q_processes
from rewardtogo.nn.optimise import towards
from rewardtogo.value import general

KEY = jax.random.key(0)
GAMMA, RATE = 0.5, 0.125
"""Powers of two, so that multiplying by them rounds nothing and the order of multiplications cannot show."""
SIZES: dict[str, Any] = {"capacity": 16, "batch_size": 4, "warm_up": 8}


def small_problem() -> MDP:
    """Four states, three actions, one end."""
    rng = np.random.default_rng(5)
    return MDP(rng.dirichlet(np.ones(4), (4, 3)), rng.normal(size=(4, 3)), 0, GAMMA, np.arange(4) == 3)


ENV = rtg.vectorize(TabularEnv(small_problem()), 1)
LEARNER = rtg.DQN(
    network=rtg.MLP(), learning_rate=RATE, optimiser="sgd", gamma=GAMMA, epsilon=0.25, huber=1e9, max_grad_norm=1e9
)
ALGORITHMS: dict[str, Callable[[], rtg.OffPolicy]] = {
    "9": lambda: general.fitted_q_iteration(ENV, LEARNER, data=12, iterations=3, gradient_steps=5, batch_size=4),
    "10": lambda: general.online_q_learning(ENV, LEARNER),
    "11": lambda: general.replay_q_learning(ENV, LEARNER, collect=4, updates=4, **SIZES),
    "12": lambda: general.target_q_learning(ENV, LEARNER, visits=3, collect=2, updates=4, **SIZES),
    "13": lambda: general.deep_q_learning(ENV, LEARNER, period=7, **SIZES),
}


class Stream:
    """What a run of an algorithm saw and became: blocks of steps, keys of the batches, the parameters after each iteration."""

    def __init__(self, algorithm: rtg.OffPolicy, iterations: int):
        def one(state: Any, key: jax.Array) -> tuple[Any, Any]:
            after, _ = algorithm.step(state, key)
            rows = (state.replay.position + jnp.arange(algorithm.unroll)) % state.replay.storage.reward.shape[0]
            block = jax.tree.map(lambda x: x[rows, 0], after.replay.storage)
            return after, (block, after.learner.network, after.learner.target)

        keys = jax.vmap(lambda i: jax.random.fold_in(KEY, i))(jnp.arange(iterations))
        state = jit(lambda k: algorithm.init(k))(KEY)
        self.start = state
        _, (self.blocks, self.networks, self.targets) = jax.device_get(
            jit(lambda s, k: jax.lax.scan(one, s, k))(state, keys)
        )
        learn_keys = jax.vmap(lambda k: jax.random.split(k)[1])(keys)
        split = lambda k: jax.random.split(k, algorithm.updates) if algorithm.updates > 1 else k[None]  # noqa: E731
        sample = jax.vmap(jax.vmap(lambda k: jax.random.split(k)[0]))(jax.vmap(split)(learn_keys))
        self.batch_keys = sample
        rows = state.replay.storage.reward.shape[0]
        first = int(state.replay.position) if int(state.replay.filled) == rows else 0
        order = [(first + i) % rows for i in range(int(state.replay.filled))]
        self.memory = [jax.tree.map(lambda x: np.asarray(x[i, 0]), state.replay.storage) for i in order]  # noqa: B023


@functools.cache
def stream(name: str, iterations: int) -> Stream:
    return Stream(ALGORITHMS[name](), iterations)


@functools.cache
def piece() -> tuple[Any, Any]:
    """The two lines that all algorithms share: set y, and take a step down the error."""

    def q(phi: Any, s: jax.Array) -> jax.Array:
        return phi.head.layers[0].weight[:, s] + phi.head.layers[0].bias

    def target(phi: Any, t: Transition) -> jax.Array:
        return t.reward + GAMMA * (1.0 - t.terminated) * jax.vmap(lambda s: q(phi, s).max())(t.next_observation)

    def regress(phi: Any, t: Transition, y: jax.Array) -> Any:
        def loss(phi: Any) -> jax.Array:
            chosen = jax.vmap(q, (None, 0))(phi, t.observation)[jnp.arange(len(y)), t.action]
            return (0.5 * (chosen - y) ** 2).mean()

        return jax.tree.map(lambda p, g: p - RATE * g, phi, jax.grad(loss)(phi))

    return jit(target), jit(regress)


@functools.partial(jax.jit, static_argnums=1)
def places_drawn(key: jax.Array, size: int, filled: int) -> jax.Array:
    return jax.random.randint(key, (size,), 0, filled)


class Buffer:
    """A list of the last `capacity` steps; draws as the library's replay does from a ring of the same size."""

    def __init__(self, steps: list[Transition], capacity: int):
        self.steps, self.capacity, self.written = list(steps), capacity, len(steps)

    def add(self, block: Transition) -> None:
        for i in range(len(block.reward)):
            self.steps.append(jax.tree.map(lambda x: x[i], block))  # noqa: B023
            self.written += 1
        self.steps = self.steps[-self.capacity :]

    def draw(self, key: jax.Array, size: int) -> Transition:
        places = np.asarray(places_drawn(key, size, len(self.steps)))
        oldest = self.written % self.capacity if len(self.steps) == self.capacity else 0
        found = [self.steps[(place - oldest) % self.capacity] for place in places]
        return jax.tree.map(lambda *x: np.stack(x), *found)


def written_out(name: str, iterations: int) -> tuple[list[Any], list[Any]]:
    """Parameters and targets after each iteration of the algorithm, as the notes write it, on the recorded stream."""
    run, loop, (target, regress) = stream(name, iterations), ALGORITHMS[name](), piece()
    block = lambda i: jax.tree.map(lambda x: x[i], run.blocks)  # noqa: E731
    phi = old = jax.tree.map(jnp.asarray, run.start.learner.network)
    buffer = Buffer(run.memory, loop.replay.capacity)
    found: tuple[list[Any], list[Any]] = ([], [])
    updates = 0
    for i in range(iterations):
        if name in ("9", "10"):
            buffer = Buffer([], loop.replay.capacity)  # the new data replace the old
            buffer.written = loop.replay.capacity
        buffer.add(block(i))
        for j in range(loop.updates):
            batch = buffer.draw(run.batch_keys[i, j], loop.batch_size)
            if name in ("10", "11"):
                phi = regress(phi, batch, target(phi, batch))
                old = phi
            else:
                every = {"9": 5, "12": 3 * 4, "13": 7}[name]
                phi = regress(phi, batch, target(old, batch))
                updates += 1
                old = phi if updates % every == 0 else old
        found[0].append(phi)
        found[1].append(old)
    return found


def differing(one: Any, other: Any) -> int:
    """In how many numbers two trees differ, bit for bit."""
    bits = lambda x: np.asarray(x, np.float32).view(np.int32)  # noqa: E731
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return sum(int((bits(x) != bits(y)).sum()) for x, y in pairs)


def stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *trees)


@pytest.mark.parametrize(("name", "iterations"), [("9", 6), ("10", 60), ("11", 15), ("12", 20), ("13", 60)])
def test_presets_are_the_algorithms_as_written(name, iterations, item):
    run = stream(name, iterations)
    phi, old = written_out(name, iterations)
    moved = np.abs(run.networks.head.layers[0].weight[-1] - np.asarray(run.start.learner.network.head.layers[0].weight))
    assert moved.max() > 0.05
    with item({"11": "6.3", "12": "6.5"}.get(name, "6.9")) as check:
        check(
            differing(stacked(phi), run.networks),
            "==",
            0,
            f"Algorithm {name}: numbers of phi that differ from the written form",
        )
        check(differing(stacked(old), run.targets), "==", 0, f"Algorithm {name}: numbers of phi' that differ")


def test_one_update_a_visit_makes_algorithm_12_into_13(item):
    """Algorithm 12 written out as its three nested loops with K = 1, against a run of Algorithm 13."""
    steps, period = 1000, 50
    loop = general.deep_q_learning(ENV, LEARNER, period=period, **SIZES)
    assert general.Rates.of(loop) == general.Rates.of(general.target_q_learning(ENV, LEARNER, visits=period, **SIZES))
    run, (target, regress) = Stream(loop, steps), piece()
    phi, buffer, found = jax.tree.map(jnp.asarray, run.start.learner.network), Buffer(run.memory, 16), []
    for outer in range(steps // period):
        old = phi
        for visit in range(period):
            i = outer * period + visit
            buffer.add(jax.tree.map(lambda x: x[i], run.blocks))  # noqa: B023
            for _ in range(1):
                batch = buffer.draw(run.batch_keys[i, 0], loop.batch_size)
                phi = regress(phi, batch, target(old, batch))
            found.append(phi)
    with item("6.10") as check:
        check(differing(stacked(found), run.networks), "==", 0, "1000 steps, numbers of phi that differ")
        check(len(np.unique(run.networks.head.layers[0].bias[:, 0])), ">", 500, "different values phi took")


def test_a_target_stands_still_between_copies(item):
    """Algorithm 13 with a period of 7: y is bit-constant for 7 updates, and the copies come on time."""
    run = stream("13", 60)
    weight = run.targets.head.layers[0].weight.reshape(60, -1)
    changed = [0, *(i for i in range(1, 60) if not np.array_equal(weight[i], weight[i - 1]))]
    with item("6.4") as check:
        check(float(np.abs(np.diff([c for c in changed if c]) - 7).max()), "==", 0, "updates between copies, less 7")
        copied = lambda tree: jax.tree.map(lambda x: x[[6, 13]], tree)  # noqa: E731
        check(differing(copied(run.networks), copied(run.targets)), "==", 0, "the copy is exact")
    rates = general.Rates.of(ALGORITHMS["12"]())
    with item("6.5") as check:
        check(rates.move, "==", 12, "updates between copies of Algorithm 12, N K = 3 * 4")
        check(rates.steps_per_move, "==", 6, "environment steps between them, N M = 3 * 2")


@pytest.mark.usefixtures("x64")
def test_polyak_averages_forget_at_their_rate(item):
    """phi' <- p phi' + (1 - p) phi with phi held: the gap is p^k. The notes' tau is p, ours 1 - p (E6.1)."""
    p, phi = 0.999, jnp.asarray(2.0)
    step = lambda old, _: (towards(old, phi, 1 - p),) * 2  # noqa: E731
    after = jax.lax.scan(step, jnp.asarray(5.0), None, length=1000)[1]
    gap = (np.asarray(after, np.float64) - 2.0) / 3.0
    with item("6.7") as check:
        check(np.abs(gap - p ** np.arange(1, 1001)).max(), "<=", 1e-12, "gap after k updates against p^k")
        check(abs(np.log(0.5) / np.log(p) - 693), "<=", 0.5, "half-life, less 693 updates")
        wrong = 2.0 + 3.0 * (1 - p)
        check(abs(wrong - float(after[0])), ">", 1, "with p for tau the target jumps to the network at once")


def test_lag_of_targets(item):
    """How many updates old the parameters in a target are: simulated, against the closed forms."""
    period, updates = 40, 100_000
    copied = np.arange(updates) % period
    kept, weights, ages = 0.975, np.zeros(1), np.zeros(1)
    k = np.arange(2000)
    weights, ages = (1 - kept) * kept**k, k + 1.0
    with item("6.8") as check:
        rates = general.Rates(1, 1, 1, 1, period, 1.0)
        check(abs(copied.mean() / rates.mean_lag - 1), "<=", 0.01, "copies: (N - 1) / 2")
        counts = np.bincount(copied)
        check(counts.max() - counts.min(), "<=", 1, "uniform on 0 .. N - 1")
        average = general.Rates(1, 1, 1, 1, 1, 1 - kept)
        lag = (weights * (ages - 1)).sum() / weights.sum()
        check(abs(lag / average.mean_lag - 1), "<=", 0.01, "averages: p / (1 - p)")


def test_the_command_has_the_presets():
    from rewardtogo.catalogue import ALGORITHMS as ROWS

    assert ROWS["q_replay"].learner["target_period"] == 1
    row = ROWS["target_q"]
    assert row.learner["target_period"] % row.loop_options["updates"] == 0
    assert row.loop_options["updates"] > 1


def test_the_figure_marks_what_the_loops_do(item):
    """Figure 6.2: the order of events of each algorithm, and how often each process runs."""
    shown = q_processes.algorithms()
    figure = q_processes.draw(shown=shown)
    assert len(figure.axes) == 1 + len(shown)
    with item("6.9") as check:
        for name, algorithm in shown.items():
            rates = general.Rates.of(algorithm)
            collected, moved, updated = q_processes.events(rates, 480)
            check(
                abs(len(collected) / len(updated) / rates.steps_per_update - 1), "<=", 0.05, f"{name}: steps an update"
            )
            check(len(updated) // rates.move, "==", len(moved), f"{name}: moves of the target")


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="4 environments give that many at once"):
        general.online_q_learning(rtg.vectorize(TabularEnv(small_problem()), 4), LEARNER)
    with pytest.raises(ValueError, match="OffPolicyPG has no target network"):
        general.Rates.of(rtg.OffPolicy(ENV, rtg.OffPolicyPG(), rtg.UniformReplay(64)))
    with pytest.raises(ValueError, match="smaller than a batch of 64"):
        general.deep_q_learning(ENV, LEARNER, capacity=32, period=5)
