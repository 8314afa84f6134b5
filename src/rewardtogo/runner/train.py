"""`train` and `resume`: a run from its plan to its folder, whatever happens on the way."""

import contextlib
import dataclasses
import os
import shutil
import signal
import sys
import threading
import time
import types
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core import Actor, Algorithm, Learner, Schedule, State
from ..data.files import Damaged, is_key, read_json, write_json
from ..envs.gymnasium import EnvironmentFailure, hosted
from ..ops.schedules import Constant, to_text
from .engine import Callback, Every, Moment, Program, run, steps_after
from .evaluate import Either, Evaluator, lanes_for, summary
from .folder import RunFolder, new_folders
from .plan import Plan, check_budget, from_config, plan
from .policy import LoadedPolicy, load, save_policy
from .progress import Reporter
from .sinks import CSV, SINKS, Sink, require_sinks

LARGE_STATE = 2**26
"""Bytes from which writing a checkpoint takes so long that it is done more rarely."""
FINAL_EPISODES = 100
"""Episodes of the evaluation at the end, on which the confidence interval rests."""
MOST_SEEDS = 10_000


def final_episodes(episodes: int) -> int:
    """Of the evaluation at the end, given those of one on the way: less where a policy is so slow that even these are few."""
    return min(FINAL_EPISODES, 5 * episodes)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM: a checkpoint was written, and the run can be resumed."""


@dataclasses.dataclass
class Run:
    """A finished (or stopped) run: its folder, its evaluation as in `evaluation.json`, its metrics as arrays."""

    path: Path
    evaluation: dict[str, Any] | None

    @property
    def metrics(self) -> dict[str, np.ndarray]:
        """The columns of `metrics.csv`."""
        return RunFolder(self.path).metrics()

    def policy(self, checkpoint: str = "last") -> LoadedPolicy:
        """The policy, as `rtg.load` gives it."""
        return load(self.path, checkpoint=checkpoint)


class RunState(eqx.Module):
    """What a checkpoint holds: the algorithm's state, the sums of the unfinished row, and the best evaluation so far."""

    algorithm: State
    sums: State
    best: State


class StopSignal:
    """SIGINT and SIGTERM set a flag that is read between chunks; a second one interrupts at once."""

    def __init__(self) -> None:
        self.raised = False
        self._old: dict[int, Any] = {}

    def __enter__(self) -> "StopSignal":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._old[number] = signal.signal(number, self._note)
        return self

    def _note(self, number: int, frame: types.FrameType | None) -> None:
        del number, frame
        if self.raised:
            raise KeyboardInterrupt
        self.raised = True

    def __exit__(self, *error: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)


@dataclasses.dataclass
class Limits:
    """When to stop before the budget is spent, and how often to write a checkpoint (seconds)."""

    stop_at_return: float | None = None
    time_limit: float | None = None
    checkpoint_every: float = 60.0

    def __post_init__(self) -> None:
        for name, value in (("limit", self.time_limit), ("between two checkpoints", self.checkpoint_every)):
            if value is not None and not value > 0:
                raise ValueError(f"the time {name} must be more than 0 seconds, not {value:g}")
        if self.stop_at_return is not None and not np.isfinite(self.stop_at_return):
            raise ValueError(f"the return to stop at must be a finite number, not {self.stop_at_return}")


def program_of(plan: Plan, seeds: Sequence[int]) -> Program:
    """What trains these seeds, together where there are several; it has gone through an iteration, so the plan can be executed."""
    keys = [jax.random.key(seed) for seed in seeds]
    program = Program(plan.algorithm, jnp.stack(keys) if len(keys) > 1 else keys[0], plan.config["row_every"])
    program.trial()
    return program


class Session:
    """One execution of a plan in its folders, one folder a seed. Its methods are what happens between two chunks."""

    def __init__(
        self,
        plan: Plan,
        folders: Sequence[RunFolder],
        seeds: Sequence[int],
        limits: Limits,
        sinks: Sequence[str],
        quiet: bool,
        program: Program | None = None,
    ):
        self.plan, self.folders, self.seeds, self.limits = plan, list(folders), list(seeds), limits
        self.batched = len(seeds) > 1
        self.program = program or program_of(plan, seeds)
        self.key = self.program.key
        episodes = plan.config["eval_episodes"]
        self.evaluator = (
            None
            if plan.eval_env is None
            else Evaluator(plan.eval_env, episodes, self.batched, final_episodes(episodes))
        )
        self.sinks: list[list[Sink]] = [
            [CSV(f), *(SINKS[name](f, plan.config) for name in sinks)] for f in self.folders
        ]
        self.reporter_quiet = quiet
        self.best = np.full(len(seeds), -np.inf)
        self.seconds_before, self.last_checkpoint = 0.0, time.monotonic()
        self.checkpoint_pause = limits.checkpoint_every
        self.reached = False

    # --- one seed out of several -----------------------------------------------------------------------------------------------

    def _each(self, tree: Any) -> list[Any]:
        """The trees of each seed."""
        if not self.batched:
            return [tree]
        return [jax.tree.map(lambda x, k=k: x[k], tree) for k in range(len(self.seeds))]

    def _rows_of(self, rows: list[dict[str, Any]], k: int) -> list[dict[str, Any]]:
        return [{n: v[k] if self.batched and np.ndim(v) else v for n, v in row.items()} for row in rows]

    # --- between chunks --------------------------------------------------------------------------------------------------------

    def evaluate(self, moment: Moment) -> bool:
        """Evaluate, keep the best policy, and say whether the wanted return is reached."""
        if self.evaluator is None:
            return False
        key = jax.random.fold_in(jax.random.key(self.seeds[0] ^ 0x5EED), moment.iteration)
        means = {}
        for name, explore in (("eval_return_mean", False), ("eval_return_stochastic", True)):
            policy = self._policy(moment.state, explore)
            means[name] = self.evaluator(policy, key)[0].mean(-1)
            moment.rows[-1][name] = means[name]
        returns = np.atleast_1d(means["eval_return_mean"])
        for k, state in enumerate(self._each(self.plan.algorithm.learned(moment.state))):
            if returns[k] > self.best[k]:
                self.best[k] = returns[k]
                self._save_policy(self.folders[k].path / "best", state, moment.env_steps, float(returns[k]))
        wanted = self.limits.stop_at_return
        self.reached = wanted is not None and bool(np.all(returns >= wanted))
        return self.reached

    def write_rows(self, moment: Moment) -> None:
        """Give the finished rows to every sink."""
        for row in moment.rows:
            row["seconds"] = self.seconds_before + moment.seconds
        for k, sinks in enumerate(self.sinks):
            for sink in sinks:
                sink.write(self._rows_of(moment.rows, k))

    def checkpoint(self, moment: Moment) -> None:
        """Write the whole state of every seed."""
        began = time.monotonic()
        states = RunState(
            moment.state,
            moment.sums,
            jnp.asarray(self.best if self.batched else self.best[0], jnp.float32),
        )
        about = {"env_steps": moment.env_steps, "seconds": self.seconds_before + moment.seconds}
        for folder, state in zip(self.folders, self._each(states), strict=True):
            folder.save_checkpoint(moment.iteration, state, about)
        self.save_policies(moment)
        size = sum(x.nbytes for x in jax.tree.leaves(states) if not is_key(x))
        if size > LARGE_STATE:
            # A replay of gigabytes takes its time to write: spend at most a twentieth of the run on it.
            self.checkpoint_pause = max(self.limits.checkpoint_every, 20 * (time.monotonic() - began))
        self.last_checkpoint = time.monotonic()

    def save_policies(self, moment: Moment) -> None:
        """Write the policy of every seed as it is now."""
        for folder, state in zip(self.folders, self._each(self.plan.algorithm.learned(moment.state)), strict=True):
            self._save_policy(folder.path, state, moment.env_steps, None)

    def _policy(self, state: State, explore: bool) -> Any:
        make: Callable = lambda s: Either.of(self.plan.algorithm, s, explore)  # noqa: E731
        return jax.vmap(make)(state) if self.batched else make(state)

    def _save_policy(self, path: Path, learned: State, env_steps: int, evaluation: float | None) -> None:
        if self.plan.learner is None:
            return
        about = {"algorithm": self.plan.name, "env": self.plan.config["env"]["id"], "env_steps": env_steps}
        about |= {} if evaluation is None else {"evaluation": evaluation}
        save_policy(path, self.plan.learner, learned, self.plan.algorithm.spec, about)

    # --- the whole -------------------------------------------------------------------------------------------------------------

    def execute(
        self, resume_from: tuple[State, jax.Array, int] | None, callbacks: Sequence[Callback | Every]
    ) -> list[Run]:
        """Train to the end of the budget or to the first reason to stop."""
        start = 0 if resume_from is None else resume_from[2]
        steps = steps_after(self.plan.algorithm, start)
        reporter = Reporter(self.plan.config["steps"], steps, self.reporter_quiet)
        last: list[Moment] = []
        asked, began = StopSignal(), time.monotonic()

        def between(moment: Moment) -> bool:
            last[:] = [moment]
            self.write_rows(moment)
            reporter.update(moment.env_steps, moment.seconds, moment.compile_seconds, moment.rows)
            late = self.limits.time_limit is not None and time.monotonic() - began >= self.limits.time_limit
            if asked.raised or late or time.monotonic() - self.last_checkpoint >= self.checkpoint_pause:
                self.checkpoint(moment)
            return asked.raised or late

        ahead = threading.Thread(target=self._prepare)
        ahead.start()
        try:
            with asked:
                every = Every(self.plan.config["eval_every"], self.evaluate)
                run(
                    self.plan.algorithm,
                    self.key,
                    self.plan.iterations,
                    callbacks=[every, *callbacks, between],
                    row_every=self.plan.config["row_every"],
                    resume_from=resume_from,
                    program=self.program,
                )
                moment = last[0] if last else self._resumed(resume_from)
                if moment.iteration not in self.folders[0].iterations():
                    self.checkpoint(moment)
                if asked.raised:
                    raise Interrupted(
                        f"interrupted after {moment.env_steps} steps; a checkpoint is written: rtg resume {self.folders[0].path}"
                    )
                reporter.close()
                return self.finish(moment, reporter)
        finally:
            reporter.close()
            ahead.join()
            for sinks in self.sinks:
                for sink in sinks:
                    sink.close()
            for env in hosted((self.plan.env, self.plan.eval_env)):
                env.close()

    def _prepare(self) -> None:
        """What is needed later, beside the compilation of the training: the program that evaluates, and the library that draws.

        What fails here is met again, and told, where it is needed.
        """
        if self.evaluator is not None and not hosted((self.plan.env, self.plan.eval_env)):
            with contextlib.suppress(Exception):
                policy = jax.eval_shape(partial(self._policy, explore=False), self.program.shapes())
                self.evaluator.prepare(jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), policy))
        from . import plot as plot

    def _resumed(self, resume_from: Any) -> Moment:
        """The end of a run that was stopped after its last iteration and before its last evaluation."""
        state, sums, done = resume_from
        moment = Moment(self.plan.algorithm, state, sums, done, self.plan.iterations, [], 0.0, 0.0)
        self.save_policies(moment)
        return moment

    def finished(self) -> bool:
        """Whether the whole budget was trained and evaluated: `evaluation.json` is the last thing that a run writes."""
        wanted = self.plan.config["steps"]
        if self.evaluator is None:
            return all((folder.path / "curve.png").exists() for folder in self.folders)
        files = [folder.path / "evaluation.json" for folder in self.folders]
        return all(file.exists() and read_json(file).get("env_steps") == wanted for file in files)

    def finish(self, moment: Moment, reporter: Reporter) -> list[Run]:
        """The last evaluation, the curve, and `evaluation.json`."""
        from .plot import draw_curves  # takes half a second, which `_prepare` has spent meanwhile

        runs = []
        results: list[dict[str, Any] | None] = [None] * len(self.seeds)
        if self.evaluator is not None:
            key = jax.random.fold_in(jax.random.key(self.seeds[0] ^ 0x5EED), 2**31 - 1)
            greedy = self.evaluator(self._policy(moment.state, False), key, final_episodes(self.evaluator.episodes))
            explore = self.evaluator(self._policy(moment.state, True), key, final_episodes(self.evaluator.episodes))
            for k in range(len(self.seeds)):
                pick = lambda found, k=k: [x[k] if self.batched else x for x in found]  # noqa: E731
                results[k] = {
                    "env_steps": moment.env_steps,
                    **summary(*pick(greedy)),
                    "stochastic": summary(*pick(explore)),
                }
        for k, folder in enumerate(self.folders):
            draw_curves([folder.path], folder.path / "curve.png")
            if results[k] is not None:
                write_json(folder.path / "evaluation.json", results[k])
            runs.append(Run(folder.path, results[k]))
        seconds = self.seconds_before + moment.seconds
        rate = (moment.env_steps - steps_after(self.plan.algorithm, 0)) / max(seconds, 1e-9)
        reporter.say(
            f"{moment.env_steps:,} steps in {seconds:.1f} s ({rate:,.0f} steps/s) after compiling for "
            f"{moment.compile_seconds:.1f} s"
        )
        for r in runs:
            if r.evaluation is not None:
                low, high = r.evaluation["return_ci95"]
                reporter.say(
                    f"return {r.evaluation['return_mean']:.1f} [{low:.1f}, {high:.1f}] over {r.evaluation['episodes']} episodes "
                    f"(sampling actions: {r.evaluation['stochastic']['return_mean']:.1f})"
                )
            reporter.say(f"run folder {r.path}   learning curve {r.path / 'curve.png'}")
        return runs


def train(
    algorithm: str | Learner | Algorithm,
    env: Any = None,
    *,
    steps: int | None = None,
    seed: int = 0,
    num_seeds: int = 1,
    num_envs: int | None = None,
    out: str | Path | None = None,
    backend: str = "auto",
    learner: dict[str, Any] | None = None,
    loop: dict[str, Any] | None = None,
    env_kwargs: dict[str, Any] | None = None,
    preset: str = "auto",
    data: Any = None,
    expert: Any = None,
    stop_at_return: float | None = None,
    time_limit: float | None = None,
    checkpoint_every: float = 60.0,
    callbacks: Sequence[Callback | Every] = (),
    sinks: Sequence[str] = (),
    quiet: bool = False,
    command: Sequence[str] = (),
) -> Any:
    """Train an algorithm in an environment and keep the run in a folder. The same thing as `rtg train`.

    - `algorithm`: a name (`rtg list`), `"module:Class"`, a learner, or an algorithm put together by hand (then without `env`).
    - `env`: a Gymnasium id, one of ours, a function that makes one, or an environment object.
    - `steps`: environment steps (gradient steps offline), rounded up to whole iterations.
    - `num_seeds`: trains seeds `seed, seed + 1, ...`: in one program where the environment is compiled, else one after another.
    - `learner`, `loop`: hyperparameters by name; they win over the preset's.
    - `data`: a dataset, or its folder; `expert`: for dagger and dart, a run's folder, `"module:function"`, a function of an
      observation or a `Policy`.
    - `callbacks`: see `rtg.run`; `sinks`: of `"tensorboard"` and `"wandb"`, besides `metrics.csv`.

    Returns a `Run`, or a list of them with several seeds. Raises `ValueError` for a request that cannot be met, `Interrupted` after
    Ctrl-C, `NonFinite` where training diverges, `EnvironmentFailure` where the environment fails.
    """
    if isinstance(num_seeds, bool) or not isinstance(num_seeds, int) or not 1 <= num_seeds <= MOST_SEEDS:
        raise ValueError(f"the number of seeds must be at least 1 and at most {MOST_SEEDS}, not {num_seeds}")
    limits = Limits(stop_at_return, time_limit, checkpoint_every)
    require_sinks(sinks)
    make_plan = lambda seed: plan(  # noqa: E731
        algorithm,
        env,
        steps=steps,
        seed=seed,
        num_envs=num_envs,
        backend=backend,
        learner=learner,
        loop=loop,
        env_kwargs=env_kwargs,
        preset=preset,
        data=data,
        expert=expert,
    )
    first = make_plan(seed)
    check_budget(None, seed + num_seeds - 1)
    seeds = [seed + k for k in range(num_seeds)]
    together = num_seeds > 1 and not hosted(first.algorithm)
    program = program_of(first, seeds if together else seeds[:1])
    existed = out is not None and os.path.exists(out)
    folders = [
        RunFolder(p)
        for p in new_folders(None if out is None else str(out), first.name, first.config["env"]["id"], seeds)
    ]
    groups = [range(num_seeds)] if together else [[k] for k in range(num_seeds)]
    runs: list[Run] = []
    try:
        for k, folder in enumerate(folders):
            group = {"index": k, "folders": [f.path.name for f in folders]} if together else None
            folder.write_config({**first.config, "seed": seeds[k], "group": group, "command": list(command)})
        for group in groups:
            mine = [seeds[k] for k in group]
            part, program = (make_plan(mine[0]), None) if runs else (first, program)
            session = Session(part, [folders[k] for k in group], mine, limits, sinks, quiet, program)
            runs += session.execute(None, callbacks)
    except (ValueError, EnvironmentFailure, OSError):
        _leave_nothing(folders, out, existed)
        raise
    return runs if num_seeds > 1 else runs[0]


def _leave_nothing(folders: Sequence[RunFolder], out: str | Path | None, existed: bool) -> None:
    """Remove the folders of a run that failed before its first checkpoint and its first row: there is nothing to go on from."""
    if any(folder.iterations() or folder.metrics_file.exists() for folder in folders):
        return
    for folder in folders:
        shutil.rmtree(folder.path, ignore_errors=True)
    if out is None or len(folders) > 1:
        with contextlib.suppress(OSError):  # where it holds other runs
            folders[0].path.parent.rmdir()
    if existed and out is not None:
        Path(out).mkdir(exist_ok=True)


def resume(
    path: str | Path,
    *,
    steps: int | None = None,
    env: Any = None,
    learner: Learner | None = None,
    expert: Any = None,
    stop_at_return: float | None = None,
    time_limit: float | None = None,
    checkpoint_every: float = 60.0,
    callbacks: Sequence[Callback | Every] = (),
    sinks: Sequence[str] = (),
    quiet: bool = False,
) -> Any:
    """Continue a run from its last checkpoint, to its budget or to a longer one.

    In compiled environments the result is, bit for bit, that of the run that was never interrupted; Gymnasium's keep their own state,
    so their episodes begin anew. Seeds that were trained together are continued together. An expert that is a run is found again; one
    that is code has to be given again. Returns what `train` returns.
    """
    folder = RunFolder(path)
    config = folder.config()
    group = config.get("group")
    folders = [folder]
    if group is not None:
        siblings = [RunFolder(folder.path.resolve().parent / name) for name in group["folders"]]
        folders = siblings if all((s.path / "config.json").exists() for s in siblings) else folders
    seeds = [f.config()["seed"] for f in folders]
    limits = Limits(stop_at_return, time_limit, checkpoint_every)
    part = from_config(config, steps=steps, env=env, learner=learner, expert=expert)
    require_sinks(sinks)
    session = Session(part, folders, seeds, limits, sinks, quiet)
    common = sorted(set.intersection(*(set(f.iterations()) for f in folders)))
    start = common[-1] if common else 0
    if start >= part.iterations and session.finished():
        raise ValueError(f"{folder.path} has finished its {config['steps']} steps: give more with --steps to go on")
    resumed = _restore(session, part, folders, start) if common else None
    for f in folders:
        f.drop_rows_after(start)
    for f in folders if steps is not None else ():
        f.write_config({**f.config(), "iterations": part.config["iterations"], "steps": part.config["steps"]})
    if steps is not None and not quiet:
        _say_what_ended(part)
    runs = session.execute(resumed, callbacks)
    return runs if len(runs) > 1 else runs[0]


def _say_what_ended(part: Plan) -> None:
    """Tell whoever extends a run of the schedules that came to their ends in its first budget."""
    is_schedule = lambda leaf: isinstance(leaf, Schedule)  # noqa: E731
    named = jax.tree_util.tree_leaves_with_path(part.learner, is_leaf=is_schedule)
    for path, schedule in named:
        if is_schedule(schedule) and not isinstance(schedule, Constant):
            name = jax.tree_util.keystr(path).lstrip(".")
            print(
                f"{name} keeps the horizon it began with ({to_text(schedule)}), and stays at its last value after it",
                file=sys.stderr,
            )


def _load(folder: RunFolder, iteration: int, like: RunState) -> tuple[RunState, dict[str, Any]]:
    """A checkpoint. There is no silent way back to an older one: who reads the sentence decides."""
    try:
        return folder.load_checkpoint(iteration, like)
    except Damaged as error:
        older = [i for i in folder.iterations() if i < iteration]
        then = f"goes on from the one at iteration {older[-1]}" if older else "begins anew"
        where = folder.checkpoint_folder(iteration)
        raise Damaged(f"{error}; delete the folder {where} and the run {then}") from error


def _restore(session: Session, part: Plan, folders: Sequence[RunFolder], start: int) -> tuple[State, jax.Array, int]:
    program = session.program
    shapes = program.shapes()
    sums = jax.eval_shape(program.fresh_sums, shapes)
    like = RunState(shapes, sums, jax.ShapeDtypeStruct(program.key.shape, jnp.float32))
    if session.batched:
        sums = jax.ShapeDtypeStruct(sums.shape[1:], sums.dtype)
        like = RunState(
            jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), shapes),
            sums,
            jax.ShapeDtypeStruct((), jnp.float32),
        )
    loaded = [_load(folder, start, like) for folder in folders]
    session.seconds_before = max(about.get("seconds", 0.0) for _, about in loaded)
    states = [state for state, _ in loaded]
    whole = jax.tree.map(lambda *xs: jnp.stack(xs), *states) if session.batched else states[0]
    session.best = np.atleast_1d(np.asarray(whole.best, np.float64))
    state = whole.algorithm
    if hosted(part.algorithm):
        print("the environment keeps its own state, which no checkpoint holds: new episodes begin", file=sys.stderr)
        fresh = program.init()
        state = jax.tree.map(
            lambda new, old: new if isinstance(new, Actor) else old,
            fresh,
            state,
            is_leaf=lambda x: isinstance(x, Actor),
        )
    return state, whole.sums, start


__all__ = ["Damaged", "Interrupted", "Run", "lanes_for", "resume", "train"]
