"""Training an `Algorithm`: one compiled program for any number of iterations, called in chunks of about a second.

Everything that is not mathematics happens between chunks: progress, metrics, checkpoints, evaluation, callbacks, interrupts, checks
for NaN. Where a chunk ends does not show in any result: rows of metrics end at fixed iterations, and iteration i always uses
`fold_in(key, i)`, which makes resuming exact.
"""

import dataclasses
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Key

from ..core import Algorithm, Episodes, State
from ..envs.gymnasium import EnvironmentFailure, failure_of, hosted

ROWS_PER_CHUNK = 128
"""Rows of metrics that one call of the program can give back."""
LARGE = 2**20
"""Bytes from which an array is donated to the program, so that it is changed in place (a replay). Donating everything would lose
the state with a chunk that fails, and not donating small arrays costs nothing to speak of."""


STEPS_AT_ONCE = 16_384
"""Environment steps that the seeds of a program make side by side in an iteration: what more of them touch no longer fits the caches."""


class NonFinite(RuntimeError):
    """A loss or a parameter is no longer a number."""


@dataclasses.dataclass
class Moment:
    """What a callback sees between two chunks.

    `state` is the algorithm's (with a leading axis of seeds where several train at once), `rows` are the rows of metrics finished
    since the last moment, `iteration` counts finished iterations, `seconds` is the
    time spent training, without compilation, evaluation and callbacks.
    """

    algorithm: Algorithm
    state: State
    sums: Array
    iteration: int
    iterations: int
    rows: list[dict[str, Any]]
    seconds: float
    compile_seconds: float

    @property
    def env_steps(self) -> int:
        """Environment steps so far (gradient steps offline)."""
        return steps_after(self.algorithm, self.iteration)


Callback = Callable[[Moment], bool | None]


@dataclasses.dataclass
class Every:
    """A callback that must be called exactly after every `iterations` iterations; others are called between any two chunks."""

    iterations: int
    callback: Callback


def steps_after(algorithm: Algorithm, iteration: int) -> int:
    """Environment steps taken after so many iterations, warm-up included."""
    return algorithm.initial_steps + iteration * algorithm.steps_per_iteration


def iterations_for(algorithm: Algorithm, steps: int) -> int:
    """The whole number of iterations that takes at least `steps` steps, and at least one."""
    return max(1, math.ceil((steps - algorithm.initial_steps) / algorithm.steps_per_iteration))


def by_groups(function: Callable, seeds: Any, most: int) -> Any:
    """`function` of each seed: all side by side, or where they are more than `most` in groups of equal size, one after another."""
    count = len(jax.tree.leaves(seeds)[0])
    group = max(size for size in range(1, min(count, most) + 1) if count % size == 0)
    if count <= most or group < most // 2:
        return jax.vmap(function)(seeds)
    # Not `lax.map(batch_size=...)`, which cannot take arrays without elements.
    apart = jax.tree.map(lambda x: x.reshape(count // group, group, *x.shape[1:]), seeds)
    done = jax.lax.map(jax.vmap(function), apart)
    return jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), done)


class Program:
    """The compiled functions of one algorithm: `init`, `advance` by any number of iterations, and `check` for NaN.

    `key` has shape `()`, or `[K]` to train K seeds at once: then every array of the state has a leading axis `K`.
    """

    def __init__(self, algorithm: Algorithm, key: Key[Array, "..."], row_every: int):
        self.algorithm, self.key, self.row_every = algorithm, key, row_every
        self.batched = key.ndim == 1
        if self.batched and hosted(algorithm):
            raise ValueError(
                "several seeds cannot share one compiled program with a Gymnasium environment: train them one after "
                "another, or use an environment with a compiled twin (`rtg list --envs`)"
            )
        self.compile_seconds = 0.0
        self._names: list[str] = []
        self._advance: Any = None
        # Compiled functions of one seed: JAX keeps what it traced, so that a trial costs the real program nothing.
        # The key of `init` lies outside the range of iterations, so that no iteration repeats it.
        self._init = jax.jit(lambda algorithm, key: algorithm.init(jax.random.fold_in(key, 2**31 - 1)))
        self._step = jax.jit(lambda algorithm, state, key: algorithm.step(state, key))

    def _init_all(self, algorithm: Algorithm, key: Array) -> State:
        return jax.vmap(self._init, in_axes=(None, 0))(algorithm, key) if self.batched else self._init(algorithm, key)

    def _compile(self, function: Callable, *arguments: Any, **options: Any) -> Any:
        began = time.perf_counter()
        compiled = self.guarded(lambda: jax.jit(function, **options).lower(*arguments).compile())
        self.compile_seconds += time.perf_counter() - began
        return compiled

    def trial(self) -> None:
        """Go through one iteration without computing it: what cannot be is refused before anything is compiled or written.

        Raises `ValueError` for what the algorithm refuses, and for a state that is larger than the machine's memory.
        """
        try:
            state = self.shapes()
            self._learn_names(state)
        except OverflowError as error:
            raise ValueError(
                f"a size among the options is too large to count with, give smaller ones: {error}"
            ) from error
        size = sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(state))
        memory = _memory()
        if memory is not None and size > memory:
            raise ValueError(
                f"what is to be trained takes {size / 1e9:,.1f} GB and this machine has {memory / 1e9:,.1f} GB: make the "
                "network, the replay, or the number of environments or seeds smaller"
            )

    def shapes(self) -> State:
        """Structure, shapes and types of the state, without computing it."""
        return jax.eval_shape(self._init_all, self.algorithm, self.key)

    def init(self) -> State:
        """A fresh state: one compiled program, because op by op costs seconds."""
        # It runs once, so that optimising it would cost more than it saves.
        quickly = {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else None
        ahead = threading.Thread(target=self._compile_ahead)
        # Asked here: another thread does not see the mesh of this one.
        alone = jax.sharding.get_mesh().empty and not hosted(self.algorithm)
        if alone:
            ahead.start()
        try:
            program = self._compile(self._init_all, self.algorithm, self.key, compiler_options=quickly)
            state = self.guarded(lambda: program(self.algorithm, self.key))
        finally:
            began = time.perf_counter()
            if alone:
                ahead.join()
            self.compile_seconds += time.perf_counter() - began
        return state

    def _compile_ahead(self) -> None:
        """Compile `advance` from shapes alone, beside `init`. What fails here is met again, and told, where it is called."""
        try:
            state = self.shapes()
            self._advance = self._compile_advance(state, self.fresh_sums(state))
        except Exception:
            self._advance = None

    def fresh_sums(self, state: State) -> Array:
        """Sums of a row of metrics in which nothing has happened: `[M]`, or `[K, M]`."""
        self._learn_names(state)
        return jnp.zeros((*self.key.shape, len(self._names)))

    def _learn_names(self, state: State) -> None:
        if not self._names:
            one = lambda tree: jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), tree)  # noqa: E731
            state, key = (one(state), one(self.key)) if self.batched else (state, self.key)
            metrics, _ = jax.eval_shape(self._step, self.algorithm, state, key)[1]
            self._names = [*sorted(metrics), *(f.name for f in dataclasses.fields(Episodes))]

    def advance(self, state: State, sums: Array, start: int, stop: int) -> tuple[State, Array, np.ndarray]:
        """Iterations `start` to `stop` (at most `ROWS_PER_CHUNK` rows): new state, sums of the unfinished row, table of finished rows."""
        big, small = _split(jax.tree.leaves(state))
        if self._advance is None:
            began = time.perf_counter()
            self._advance = self.guarded(lambda: self._compile_advance(state, sums))
            self.compile_seconds += time.perf_counter() - began
        new, sums, table = self.guarded(
            lambda: self._advance(self.algorithm, big, small, sums, self.key, start, stop, self.row_every)
        )
        # Rows first, whatever the number of seeds: [R, M], or [R, M, K].
        table = np.moveaxis(np.asarray(table), 0, -1) if self.batched else np.asarray(table)
        return jax.tree.unflatten(jax.tree.structure(state), new), sums, table

    def _compile_advance(self, state: State, sums: Array) -> Any:
        """The program of a chunk, for a state of these shapes."""
        self._learn_names(state)
        leaves, structure = jax.tree.flatten(state)
        function = partial(self._chunk, structure, tuple(_is_large(leaf) for leaf in leaves))
        chunk = jax.jit(function, donate_argnums=1, out_shardings=_places((leaves, sums)))
        return chunk.lower(self.algorithm, *_split(leaves), sums, self.key, 0, 0, 1).compile()

    def _chunk(
        self,
        structure: Any,
        large: tuple[bool, ...],
        algorithm: Algorithm,
        big: list,
        small: list,
        sums: Array,
        key: Array,
        start: Array,
        stop: Array,
        every: Array,
    ) -> tuple[list, Array, Array]:
        heavy, light = iter(big), iter(small)
        state = jax.tree.unflatten(structure, [next(heavy) if is_large else next(light) for is_large in large])
        one = lambda seed: self._run_one(algorithm, seed[0], seed[1], seed[2], start, stop, every)  # noqa: E731
        most = (
            max(1, STEPS_AT_ONCE // algorithm.steps_per_iteration) if jax.default_backend() == "cpu" else self.key.size
        )
        state, sums, table = by_groups(one, (state, sums, key), most) if self.batched else one((state, sums, key))
        return jax.tree.leaves(state), sums, table

    def _run_one(
        self, algorithm: Algorithm, state: State, sums: Array, key: Array, start: Array, stop: Array, every: Array
    ) -> tuple[State, Array, Array]:
        """Iterations `start` to `stop` of one seed: state, sums of the unfinished row, table `[R, M]` of the rows."""

        def iteration(i: Array, loop: tuple[State, Array]) -> tuple[State, Array]:
            state, sums = loop
            state, (metrics, episodes) = self._step(algorithm, state, jax.random.fold_in(key, i))
            values = [
                *(metrics[name] for name in sorted(metrics)),
                *(getattr(episodes, f.name) for f in dataclasses.fields(Episodes)),
            ]
            return state, sums + jnp.stack([jnp.asarray(value, jnp.float32) for value in values])

        def row(r: Array, loop: tuple[State, Array, Array]) -> tuple[State, Array, Array]:
            state, sums, table = loop
            first = jnp.maximum(start, r * every)
            sums = jnp.where(first == r * every, 0.0, sums)
            state, sums = jax.lax.fori_loop(first, jnp.minimum(stop, (r + 1) * every), iteration, (state, sums))
            return state, sums, jax.lax.dynamic_update_index_in_dim(table, sums, r - start // every, 0)

        table = jnp.zeros((ROWS_PER_CHUNK, *sums.shape))
        return jax.lax.fori_loop(start // every, -(-stop // every), row, (state, sums, table))

    def rows(self, table: np.ndarray, start: int, stop: int) -> list[dict[str, Any]]:
        """The rows that `advance` finished, as means: metrics by iteration, returns and lengths by episode (NaN where none ended)."""
        found = []
        for r in range(start // self.row_every, stop // self.row_every):
            sums = dict(zip(self._names, table[r - start // self.row_every], strict=True))
            count = sums["count"]
            with np.errstate(invalid="ignore", divide="ignore"):
                row = {
                    "iteration": (r + 1) * self.row_every,
                    "env_steps": steps_after(self.algorithm, (r + 1) * self.row_every),
                    "return_mean": sums["return_sum"] / count,
                    "length_mean": sums["length_sum"] / count,
                    "episodes": count,
                }
            metrics = self._names[: -len(dataclasses.fields(Episodes))]
            found.append(row | {name: sums[name] / self.row_every for name in metrics})
        return found

    def check(self, state: State, rows: Sequence[dict[str, Any]]) -> None:
        """Raise `NonFinite`, naming the first bad quantity, unless every metric and every learnt number is finite."""
        for row in rows:
            for name in self._names[: -len(dataclasses.fields(Episodes))]:
                if not np.all(np.isfinite(row[name])):
                    raise NonFinite(
                        f"{name} is no longer a finite number at iteration {row['iteration']} ({row['env_steps']} steps): "
                        "lower the learning rate or look at the rewards; the last good checkpoint is kept"
                    )
        # On the host: a chunk takes a second and this a few milliseconds, while a program for it takes a fifth of a second to compile.
        for path, leaf in jax.tree_util.tree_leaves_with_path(self.algorithm.learned(state)):
            if jnp.issubdtype(leaf.dtype, jnp.inexact) and not np.isfinite(np.asarray(leaf)).all():
                raise NonFinite(
                    f"the parameter {jax.tree_util.keystr(path)} is no longer finite: "
                    "lower the learning rate or look at the rewards; the last good checkpoint is kept"
                )

    def guarded(self, call: Callable[[], Any]) -> Any:
        """Run a compiled call to its end; an error inside a foreign environment comes out as its own sentence."""
        try:
            return jax.block_until_ready(call())
        except Exception as error:
            failure = failure_of(self.algorithm)
            if failure is not None:
                raise failure from error
            if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error):
                raise ValueError(
                    f"an iteration takes more memory than there is ({str(error).partition(': ')[2]}): make the network, the "
                    "batch, the unroll, the replay, or the number of environments or seeds smaller"
                ) from error
            raise


def _is_large(leaf: Any) -> bool:
    return math.prod(leaf.shape) * leaf.dtype.itemsize >= LARGE


def _split(leaves: list[Any]) -> tuple[list[Any], list[Any]]:
    """What is large, and is donated; and the rest."""
    return [x for x in leaves if _is_large(x)], [x for x in leaves if not _is_large(x)]


def _places(arguments: tuple[list[Any], Any]) -> Any:
    """Where a chunk puts what it gives back: where it got it from, so that the next call takes it as it is. None on one device."""
    mesh = jax.sharding.get_mesh()
    if mesh.empty:
        return None
    whole = NamedSharding(mesh, PartitionSpec())
    place = lambda x: x.sharding if isinstance(x, jax.Array) and isinstance(x.sharding, NamedSharding) else whole  # noqa: E731
    return (*jax.tree.map(place, arguments), whole)


def _memory() -> int | None:
    """Bytes of memory of the device, or of the machine where it is the device; None where nobody says."""
    statistics = jax.devices()[0].memory_stats()
    if statistics and "bytes_limit" in statistics:
        return statistics["bytes_limit"]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if os.name == "posix" else None


def run(
    algorithm: Algorithm,
    key: Key[Array, "..."],
    iterations: int,
    *,
    callbacks: Iterable[Callback | Every] = (),
    row_every: int | None = None,
    chunk_seconds: float = 1.0,
    resume_from: tuple[State, Array, int] | None = None,
    program: Program | None = None,
) -> tuple[State, dict[str, np.ndarray]]:
    """Train for `iterations` iterations; returns the state and the metrics, one array over rows each.

    - `key`: one key, or an array of K keys to train K seeds in one program.
    - `callbacks`: called between chunks with a `Moment`; one that returns True stops the run.
    - `row_every`: iterations in a row of metrics; by default so that there are about 200 rows.
    - `resume_from`: state, sums of the unfinished row and finished iterations of an earlier run.

    Raises `NonFinite` where a loss or parameter is no longer a number, `EnvironmentFailure` where a foreign environment fails.
    """
    if iterations < 1:
        raise ValueError(f"a run needs at least one iteration, not {iterations}")
    algorithm = algorithm.with_horizon(iterations)
    row_every = row_every or max(1, iterations // 200)
    program = program or Program(algorithm, key, row_every)
    if resume_from is None:
        state = program.init()
        sums, done = program.fresh_sums(state), 0
    else:
        state, sums, done = resume_from
    marks = [c.iterations for c in callbacks if isinstance(c, Every)]
    callbacks = list(callbacks)
    history: list[dict[str, Any]] = []
    pace, seconds, stop = None, 0.0, False
    while done < iterations and not stop:
        until = min(
            [
                iterations,
                *((done // mark + 1) * mark for mark in marks),
                (done // row_every + ROWS_PER_CHUNK) * row_every,
            ]
        )
        length = 1 if pace is None else max(1, min(until - done, int(chunk_seconds / pace)))
        compiling, started = program.compile_seconds, time.perf_counter()
        state, sums, table = program.advance(state, sums, done, done + length)
        spent = time.perf_counter() - started - (program.compile_seconds - compiling)
        # Chunks at most double, so that one lucky measurement does not make the next chunk deaf to Ctrl-C.
        pace = spent / length if pace is None else max(spent / length, pace / 2)
        rows = program.rows(table, done, done + length)
        program.check(state, rows)
        done, history = done + length, [*history, *(dict(row) for row in rows)]
        seconds += spent
        moment = Moment(algorithm, state, sums, done, iterations, rows, seconds, program.compile_seconds)
        for callback in callbacks:
            if isinstance(callback, Every):
                stop |= bool(callback.callback(moment)) if done % callback.iterations == 0 else False
            else:
                stop |= bool(callback(moment))
        del moment
    names = history[0] if history else {}
    return state, {name: np.asarray([row[name] for row in history]) for name in names}


__all__ = [
    "Callback",
    "EnvironmentFailure",
    "Every",
    "Moment",
    "NonFinite",
    "Program",
    "iterations_for",
    "run",
    "steps_after",
]
