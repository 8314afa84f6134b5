"""What a run is: algorithm, environment, budget, put together from names, objects or a run folder's `config.json`."""

import dataclasses
import math
import platform
from pathlib import Path
from typing import Any

import gymnasium
import jax

from .. import presets
from ..catalogue import ALGORITHMS, LOOPS, algorithm_row
from ..core import Algorithm, Choices, Environment, Learner, Observed, VectorEnv, env_spec, require_action
from ..data.checks import require_spec
from ..data.episodes import Dataset, load_dataset
from ..envs.gymnasium import hosted
from ..envs.known import KnownModel
from ..envs.opponents import Versus
from ..envs.registry import COMPILED, make
from ..envs.simulator import Simulator, simulator_of
from ..envs.time_limit import TimeLimit
from ..envs.vectorize import Vectorized, vectorize
from ..planning.tree_search import Numbered
from .config import build, describe, merge, override, resolve
from .engine import iterations_for, steps_after
from .evaluate import lanes_for
from .experts import PERSON, expert_of, is_code
from .policy import restore_learner
from .threads import used_threads

DEFAULT_STEPS = 100_000
MOST_ITERATIONS, MOST_HOSTED = 2**31 - 1, 10_000
ROWS, EVALUATIONS, EVAL_EPISODES = 200, 10, 20
"""How many rows of metrics and how many evaluations a run has, about, and episodes an evaluation."""
HOSTED_SHARE, HOSTED_LEAST, HOSTED_EPISODE = 0.2, 2, 1000
"""Where environments live outside of the compiled program: the steps that evaluations on the way may take, in steps of the training; the
fewest episodes of one; and the length of an episode where nobody says it. A step out there costs as much as one of training."""


@dataclasses.dataclass
class Plan:
    """One run, ready to be executed. `config` is what `config.json` says of it; `env` is None offline without an environment."""

    algorithm: Algorithm
    learner: Learner | None
    env: VectorEnv | None
    eval_env: VectorEnv | None
    config: dict[str, Any]

    @property
    def name(self) -> str:
        """What the algorithm is called."""
        return self.config["algorithm"]

    @property
    def iterations(self) -> int:
        """The budget in iterations."""
        return self.config["iterations"]


def plan(
    algorithm: str | Learner | Algorithm,
    env: Any,
    *,
    steps: int | None = None,
    seed: int = 0,
    num_envs: int | None = None,
    backend: str = "auto",
    learner: dict[str, Any] | None = None,
    loop: dict[str, Any] | None = None,
    env_kwargs: dict[str, Any] | None = None,
    preset: str = "auto",
    data: Any = None,
    expert: Any = None,
    eval_episodes: int | None = None,
    evaluations: int = EVALUATIONS,
) -> Plan:
    """Put a run together. Raises `ValueError` with one sentence for whatever cannot be, before anything is compiled or written."""
    name = algorithm if isinstance(algorithm, str) else _name_of(algorithm)
    env_name = env if isinstance(env, str) else _title(env)
    ready = _preset(preset, name, env_name)
    known_row = ALGORITHMS.get(name)
    env_kwargs = merge(ready.get("env", {}), env_kwargs or {})
    check_budget(steps, seed)
    _check_num_envs(num_envs, env, backend, env_kwargs)
    if isinstance(algorithm, Algorithm):
        if learner or loop:
            raise ValueError(
                "an algorithm that is put together already takes no options for its learner or loop: set them where it was made"
            )
        whole, inner = algorithm, _learner_of(algorithm)
        vector_env: VectorEnv | None = _env_of(algorithm)
    else:
        # A learner object says what it wants: a preset's values are for names.
        row = ALGORITHMS.get(algorithm) if isinstance(algorithm, str) else None
        known = {} if row is None else merge(row.learner, ready.get("learner", {}))
        inner = _knowing(_learner(algorithm, merge(known, learner or {})), env, env_name)
        options = merge(merge({} if row is None else row.loop_options, ready.get("loop", {})), loop or {})
        kind = row.loop if row is not None else ("on_policy" if inner.batch == "rollout" else "off_policy")
        if data is not None and kind != "dagger":
            kind, options = "offline", loop or {}
        if expert is not None and kind != "dagger":
            raise ValueError(f"{name} asks no expert: leave the expert out, or use dagger")
        cls = resolve(LOOPS[kind])
        if kind == "offline":
            if data is None:
                raise ValueError(
                    f"{name} learns from a dataset: make one with `rtg collect RUN` or `rtg demonstrate ENV`, and give it with --data"
                )
            dataset = _dataset(data)
            vector_env = None if env is None else make(env, num_envs or 1, backend=backend, **env_kwargs)  # type: ignore[arg-type]
            if vector_env is not None:
                require_spec(dataset.spec, env_spec(vector_env), "the data")
            whole = build(cls, options, dataset=dataset, learner=inner)
        else:
            if env is None:
                raise ValueError(f"{name} learns by acting and was given no environment: name one, such as CartPole-v1")
            number = (
                num_envs
                if num_envs is not None or not isinstance(env, (str, Environment))
                else ready.get("num_envs", (row and row.num_envs) or cls.default_num_envs())
            )
            vector_env = make(env, number, backend=backend, **env_kwargs)  # type: ignore[arg-type]
            if kind == "asynchronous" and hosted(vector_env):
                raise ValueError(
                    f"{name} acts with several policies in one compiled program, which an environment outside of it ({env_name}) "
                    "cannot follow: use one of `rtg list --envs`, or a2c"
                )
            more = _imitation(name, expert, data, vector_env) if kind == "dagger" else _more(kind, name, vector_env)
            whole = build(cls, options, env=vector_env, learner=inner, **more)
    steps = int(steps or ready.get("steps", DEFAULT_STEPS))
    iterations = _iterations(whole, steps)
    eval_episodes = eval_episodes or (known_row and known_row.eval_episodes)
    if not eval_episodes:
        eval_episodes, evaluations = _evaluations(whole, steps, evaluations)
    row_every = max(1, iterations // ROWS)
    eval_every = max(1, round(iterations / max(1, evaluations) / row_every)) * row_every
    whole = whole.with_horizon(iterations)
    inner = _learner_of(whole) if inner is not None else None
    config = {
        "algorithm": name,
        "env": described_env(env, vector_env, env_kwargs),
        "learner": describe(inner) if inner is not None else {},
        "loop": describe(whole),
        "data": str(data) if isinstance(data, (str, Path)) else None,
        "expert": str(expert) if isinstance(expert, (str, Path)) else None,
        "seed": seed,
        "steps": steps_after(whole, iterations),
        "iterations": iterations,
        "row_every": row_every,
        "eval_every": eval_every,
        "eval_episodes": eval_episodes,
        "threads": used_threads(),
        "versions": versions(),
    }
    return Plan(whole, inner, vector_env, _evaluation_env(env, vector_env, backend, env_kwargs, eval_episodes), config)


def described_env(source: Any, env: VectorEnv | None, kwargs: dict[str, Any]) -> dict[str, Any]:
    """What `config.json` says of an environment that was made of `source` and arguments."""
    return {
        "id": source if isinstance(source, str) else _title(source),
        "backend": _backend(env),
        "num_envs": env.num_envs if env is not None else 0,
        "kwargs": kwargs,
        "by_name": isinstance(source, str),
    }


def from_config(
    config: dict[str, Any], *, steps: int | None, env: Any = None, learner: Learner | None = None, expert: Any = None
) -> Plan:
    """The run that a folder's configuration describes, with a longer budget if `steps` is given."""
    described = config["env"]
    if env is None and not described["by_name"] and described["num_envs"]:
        raise ValueError(
            f"the run was made with an environment object ({described['id']}), which a file cannot hold: "
            "resume it from Python with rtg.resume(path, env=...)"
        )
    source = described["id"] if env is None else env
    inner = restore_learner({"algorithm": config["algorithm"], "learner": config["learner"]}, learner)
    kind = config["loop"]["class"]
    if kind not in LOOPS.values():
        raise ValueError(
            f"the run was made with {kind}, which is not one of the library's loops: resume it from Python with rtg.run"
        )
    cls = resolve(kind)
    backend = described["backend"]
    eval_env: VectorEnv | None
    if kind == LOOPS["offline"]:
        if config["data"] is None:
            raise ValueError(
                "the run was made with a dataset object, which a file cannot hold: it cannot be resumed by name"
            )
        vector_env = make(source, 1, backend=backend, **described["kwargs"]) if described["num_envs"] else None
        whole: Algorithm = build(cls, config["loop"], dataset=load_dataset(config["data"]), learner=inner)
    else:
        vector_env = make(source, described["num_envs"], backend=backend, **described["kwargs"])
        name = config["algorithm"]
        if kind == LOOPS["dagger"]:
            more = _imitation(name, _same_expert(config, expert), config["data"], vector_env)
        else:
            more = _more(next(k for k, path in LOOPS.items() if path == kind), name, vector_env)
        whole = build(cls, config["loop"], env=vector_env, learner=inner, **more)
    config = dict(config)
    if steps is not None:
        check_budget(steps, config["seed"])
        iterations = _iterations(whole, steps)
        if iterations < config["iterations"]:
            raise ValueError(
                f"the run's budget is {config['steps']} steps already: --steps can extend it, and {steps} is less"
            )
        config |= {"iterations": iterations, "steps": steps_after(whole, iterations)}
    eval_env = _evaluation_env(source, vector_env, backend, described["kwargs"], config["eval_episodes"])
    return Plan(whole, inner, vector_env, eval_env, config)


def _evaluations(whole: Algorithm, steps: int, most: int) -> tuple[int, int]:
    """Episodes of an evaluation, of the policy at its best and as it explores each, and how many evaluations there are on the way:
    as many of either as suit what is acted in for `steps` steps.
    """
    doors = hosted(_env_of(whole))
    if not doors:
        return EVAL_EPISODES, most
    both = 2 * (doors[0].time_limit or HOSTED_EPISODE)
    fitting = HOSTED_SHARE * steps / both
    episodes = min(EVAL_EPISODES, max(HOSTED_LEAST, int(fitting / max(1, most))))
    return episodes, min(most, max(1, int(fitting / episodes)))


def _dataset(data: Any) -> Dataset:
    return load_dataset(data) if isinstance(data, (str, Path)) else data


def _imitation(name: str, expert: Any, data: Any, env: VectorEnv) -> dict[str, Any]:
    """What a learner that asks needs besides an environment."""
    if expert is None:
        raise ValueError(
            f"{name} learns from an expert's answers: name one with --expert RUN or --expert module:function"
        )
    return {
        "expert": None if expert == PERSON else expert_of(expert, env_spec(env)),
        "demonstrations": None if data is None else _dataset(data),
    }


def _same_expert(config: dict[str, Any], expert: Any) -> Any:
    """The expert that is given again, or the run that the configuration names."""
    described = config.get("expert")
    if expert is None and (described is None or is_code(described)):
        which = f"code ({described})" if described else "an object"
        raise ValueError(
            f"the run's expert is {which}, which a file may not name: give it again with --expert, or rtg.resume(path, expert=...)"
        )
    return described if expert is None else expert


def _more(kind: str, name: str, env: VectorEnv) -> dict[str, Any]:
    """What a loop is given besides environment and learner."""
    return {"model": search_model(env, name)} if kind in ("distill", "self_play") else {}


def search_model(env: VectorEnv, name: str = "a tree search") -> Choices:
    """What a tree search looks ahead with: the rules of a game, or the environment itself as its own model.

    Raises `ValueError`, in the name of who wants to search, for environments that no search can look ahead in: those outside of the
    compiled program, those whose observation does not tell their state, and those whose actions are not numbered.
    """
    if not isinstance(env, Vectorized):
        raise ValueError(
            f"{name} looks ahead in a compiled model, and this environment has none: use one of `rtg list --envs`, such as TicTacToe"
        )
    inner = env.env.env if isinstance(env.env, TimeLimit) else env.env
    if isinstance(inner, Versus):
        return inner.game
    if not isinstance(inner, Observed):
        raise ValueError(
            f"{name} goes on from what is observed, and an observation of {type(inner).__name__} does not tell its state: "
            "use CartPole-v1 or TicTacToe"
        )
    require_action(name, env_spec(env), ("discrete",))
    return Numbered(KnownModel(inner), env_spec(env).action.counts[0])


def check_budget(steps: Any, seed: Any) -> None:
    """Raise `ValueError` unless steps and seed are whole numbers that make sense."""
    if steps is not None and (
        isinstance(steps, bool)
        or not isinstance(steps, (int, float))
        or not math.isfinite(steps)
        or steps < 1
        or steps != int(steps)
    ):
        raise ValueError(f"the number of steps must be a whole number of at least 1, not {steps}")
    if steps is not None and steps > 1e15:
        raise ValueError(f"{steps:g} steps would take centuries: give at most 1e15")
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**32:
        raise ValueError(f"a seed is a whole number from 0 to 2^32 - 1, not {seed}")


def _iterations(algorithm: Algorithm, steps: int) -> int:
    iterations = iterations_for(algorithm, steps)
    if iterations >= MOST_ITERATIONS:
        raise ValueError(
            f"{steps:,} steps are {iterations:,} iterations of {algorithm.steps_per_iteration} steps, and an iteration's number "
            "must be less than 2^31 - 1: ask for fewer steps, or for more in an iteration (--loop.unroll, --num-envs)"
        )
    return iterations


def _check_num_envs(number: Any, env: Any, backend: str, kwargs: dict[str, Any] | None) -> None:
    if number is None:
        return
    if isinstance(number, bool) or not isinstance(number, int) or number < 1:
        raise ValueError(f"there must be at least one environment and a whole number of them, not {number}")
    hosted_by_name = isinstance(env, str) and (
        env not in COMPILED or backend in ("gymnasium", "envpool") or bool(kwargs)
    )
    if hosted_by_name and number > MOST_HOSTED:
        whose = "EnvPool" if backend == "envpool" else "Gymnasium"
        raise ValueError(
            f"{number} {whose} environments side by side would each live in this process: ask for at most {MOST_HOSTED}"
        )


def versions() -> dict[str, str]:
    """What made a run."""
    from .. import __version__

    return {
        "rewardtogo": __version__,
        "jax": jax.__version__,
        "gymnasium": gymnasium.__version__,
        "python": platform.python_version(),
        "device": jax.devices()[0].platform,
        "system": platform.system(),
    }


def _preset(choice: str, algorithm: str, env: str) -> dict[str, Any]:
    if choice == "none":
        return {}
    if choice == "auto":
        return presets.preset(algorithm, env)
    name, _, other = choice.partition("/")
    found = presets.preset(name, other) if other else presets.preset(algorithm, name)
    if not found:
        known = ", ".join(f"{a}/{e}" for a, e in sorted(presets.PRESETS))
        raise ValueError(f"there is no preset {choice!r}: known are auto, none, {known}")
    return found


def _name_of(algorithm: Learner | Algorithm) -> str:
    inner = _learner_of(algorithm) if isinstance(algorithm, Algorithm) else algorithm
    cls = type(algorithm if inner is None else inner)
    path = f"{cls.__module__}:{cls.__name__}"
    return next((row.name for row in ALGORITHMS.values() if row.path == path), path)


def _learner(algorithm: str | Learner, data: dict[str, Any]) -> Learner:
    if isinstance(algorithm, Learner):
        return override(algorithm, data)
    cls = resolve(algorithm if ":" in algorithm else algorithm_row(algorithm).path)
    if not (isinstance(cls, type) and issubclass(cls, Learner)):
        raise ValueError(f"{algorithm} is no learner: name a class that derives from rewardtogo.Learner")
    return build(cls, data)


def _knowing(learner: Learner, env: Any, name: str) -> Learner:
    """The learner with the run's environment as the dynamics that it knows, where it has to know some and none are named."""
    if getattr(learner, "dynamics", learner) is not None:
        return learner
    inner = env.env if isinstance(env, Vectorized) else env
    known = simulator_of(inner, name) if name not in COMPILED and isinstance(inner, Environment) else Simulator(name)
    return dataclasses.replace(learner, dynamics=known)  # type: ignore[call-arg]


def _learner_of(algorithm: Algorithm) -> Any:
    fields = {f.name for f in dataclasses.fields(algorithm)}
    return algorithm.learner if "learner" in fields else None  # type: ignore[attr-defined]


def _env_of(algorithm: Algorithm) -> VectorEnv | None:
    fields = {f.name for f in dataclasses.fields(algorithm)}
    return algorithm.env if "env" in fields else None  # type: ignore[attr-defined]


def _title(env: Any) -> str:
    if env is None:
        return "none"
    if isinstance(env, Vectorized):
        return type(env.env).__name__
    named = hosted(env)[0].name if isinstance(env, VectorEnv) and hosted(env) else None
    name = vars(env).get("__name__") or getattr(env, "__name__", type(env).__name__)
    return named or ("custom" if name == "<lambda>" else name)


def _backend(env: VectorEnv | None) -> str:
    doors = hosted(env)
    return doors[0].backend if doors else "jax"


def _evaluation_env(
    source: Any, env: VectorEnv | None, backend: str, kwargs: dict[str, Any], episodes: int
) -> VectorEnv | None:
    """Environments of its own for evaluation; None where the only one there is is being trained in."""
    if source is None or env is None:
        return None
    if isinstance(env, Vectorized):
        return vectorize(env.env, lanes_for(episodes, compiled=True))
    if isinstance(source, VectorEnv) or isinstance(source, (gymnasium.Env, gymnasium.vector.VectorEnv)):
        return None if hosted(env) else env
    compiled = not hosted(env)
    return make(
        source,
        lanes_for(episodes, compiled),
        backend=backend if compiled or not isinstance(source, str) else _backend(env),  # type: ignore[arg-type]
        **kwargs,
    )
