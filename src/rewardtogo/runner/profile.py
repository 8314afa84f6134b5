"""Where the time of a run goes: collection, learning, evaluation (the anatomy of Figure 1.2), each as a program of its own.

The parts are compiled apart, with the shapes, the parameters and the environments of the run, and timed beside the whole iteration,
round after round, so that whatever else the machine does hits all of them alike; medians of the rounds are reported. A part runs for
many iterations inside one program, as in training, so that what it costs to call one does not count. Foreign environments are
also timed from within, in the callback.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..actor_critic.asynchronous import Asynchronous
from ..core import Algorithm, Learner, PRNGKey, State
from ..envs.gymnasium import GymnasiumEnv, hosted
from ..loops.collect import begin
from ..loops.off_policy import OffPolicy
from ..loops.on_policy import OnPolicy
from .evaluate import Either, Evaluator
from .evaluate_run import restore
from .folder import RunFolder
from .plan import Plan

STRETCH = 0.1
"""Seconds that a part is run for before the clock is read, about."""
MOST = 2**20
"""Iterations beyond which no part is run, however fast."""
PATIENCE = 60.0
"""Seconds after which no further round begins."""
_Halves = OnPolicy | OffPolicy | Asynchronous
"""Loops whose iterations are made of acting and learning: those that have `act` and `learn`."""


@dataclasses.dataclass(frozen=True)
class Anatomy:
    """Seconds an iteration: of each part by itself, of the whole, and of the part of collection inside foreign environments."""

    collection: float
    learning: float
    evaluation: float
    whole: float
    foreign: float | None

    @property
    def ratio(self) -> float:
        """The sum of the three parts as a share of the whole: 1 if they are all there is."""
        return (self.collection + self.learning + self.evaluation) / self.whole


def profile(run_path: str | Path, learner: Learner | None = None) -> str:
    """What share of a run's time collection, learning and evaluation take, as text for people."""
    config = RunFolder(run_path).config()
    found = anatomy(run_path, learner=learner)
    total = found.collection + found.learning + found.evaluation
    title = f"{config['algorithm']} in {config['env']['id']}"
    lines = [f"where the time of an iteration goes ({title}):"]
    for name in ("collection", "learning", "evaluation"):
        seconds = getattr(found, name)
        lines.append(f"  {name:<11}{_shown(seconds):>9}{seconds / total:7.0%}")
    if found.foreign is not None:
        lines.append(f"  of collection, {found.foreign / found.collection:.0%} are inside the environment's own code")
    lines.append(f"  together {found.ratio:.0%} of the whole, {_shown(found.whole).strip()}")
    return "\n".join(lines)


def _shown(seconds: float) -> str:
    return (
        f"{seconds:.3g} s"
        if seconds >= 1
        else f"{1e3 * seconds:.3g} ms"
        if seconds >= 1e-3
        else f"{1e6 * seconds:.3g} µs"
    )


def anatomy(
    run_path: str | Path,
    rounds: int = 15,
    learner: Learner | None = None,
    timer: Callable[[], float] = time.perf_counter,
) -> Anatomy:
    """Time the parts of a run from its last checkpoint on. Nothing in its folder is changed.

    `timer` is the clock; on a CPU that others use as well, `time.process_time` counts what this process gets of it.

    Raises `ValueError` where the run has no checkpoint, or is made of objects that a file cannot hold.
    """
    folder = RunFolder(run_path)
    if not folder.iterations():
        raise ValueError(
            f"{folder.path} has no checkpoint to time from: train it with `rtg resume {folder.path}` first"
        )
    plan, state = restore(folder, folder.iterations()[-1], learner)
    clock = _Clock(hosted(plan.env), timer)
    try:
        return _measure(plan, state, clock, rounds)
    finally:
        for env in hosted((plan.env, plan.eval_env)):
            env.close()


class _Clock:
    """Times calls, and what foreign environments take of them."""

    def __init__(self, envs: list[GymnasiumEnv], timer: Callable[[], float]):
        self.inside, self.timer = 0.0, timer
        for env in envs:
            # The program looks the function up when it is traced, which is after this.
            vars(env.host)["step"] = self._timed(env.host.step)

    def _timed(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(words: Any) -> Any:
            began = self.timer()
            try:
                return call(words)
            finally:
                self.inside += self.timer() - began

        return timed

    def lap(self, call: Callable[[], Any]) -> tuple[float, float, Any]:
        """Seconds of a call, seconds of it inside foreign environments, and what it gave."""
        self.inside, began = 0.0, self.timer()
        result = jax.block_until_ready(call())
        return self.timer() - began, self.inside, result


def _measure(plan: Plan, state: State, clock: _Clock, rounds: int) -> Anatomy:
    algorithm, key = plan.algorithm, jax.random.key(0)
    if _acts_outside(algorithm):
        # A foreign environment is not where the checkpoint left it.
        state = eqx.tree_at(lambda s: s.actor, state, jax.jit(_begin)(algorithm, state, key))
    parts = _Parts(algorithm, state, key)
    evaluator = None if plan.eval_env is None else Evaluator(plan.eval_env, plan.config["eval_episodes"])
    # Copies, since the programs below reuse the memory of the state; the same ones and the same key, so that evaluation plays
    # the same episodes each time.
    policies = [jax.tree.map(jnp.copy, Either.of(algorithm, state, explore)) for explore in (False, True)]

    def evaluate() -> None:
        if evaluator is not None:
            for policy in policies:
                evaluator(policy, key)

    evaluate()
    for part in parts.names:
        parts.advance(part, 1)
    count = _stretch(lambda count: clock.lap(lambda: parts.advance("whole", count))[0])
    rows, began = [], time.monotonic()
    while len(rows) < rounds and (not rows or time.monotonic() - began < PATIENCE):
        collection, foreign, _ = clock.lap(lambda: parts.advance("collection", count))
        learning, _, _ = clock.lap(lambda: parts.advance("learning", count))
        evaluation, _, _ = clock.lap(evaluate)
        whole, _, _ = clock.lap(lambda: parts.advance("whole", count))
        again, _, _ = clock.lap(
            evaluate
        )  # after a program of iterations like the first time, with caches in the same state
        every = plan.config["eval_every"]
        rows.append(
            (collection / count, learning / count, evaluation / every, whole / count + again / every, foreign / count)
        )
    collection, learning, evaluation, whole, foreign = np.median(rows, axis=0).tolist()
    return Anatomy(collection, learning, evaluation, whole, foreign if hosted(plan.env) else None)


def _stretch(seconds: Callable[[int], float]) -> int:
    """Iterations that take about `STRETCH`, found by doubling, since a call by itself costs as much as many iterations."""
    count = 1
    while count < MOST and seconds(count) < STRETCH / 2:
        count = 2 * count
    return count


def _acts_outside(algorithm: Algorithm) -> bool:
    """Whether the algorithm acts in a foreign environment, where acting has to begin anew."""
    return isinstance(algorithm, (OnPolicy, OffPolicy)) and bool(hosted(algorithm.env))


def _begin(algorithm: OnPolicy | OffPolicy, state: State, key: PRNGKey) -> State:
    return begin(algorithm.env, algorithm.policy(state, explore=True), key)


class _Parts:
    """The programs of the parts of an iteration, and the state that they hand on to each other."""

    def __init__(self, algorithm: Algorithm, state: State, key: PRNGKey):
        self.algorithm, self.state, self.key = algorithm, state, key
        self.functions: dict[str, Callable] = {"whole": _whole}
        rollout: Any = ()
        if isinstance(algorithm, _Halves):
            self.state, (rollout, _) = jax.jit(_collection)(algorithm, state, key, ())
            self.functions |= {"collection": _collection, "learning": _learning}
        self.rollout = rollout
        self.results = {name: self._nothing(function) for name, function in self.functions.items()}
        self.programs = {
            name: jax.jit(_many(function), donate_argnums=(1, 2)) for name, function in self.functions.items()
        }

    def _nothing(self, part: Callable) -> Any:
        """What a part gives, before it has given anything."""
        shapes = jax.eval_shape(part, self.algorithm, self.state, self.key, self.rollout)[1]
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    @property
    def names(self) -> tuple[str, ...]:
        """What can be advanced; "collection" and "learning" cost nothing where they are not apart."""
        return tuple(self.programs)

    def advance(self, name: str, count: int) -> State:
        """So many iterations of a part."""
        if name not in self.programs:
            return self.state if name == "collection" else self.advance("whole", count)
        self.state, self.results[name] = self.programs[name](
            self.algorithm, self.state, self.results[name], self.rollout, self.key, count
        )
        return self.state


def _many(part: Callable) -> Callable:
    def many(
        algorithm: Algorithm, state: State, result: Any, rollout: Any, key: PRNGKey, count: Int[Array, ""] | int
    ) -> Any:
        def once(i: jax.Array, loop: tuple[State, Any]) -> tuple[State, Any]:
            # What a part gives is carried along, so that the compiler leaves none of it out; and parameters and data look
            # new in each iteration, as they are in training, so that it does not prepare them once for all.
            state, rollout_now, at = jax.lax.optimization_barrier((loop[0], rollout, i))
            return part(algorithm, state, jax.random.fold_in(key, at), rollout_now)

        return jax.lax.fori_loop(0, count, once, (state, result))

    return many


def _whole(algorithm: Algorithm, state: State, key: PRNGKey, rollout: Any) -> tuple[State, Any]:
    del rollout
    return algorithm.step(state, key)


def _collection(algorithm: _Halves, state: State, key: PRNGKey, delivery: Any) -> tuple[State, Any]:
    del delivery
    state, delivery, episodes = algorithm.act(state, key)
    return state, (delivery, episodes)


def _learning(algorithm: _Halves, state: State, key: PRNGKey, delivery: Any) -> tuple[State, Any]:
    return algorithm.learn(state, delivery, key)
