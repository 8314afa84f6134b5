"""What each command does; imported only when one is run, because it loads JAX."""

import argparse
import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import Any

import jax

from ..catalogue import LOOPS, algorithm_row, nearest
from ..core import Schedule
from ..envs.gymnasium import EnvironmentFailure
from ..ops.schedules import to_text
from ..runner.config import PARTS, merge, options, part_of, resolve
from ..runner.engine import NonFinite
from ..runner.threads import threads_for, use_threads, used_threads
from ..runner.train import Interrupted, Run, resume, train
from . import people
from .main import INTERRUPTED, SOLVERS, WRONG, RequestError, _say, value_of


def cache_folder() -> Path:
    """Where compiled programs are kept between commands (`RTG_CACHE`, or the user's cache folder)."""
    base = os.environ.get("RTG_CACHE") or os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return Path(base or Path.home() / ".cache") / "rewardtogo"


def use_cache() -> None:
    """Keep compiled programs: a second run of the same shapes starts in a fraction of the time."""
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def perform(name: str, given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> int:
    """Run one command; its exit status."""
    use_cache()
    try:
        COMMANDS[name](given, groups)
    except (Interrupted, KeyboardInterrupt) as stop:
        return _say(str(stop) or "interrupted", INTERRUPTED)
    except (NonFinite, EnvironmentFailure) as error:
        return _say(str(error), 1)
    except ValueError as error:
        if isinstance(error, json.JSONDecodeError):
            raise
        return _say(str(error), WRONG)
    except BrokenPipeError:
        raise
    except OSError as error:
        return _say(
            f"{error.strerror or error}{f' ({error.filename})' if error.filename else ''}: "
            "what was written before is whole; free some space or choose another folder",
            1,
        )
    return 0


def _train(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    _choose_threads(given)
    file = _config_file(given.config) if given.config else {}
    extra = {
        "learner": merge(file.get("learner", {}), groups["learner"]),
        "loop": merge(file.get("loop", {}), groups["loop"]),
        "env_kwargs": {**file.get("env", {}), **{k: value_of(v) for k, v in groups["env"].items()}},
    }
    found = train(
        given.algorithm,
        given.env,
        steps=given.steps if given.steps is not None else _whole("steps", file.get("steps")),
        seed=given.seed,
        num_seeds=given.num_seeds,
        num_envs=given.num_envs if given.num_envs is not None else _whole("num_envs", file.get("num_envs")),
        out=given.out,
        backend=given.backend,
        preset=given.preset,
        data=given.data,
        expert=given.expert,
        command=["rtg", *given.arguments],
        **extra,
        **_limits(given),
    )
    _report(given, found)
    if given.profile:
        from ..runner.profile import profile

        for run in found if isinstance(found, list) else [found]:
            own = given.algorithm if ":" in given.algorithm else None
            print(profile(run.path, _learner_for(str(run.path), own)), file=sys.stderr)


def _choose_threads(given: argparse.Namespace) -> None:
    """Those of `--threads`, or of the user's environment, or the number that suits the algorithm."""
    if given.threads is not None:
        use_threads(given.threads)
    elif used_threads() is None:
        own = ":" in given.algorithm
        suits = threads_for(given.algorithm if own else algorithm_row(given.algorithm).path, given.env, given.num_seeds)
        if suits is not None:
            use_threads(suits)


def _config_file(path: str) -> dict[str, Any]:
    """Options from a JSON file; a run's config.json will do."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RequestError(f"there is no configuration file {path}") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RequestError(f"the configuration file {path} is not JSON: {error}") from error
    except OSError as error:
        raise RequestError(f"the configuration file {path} cannot be read: {error.strerror or error}") from error
    if not isinstance(data, dict):
        raise RequestError(
            f"the configuration file {path} must hold an object with learner, loop, env, steps or num_envs"
        )
    wrong = [name for name in ("learner", "loop", "env") if not isinstance(data.get(name, {}), dict)]
    if wrong:
        raise RequestError(
            f"the entry {wrong[0]!r} of the configuration file {path} must be an object, not {data[wrong[0]]!r}"
        )
    if "format" in data:
        env = data.get("env", {})
        data = {
            "learner": _without_class(data.get("learner", {})),
            "loop": _without_class(data.get("loop", {})),
            "steps": data.get("steps"),
            "env": env.get("kwargs", {}),
            "num_envs": env.get("num_envs"),
        }
    unknown = set(data) - {"learner", "loop", "env", "steps", "num_envs"}
    if unknown:
        raise RequestError(
            f"the configuration file {path} has an unknown entry {sorted(unknown)[0]!r}: known are learner, loop, env, steps, num_envs"
        )
    return data


def _without_class(data: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in data.items() if name != "class"}


def _limits(given: argparse.Namespace) -> dict[str, Any]:
    sinks = [name for name in ("tensorboard", "wandb") if vars(given)[name]]
    return {
        "stop_at_return": given.stop_at_return,
        "time_limit": given.time_limit,
        "checkpoint_every": given.checkpoint_every,
        "sinks": sinks,
        "quiet": given.quiet,
    }


def _whole(name: str, value: Any) -> int | None:
    if value is None or (isinstance(value, int) and not isinstance(value, bool)):
        return value
    raise RequestError(f"the entry {name!r} of the configuration file must be a whole number, not {value!r}")


def _report(given: argparse.Namespace, found: Run | list[Run]) -> None:
    if not given.json:
        return
    runs = found if isinstance(found, list) else [found]
    data = [{"run": str(run.path), **(run.evaluation or {})} for run in runs]
    print(json.dumps(data[0] if isinstance(found, Run) else {"runs": data}))


def _resume(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    _threads_of(given.run)
    learner = _learner_for(given.run, given.learner_class)
    _report(given, resume(given.run, steps=given.steps, learner=learner, expert=given.expert, **_limits(given)))


def _threads_of(run: str) -> None:
    """As many as before: sums of floats depend on it, and a resumed run gives the bits of one that was never stopped."""
    from ..runner.folder import RunFolder

    threads = RunFolder(run).config().get("threads")
    if threads is not None and used_threads() is None:
        use_threads(threads)


def _learner_for(run: str, path: str | None) -> Any:
    """The learner of a run that is not part of the library, from the class that the user names."""
    if path is None:
        return None
    from ..runner.config import build
    from ..runner.folder import RunFolder

    return build(resolve(path), RunFolder(run).config()["learner"])


def _eval(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    from ..runner.evaluate_run import evaluate_run

    found = evaluate_run(
        given.run,
        episodes=given.episodes,
        env=given.env,
        backend=given.backend,
        checkpoint=given.checkpoint,
        stochastic=given.stochastic,
        seed=given.seed,
        learner=_learner_for(given.run, given.learner_class),
        values=given.values,
    )
    if given.json:
        print(json.dumps(found))
        return
    low, high = found["return_ci95"]
    print(
        f"return {found['return_mean']:.2f} [{low:.2f}, {high:.2f}] (sd {found['return_std']:.2f}) over {found['episodes']} episodes "
        f"of {found['length_mean']:.1f} steps"
    )
    if given.values:
        shown = lambda x: "unknown" if x is None else f"{x:.2f}"  # noqa: E731
        print(
            f"value {shown(found['value_estimated'])} estimated, {shown(found['value_true'])} true, over {found['value_states']} states"
        )


def _play(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    from ..runner.play import play

    path, total, length = play(
        given.run, out=given.out, seed=given.seed, checkpoint=given.checkpoint, stochastic=given.stochastic
    )
    print(f"{path}   return {total:.1f} in {length} steps")


def _plot(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    from ..runner.plot import draw_curves

    print(draw_curves(given.runs, given.out or "curves.png"))


def _compare(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    from ..runner.compare import compare, table

    found = compare(given.runs)
    print(json.dumps(found) if given.json else table(found))


def _check_env(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    from ..runner.check import check_by_name

    problems = check_by_name(given.env)
    if given.json:
        print(json.dumps([dataclasses.asdict(p) for p in problems]))
    else:
        for problem in problems:
            print(problem)
        errors = sum(p.severity == "error" for p in problems)
        print(
            f"{given.env}: "
            + ("nothing wrong" if not problems else f"{errors} errors, {len(problems) - errors} warnings")
        )
    if any(p.severity == "error" for p in problems):
        raise RequestError(f"{given.env} cannot be used as it is")


def _collect(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    from ..runner.collect import collect_demonstrations

    path, found = collect_demonstrations(
        given.run, episodes=given.episodes, out=given.out, deterministic=not given.stochastic, seed=given.seed
    )
    print(json.dumps({"dataset": str(path), **found}) if given.json else f"{path}   {found}")


def _export(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    from ..runner.export import export

    print(export(given.run, format=given.format, out=given.out, checkpoint=given.checkpoint))


def _figure(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    del groups
    from ..figures import FIGURES, draw

    if given.id is None:
        for name, (_, text) in FIGURES.items():
            print(f"{name:<6}{text}")
        return
    print(draw(given.id, given.out, given.seed))


def _solve(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    from ..runner.solve import report, solve_by_name

    if given.method not in SOLVERS:
        raise ValueError(f"there is no method {given.method!r}: {nearest(given.method, SOLVERS)}")
    if given.out:
        from ..runner.plot import picture_file

        picture_file(given.out)
    found = solve_by_name(
        given.env,
        given.method,
        gamma=given.gamma,
        tolerance=given.tolerance,
        horizon=given.horizon,
        **{k: value_of(v) for k, v in groups["env"].items()},
    )
    if given.json:
        print(json.dumps(found.to_json()))
    else:
        encoding = sys.stdout.encoding or "ascii"
        text = report(found, arrows=True)
        print(text if text.encode(encoding, "replace").decode(encoding) == text else report(found, arrows=False))
    if given.out:
        from ..runner.draw_solution import draw_solution

        print(draw_solution(found, given.out), file=sys.stderr if given.json else sys.stdout)


def _plan(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    from ..runner.look_ahead import plan_by_name, report
    from ..runner.play import require_film

    if given.env is None:
        raise RequestError("which environment? Such as rtg plan ilqr Pendulum-v1")
    if given.out:
        require_film(Path(given.out))
    played = plan_by_name(
        given.planner,
        given.env,
        horizon=given.horizon,
        every=given.every,
        episodes=given.episodes,
        seed=given.seed,
        gamma=given.gamma,
        options=groups["planner"],
    )
    print(json.dumps(played.to_json()) if given.json else report(played))
    if given.out:
        path, total, length = played.film(given.out, given.seed)
        print(f"{path}: return {total:.1f} in {length} steps", file=sys.stderr if given.json else sys.stdout)


def show_options(algorithm: str) -> None:
    """Print every hyperparameter of an algorithm and of its loop: default, range, meaning."""
    row = None if ":" in algorithm else algorithm_row(algorithm)
    parts = [("learner", resolve(algorithm if row is None else row.path), {} if row is None else row.learner)]
    if row is not None:
        parts.append(("loop", resolve(LOOPS[row.loop]), row.loop_options))
    for title, owner, settings in parts:
        _show(title, owner, settings)


def show_planner(planner: str) -> None:
    """Print every setting of a planner."""
    from ..planning.mpc import PLANNERS

    _show("planner", *PLANNERS[planner])


def _show(title: str, owner: type, settings: dict[str, Any]) -> None:
    print(f"\n{title} ({owner.__name__}):")
    for name, field in options(owner).items():
        span = field.metadata.get("range")
        limits = f"  {span}" if span is not None and str(span) != "(-inf, inf)" else ""
        flag = f"--{title}.{name.replace('_', '-')}"
        print(f"  {flag} {_shown(settings.get(name, field.default))}{limits}\n      {field.metadata['doc']}")
        if dataclasses.is_dataclass(field.default) and type(field.default) in PARTS.values():
            chosen = part_of(name, field, settings.get(name, field.default))
            for inner in options(type(chosen)):
                print(f"      {flag}.{inner.replace('_', '-')} {_shown(getattr(chosen, inner))}")


def _shown(value: Any) -> str:
    if isinstance(value, Schedule):
        return to_text(value)
    if isinstance(value, dict):  # a part, of which some options are set
        return " ".join(
            [*([value["class"]] if "class" in value else []), *(f"{k} {v}" for k, v in value.items() if k != "class")]
        )
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    if dataclasses.is_dataclass(value):
        return type(value).__name__.lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


COMMANDS = {
    "train": _train,
    "resume": _resume,
    "eval": _eval,
    "play": _play,
    "plot": _plot,
    "compare": _compare,
    "check-env": _check_env,
    "collect": _collect,
    "demonstrate": people.demonstrate,
    "export": _export,
    "figure": _figure,
    "label": people.label,
    "plan": _plan,
    "solve": _solve,
}
