"""`rtg plan`: an environment that is its own model, played by planning in it."""

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ..catalogue import nearest
from ..core import Environment, EnvSpec, Observed, env_spec
from ..envs.known import KnownModel
from ..envs.registry import COMPILED
from ..envs.time_limit import TimeLimit
from ..envs.vectorize import vectorize
from ..planning.mpc import MPC, PLANNERS
from ..planning.problem import ModelProblem
from .config import build, merge
from .evaluate import Evaluator, lanes_for, summary
from .play import film_of
from .policy import LoadedPolicy


@dataclasses.dataclass(frozen=True)
class Played:
    """Episodes that were played by planning: what was asked, and what came out."""

    planner: str
    env: str
    policy: MPC
    spec: EnvSpec
    returns: Float[np.ndarray, "N"]
    lengths: Float[np.ndarray, "N"]
    seconds: float

    @property
    def seconds_per_plan(self) -> float:
        """Time of a plan, where several episodes go side by side its share of theirs."""
        return self.seconds / max(1.0, float(np.ceil(self.lengths / self.policy.every).sum()))

    def to_json(self) -> dict[str, Any]:
        """Plain data: what `rtg plan --json` prints."""
        return {
            "planner": self.planner,
            "env": self.env,
            "horizon": self.policy.problem.horizon,
            "every": self.policy.every,
            **summary(self.returns, self.lengths),
            "seconds_per_plan": self.seconds_per_plan,
        }

    def film(self, path: str | Path, seed: int = 0) -> tuple[Path, float, int]:
        """Draw an episode: file, return and length. Raises `ValueError` as `play` does."""
        policy = LoadedPolicy({"greedy": self.policy, "explore": self.policy}, self.spec, {})
        described = {"id": self.env, "backend": "jax", "by_name": True, "kwargs": {}}
        return film_of(policy, described, Path(path), seed)


def plan_by_name(
    planner: str,
    env: str,
    *,
    horizon: int = 25,
    every: int = 1,
    episodes: int = 10,
    seed: int = 0,
    gamma: float = 1.0,
    options: dict[str, Any] | None = None,
) -> Played:
    """Play episodes of an environment with `MPC` in its own dynamics.

    - `planner`: a name in `planning.PLANNERS`, `options` its settings.
    - `horizon`: actions of a plan; `every`: how many of them are done before the next plan.

    Raises `ValueError`, one sentence, for unknown names, and for environments that are no model of themselves.
    """
    if planner not in PLANNERS:
        raise ValueError(f"there is no planner {planner!r}: {nearest(planner, PLANNERS)}")
    if not 0 <= gamma <= 1:
        raise ValueError(f"the discount must be a number in [0, 1], not {gamma:g}")
    whole = _compiled(env)
    inner = whole.env if isinstance(whole, TimeLimit) else whole
    if not isinstance(inner, Observed):
        raise ValueError(
            f"an observation of {env} does not tell its state, so there is nothing to plan from: use one of {', '.join(plannable())}"
        )
    cls, fixed = PLANNERS[planner]
    recipe = build(cls, merge(fixed, options or {}))
    spec = env_spec(inner)
    policy = MPC(ModelProblem(KnownModel(inner), horizon, spec.action, gamma), recipe, every)
    evaluator = Evaluator(vectorize(whole, lanes_for(episodes, True)), episodes)
    evaluator.prepare(policy)
    began = time.perf_counter()
    returns, lengths = evaluator(policy, jax.random.key(seed))
    return Played(planner, env, policy, spec, returns, lengths, time.perf_counter() - began)


def _compiled(env: str) -> Environment:
    if env not in COMPILED:
        raise ValueError(f"planning needs the dynamics, and there is no compiled {env!r}: {nearest(env, plannable())}")
    return COMPILED[env]()


def plannable() -> list[str]:
    """The environments that can be planned in by name."""
    found = []
    for name, make in COMPILED.items():
        env = make()
        if isinstance(env.env if isinstance(env, TimeLimit) else env, Observed):
            found.append(name)
    return found


def report(played: Played) -> str:
    """A line or two for people."""
    data = played.to_json()
    low, high = data["return_ci95"]
    return (
        f"{played.env} by {played.planner}, {data['horizon']} steps ahead, a plan every "
        f"{'step' if data['every'] == 1 else str(data['every']) + ' steps'}: return {data['return_mean']:.1f} [{low:.1f}, {high:.1f}] "
        f"over {data['episodes']} episodes\n{1e3 * played.seconds_per_plan:.2f} ms a plan"
    )
