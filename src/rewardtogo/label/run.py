"""DAgger whose expert is a person: a run folder in which a round is observations in a file, answers in a log, and what was learnt.

    RUN/labels/NNNNNNNN/queries.safetensors  state.safetensors  round.json  answers.jsonl  frames/
    RUN/labels/lock

Round i of a run with seed s does, with the same keys, what iteration i of `rtg train dagger` does: a script that answers as a
function would gives the run that has that function as its expert (and beta = 0, since a person does not act).
"""

import dataclasses
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..core import Actor, Episodes
from ..data.files import FORMAT, Damaged, load_tree, read_json, save_tree, sync, write_json
from ..data.lock import FolderLock
from ..envs.gymnasium import hosted
from ..imitation.dagger import DAgger, DAggerState, Queries
from ..runner.engine import Moment, Program, steps_after
from ..runner.experts import PERSON
from ..runner.folder import RunFolder, new_folders
from ..runner.plan import Plan, from_config, plan
from ..runner.progress import Reporter
from ..runner.train import Limits, Run, RunState, Session
from .film import film
from .queue import LabelQueue

ROUNDS, ROUND_SIZE = 5, 100
"""Rounds of a run, and observations in one, where nobody says."""
MOST_ROUNDS, MOST_OBSERVATIONS = 10_000, 1_000_000


@dataclasses.dataclass
class Round:
    """A batch that waits for labels: who answers what, and of which steps `[T, B]` it is made.

    Observation number `b T + t` is that of environment b at step t, so that those of an episode follow each other.
    """

    number: int
    queue: LabelQueue
    queries: Queries
    state: DAggerState
    episodes: Episodes
    folder: Path

    def before(self, index: int, most: int) -> list[int]:
        """The observations of the same episode that came just before, at most so many, the oldest first."""
        steps = self.queries.transitions.reward.shape[0]
        start = index - index % steps
        first = max(start, index - most)
        ended = np.flatnonzero(self._ends[first:index])
        return list(range(first + (int(ended[-1]) + 1 if len(ended) else 0), index))

    @property
    def _ends(self) -> np.ndarray:
        t = self.queries.transitions
        return np.swapaxes(np.asarray(t.terminated) | np.asarray(t.truncated), 0, 1).ravel()


class LabelledRun:
    """A run of DAgger that a person's labels drive. Made by `start_labelling` and `open_labelling`; one at a time in a folder.

    `round` is the batch that waits, None once all rounds are done; `finish_round` learns from it and asks the next one.
    """

    def __init__(self, part: Plan, folder: RunFolder, quiet: bool = False):
        algorithm = part.algorithm
        if not isinstance(algorithm, DAgger) or part.config["expert"] != PERSON:
            raise ValueError(
                f"{folder.path} is not a run that a person labels: begin one with `rtg label ENV`, such as `rtg label CartPole-v1`"
            )
        self.folder, self.votes = folder, int(part.config["votes"])
        self._lock = FolderLock(
            folder.path / "labels" / "lock",
            f"another process is labelling {folder.path}: use its page, or stop it first (several labellers share one page)",
        )
        self.plan = film(part)
        self.algorithm: Any = self.plan.algorithm
        self._program = Program(self.algorithm, jax.random.key(part.config["seed"]), 1)
        self._session = Session(
            self.plan, [folder], [part.config["seed"]], Limits(), (), quiet=True, program=self._program
        )
        self._quiet, self._moment = quiet, None
        self._reporter = Reporter(part.config["steps"], 0, quiet)
        self.round: Round | None = None
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    @property
    def rounds(self) -> int:
        """How many rounds the run has in all."""
        return self.plan.config["iterations"]

    @property
    def finished(self) -> int:
        """How many rounds are learnt from."""
        return self.rounds if self.round is None else self.round.number - 1

    def close(self) -> None:
        """Let go of the folder; every answer is on the disk already."""
        if self.round is not None:
            self.round.queue.close()
        for sinks in self._session.sinks:
            for sink in sinks:
                sink.close()
        for env in hosted((self.plan.env, self.plan.eval_env, self.algorithm)):
            env.close()
        self._lock.release()

    def __enter__(self) -> "LabelledRun":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # --- rounds ------------------------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        done = self.folder.iterations()[-1] if self.folder.iterations() else 0
        self.folder.drop_rows_after(done)
        if done:
            state, seconds = self._restored(done)
        else:
            state, seconds = self._program.init(), 0.0
        self._session.seconds_before = seconds
        if done >= self.rounds:
            self._moment = self._at(state, done, [])
            if not self._session.finished():
                self._session.finish(self._moment, self._reporter)
            return
        self.round = self._ask(state, done)

    def _restored(self, done: int) -> tuple[DAggerState, float]:
        shapes = self._program.shapes()
        like = RunState(shapes, jax.ShapeDtypeStruct((1,), jnp.float32), jax.ShapeDtypeStruct((), jnp.float32))
        try:
            loaded, about = self.folder.load_checkpoint(done, like)
        except Damaged as error:
            raise Damaged(
                f"{error}; delete the folder {self.folder.checkpoint_folder(done)} and the run goes on from the one before: "
                "the answers to every round are kept under labels"
            ) from error
        self._session.best = np.atleast_1d(np.asarray(loaded.best, np.float64))
        return self._with_env(loaded.algorithm), float(about.get("seconds", 0.0))

    def _with_env(self, state: DAggerState) -> DAggerState:
        """Where the environment keeps its own state, which no file holds, new episodes begin."""
        if not hosted(self.algorithm):
            return state
        actor: Actor = self._program.init().actor
        return dataclasses.replace(state, actor=actor)

    def _keys(self, done: int) -> tuple[jax.Array, jax.Array]:
        """Those of acting and of learning, as `DAgger.step` makes them in this iteration."""
        act_key, learn_key = jax.random.split(jax.random.fold_in(self._program.key, done))
        return act_key, learn_key

    def _round_folder(self, number: int) -> Path:
        return self.folder.path / "labels" / f"{number:08d}"

    def _ask(self, state: DAggerState, done: int) -> Round:
        """The batch of the next round: read, if it was asked before, else made by acting and written whole or not at all."""
        folder = self._round_folder(done + 1)
        act_key, _ = self._keys(done)
        if not folder.exists():
            acted, queries, episodes = self._program.guarded(lambda: _act(self.algorithm, state, act_key))
            temporary = folder.with_name(f".{folder.name}.tmp")
            shutil.rmtree(temporary, ignore_errors=True)
            (temporary / "frames").mkdir(parents=True)
            save_tree(temporary / "queries.safetensors", (queries, episodes), {"content": "queries"})
            save_tree(temporary / "state.safetensors", acted, {"content": "state"})
            for env, frames in enumerate(self._frames()):
                for step, picture in enumerate(frames):
                    number = env * self.algorithm.unroll + step
                    (temporary / "frames" / f"{number:06d}.png").write_bytes(picture)
            about = {"format": FORMAT, "round": done + 1, "size": int(queries.transitions.reward.size)}
            write_json(temporary / "round.json", about)
            sync(temporary)
            temporary.rename(folder)
            sync(folder.parent)
        else:
            about = read_json(folder / "round.json") if (folder / "round.json").exists() else None
            if not isinstance(about, dict) or about.get("round") != done + 1:
                raise Damaged(f"{folder / 'round.json'} is damaged or missing")
            like = jax.eval_shape(_act, self.algorithm, state, act_key)
            queries, episodes = load_tree(folder / "queries.safetensors", like[1:])
            acted = load_tree(folder / "state.safetensors", like[0])
            if hosted(self.algorithm):
                acted = dataclasses.replace(acted, actor=state.actor)
        observations = jax.tree.map(_in_a_row, jax.device_get(queries.observations))
        queue = LabelQueue(
            folder / "answers.jsonl",
            self.algorithm.spec,
            observations,
            _in_a_row(jax.device_get(queries.own)),
            self.votes,
        )
        return Round(done + 1, queue, queries, acted, episodes, folder)

    def _frames(self) -> Sequence[Sequence[bytes]]:
        """Pictures that a hosted environment drew while the policy acted, by environment and step."""
        found = [env.host.envs for env in hosted(self.algorithm)]
        films = [f for envs in found for f in vars(envs).get("films", ())]
        return [f.take() for f in films]

    def finish_round(self) -> dict[str, float]:
        """Learn from the labels of this round, evaluate, write a checkpoint, and ask the next round. Returns the row of metrics.

        What nobody has answered is left out. Raises `ValueError` where there is no label at all, or no round.
        """
        batch = self.round
        if batch is None:
            raise ValueError(
                f"all {self.rounds} rounds of {self.folder.path} are done: give more rounds (rtg label {self.folder.path} --rounds N)"
            )
        flat, flat_known = batch.queue.settle()
        shape = batch.queries.transitions.reward.shape
        labels, known = _by_step(flat, shape), _by_step(flat_known, shape)
        _, learn_key = self._keys(batch.number - 1)
        # Where nobody passed the program is that of an expert who always answers, to the bit.
        given = None if known.all() else jnp.asarray(known)
        state, metrics = self._program.guarded(
            lambda: _learn(self.algorithm, batch.state, batch.queries, jnp.asarray(labels), learn_key, given)
        )
        row = self._row(batch, metrics)
        self._program.check(state, [row])
        moment = self._at(state, batch.number, [row])
        self._session.evaluate(moment)
        self._session.write_rows(moment)
        self._session.checkpoint(moment)
        (batch.folder / "state.safetensors").unlink(missing_ok=True)  # it is in the checkpoint
        self._reporter.say(
            f"round {batch.number} of {self.rounds}: {int(known.sum())} labels, agreement {1 - row['mistakes']:.2f}, "
            f"return of the policy {row['eval_return_mean']:.1f}"
            if "eval_return_mean" in row
            else f"round {batch.number} of {self.rounds}: {int(known.sum())} labels"
        )
        self._moment = moment
        if batch.number >= self.rounds:
            self.round = None
            self._session.finish(moment, self._reporter)
        else:
            self.round = self._ask(state, batch.number)
        return {name: float(np.asarray(value).item()) for name, value in row.items()}

    def result(self) -> Run:
        """The run as it is now: its folder and its evaluation, None before the last round is learnt from."""
        file = self.folder.path / "evaluation.json"
        return Run(self.folder.path, read_json(file) if file.exists() else None)

    def _row(self, batch: Round, metrics: dict[str, jax.Array]) -> dict[str, Any]:
        count = float(batch.episodes.count)
        mean = lambda total: float(total) / count if count else math.nan  # noqa: E731
        return {
            "iteration": batch.number,
            "env_steps": steps_after(self.algorithm, batch.number),
            "return_mean": mean(batch.episodes.return_sum),
            "length_mean": mean(batch.episodes.length_sum),
            "episodes": count,
            **{name: float(value) for name, value in metrics.items()},
        }

    def _at(self, state: DAggerState, done: int, rows: list[dict[str, Any]]) -> Moment:
        return Moment(self.algorithm, state, jnp.zeros(1), done, self.rounds, rows, 0.0, 0.0)


def start_labelling(
    env: Any,
    *,
    out: str | Path | None = None,
    rounds: int = ROUNDS,
    size: int = ROUND_SIZE,
    votes: int = 1,
    num_envs: int = 1,
    seed: int = 0,
    backend: str = "auto",
    learner: dict[str, Any] | None = None,
    loop: dict[str, Any] | None = None,
    env_kwargs: dict[str, Any] | None = None,
    data: Any = None,
    command: Sequence[str] = (),
    quiet: bool = False,
) -> LabelledRun:
    """Begin a run of DAgger in an environment whose labels come from outside.

    - `rounds`, `size`: batches, and observations in each, rounded up to whole steps of all environments.
    - `votes`: labellers who have to answer each observation.
    - `data`: demonstrations that the first policy is fitted to; without them it starts at random.
    - the rest as in `rtg.train`.

    Raises `ValueError` for a request that cannot be met, before anything is written.
    """
    for name, value, most in (("rounds", rounds, MOST_ROUNDS), ("observations in a round", size, MOST_OBSERVATIONS)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            raise ValueError(f"the number of {name} must be at least 1 and at most {most:,}, not {value}")
    if isinstance(votes, bool) or not isinstance(votes, int) or not 1 <= votes <= 99:
        raise ValueError(f"each observation is answered by 1 to 99 labellers, not {votes}")
    if num_envs < 1:
        raise ValueError(f"there must be at least one environment, not {num_envs}")
    unroll = -(-size // num_envs)
    whole = plan(
        "dagger",
        env,
        steps=rounds * unroll * num_envs,
        seed=seed,
        num_envs=num_envs,
        backend=backend,
        learner=learner,
        loop={"unroll": unroll, "beta": 0.0, **(loop or {})},
        env_kwargs=env_kwargs,
        data=data,
        expert=PERSON,
        evaluations=rounds,
    )
    if float(whole.algorithm.at(jnp.zeros((), jnp.int32)).beta):  # type: ignore[attr-defined]
        raise ValueError("a person labels and does not act, so loop.beta must be 0 (its default here)")
    folder = RunFolder(new_folders(None if out is None else str(out), "dagger", whole.config["env"]["id"], [seed])[0])
    folder.write_config({**whole.config, "votes": votes, "group": None, "command": list(command)})
    return LabelledRun(dataclasses.replace(whole, config={**whole.config, "votes": votes}), folder, quiet)


def open_labelling(path: str | Path, *, rounds: int | None = None, env: Any = None, quiet: bool = False) -> LabelledRun:
    """Go on with a run that labels drive, where it was left, or with more rounds than it had.

    Raises `Damaged` where this is no run, `ValueError` where it is not labelled by a person or another process is at it.
    """
    folder = RunFolder(path)
    config = folder.config()
    if config.get("expert") != PERSON:
        raise ValueError(
            f"{folder.path} is a run of {config['algorithm']} that no person labels: name its environment instead "
            f"(rtg label {config['env']['id']}), with --data for demonstrations to begin with"
        )
    if not isinstance(config.get("votes"), int):
        raise Damaged(f"{folder.path / 'config.json'} is damaged: its 'votes' is missing")
    part = from_config(config, steps=None, env=env)
    if rounds is not None and rounds != config["iterations"]:
        part = _longer(part, rounds)
        folder.write_config({**config, **{k: part.config[k] for k in ("iterations", "steps", "loop")}})
    return LabelledRun(part, folder, quiet)


def _longer(part: Plan, rounds: int) -> Plan:
    """The plan with more rounds, for whose labels there has to be room already."""
    algorithm: Any = part.algorithm
    given = 0 if algorithm.demonstrations is None else algorithm.demonstrations.num_steps
    room = (algorithm.capacity - given) // algorithm.steps_per_iteration
    if not part.iterations <= rounds <= MOST_ROUNDS:
        raise ValueError(f"the run has {part.iterations} rounds already: --rounds can add some, and {rounds} is less")
    if rounds > room:
        raise ValueError(
            f"the run has room for the labels of {room} rounds, not of {rounds}: begin another one with more --rounds"
        )
    return dataclasses.replace(
        part, config={**part.config, "iterations": rounds, "steps": steps_after(algorithm, rounds)}
    )


@jax.jit
def _act(algorithm: DAgger, state: DAggerState, key: jax.Array) -> tuple[DAggerState, Queries, Episodes]:
    return algorithm.act(state, key)


@jax.jit
def _learn(
    algorithm: DAgger,
    state: DAggerState,
    queries: Queries,
    labels: jax.Array,
    key: jax.Array,
    known: jax.Array | None,
) -> tuple[DAggerState, dict[str, jax.Array]]:
    return algorithm.learn(state, queries, labels, key, known)


def _in_a_row(x: np.ndarray) -> np.ndarray:
    """`[T, B, ...]` as `[B T, ...]`, one environment after the other."""
    return np.ascontiguousarray(np.swapaxes(np.asarray(x), 0, 1)).reshape(-1, *np.shape(x)[2:])


def _by_step(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The inverse of `_in_a_row`."""
    return np.ascontiguousarray(np.swapaxes(x.reshape(shape[1], shape[0], *x.shape[1:]), 0, 1))
