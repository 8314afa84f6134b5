"""`rtg collect`: a trained policy plays whole episodes, which become a dataset.

Each of L environments gives its first N / L episodes, so that short ones have no better chance to be among the N. An
action is stored as the environment got it. With noise, what the policy chose is kept beside it (`extras["expert_action"]`):
the data then shows where errors lead and what the expert does there (DART, Laskey et al. 2017).
"""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core import (
    MASK,
    Action,
    Actor,
    Carry,
    EnvSpec,
    Learner,
    Observation,
    Policy,
    PRNGKey,
    Transition,
    VectorEnv,
    env_spec,
)
from ..data.checks import require_spec
from ..data.episodes import Dataset, require_new, save_dataset
from ..data.noise import EXPERT, check_noise, perturb
from ..envs.gymnasium import failure_of, hosted
from ..envs.registry import COMPILED, make
from ..loops.collect import begin, collect
from .evaluate import MAX_STEPS, lanes_for
from .folder import RunFolder, safe_name
from .plan import versions
from .policy import load

UNROLL = 128
"""Steps in each environment that one call of the program takes."""


def collect_demonstrations(
    run_path: str | Path,
    episodes: int = 10,
    out: str | Path | None = None,
    env: Any = None,
    backend: str = "auto",
    deterministic: bool = True,
    seed: int = 0,
    noise: float = 0.0,
    checkpoint: str = "last",
    learner: Learner | None = None,
) -> tuple[Path, dict[str, Any]]:
    """Play `episodes` whole episodes with the policy of a run and write them as a dataset.

    - `out`: a new folder; `datasets/ENV-NUMBER` if not given.
    - `env`, `backend`: another environment than the run's.
    - `deterministic`: the likeliest actions; otherwise sampled ones, whose `log_prob` is kept.
    - `noise`: on the actions, as `data.perturb` makes it.
    - `checkpoint`: the `"last"` or the `"best"` policy; `learner`: for a run of a learner from elsewhere.

    Returns the folder and `{"episodes", "steps", "return_mean", "length_mean"}`. Raises `ValueError` for a request that
    cannot be met, `EnvironmentFailure` where the environment fails.
    """
    if isinstance(episodes, bool) or not isinstance(episodes, int) or episodes < 1:
        raise ValueError(f"the number of episodes must be at least 1, not {episodes}")
    config = RunFolder(run_path).config()
    loaded = load(run_path, learner=learner, checkpoint=checkpoint)
    check_noise(loaded.spec.action, noise)
    if out is not None:
        require_new(Path(out))
    name, vector_env = _environment(config["env"], env, backend, episodes)
    try:
        require_spec(loaded.spec, env_spec(vector_env), "the policy")
        inner = loaded.policy(explore=not deterministic)
        policy = Recorded(inner, loaded.spec, float(noise), not deterministic)
        dataset = play(vector_env, policy, episodes, jax.random.key(seed))
    finally:
        for foreign in hosted(vector_env):
            foreign.close()
    found = {
        "episodes": dataset.num_episodes,
        "steps": dataset.num_steps,
        "return_mean": float(dataset.returns.mean()),
        "length_mean": float(dataset.lengths.mean()),
    }
    about = {
        "env": name,
        "collector": {"run": str(run_path), "algorithm": config["algorithm"], "checkpoint": checkpoint},
        "deterministic": deterministic,
        "noise": noise,
        "seed": seed,
        "return_mean": found["return_mean"],
        "versions": versions(),
    }
    return save_dataset(numbered_dataset(safe_name(name)) if out is None else out, dataset, about), found


class Recorded(Policy):
    """Another policy, whose actions are those that the environment gets: clipped, and with noise if there is any."""

    policy: Policy
    spec: EnvSpec = eqx.field(static=True)
    noise: float = eqx.field(static=True, default=0.0)
    keep_log_prob: bool = eqx.field(static=True, default=False)

    def init(self, key: PRNGKey) -> Carry:
        return self.policy.init(key)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        act_key, noise_key = jax.random.split(key)
        carry, action, extras = self.policy(carry, observation, act_key)
        action = self.spec.action.clip(action)
        if self.noise:
            mask = observation.get(MASK) if isinstance(observation, dict) else None
            return carry, perturb(self.spec.action, action, self.noise, noise_key, mask), {EXPERT: action}
        kept = {"log_prob": extras["log_prob"]} if self.keep_log_prob and "log_prob" in extras else {}
        return carry, action, kept

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.policy.inspect(carry, observation)


def play(env: VectorEnv, policy: Policy, episodes: int, key: PRNGKey) -> Dataset:
    """Exactly `episodes` whole episodes: how many each environment gives is settled before any is played.

    Raises `ValueError` where an episode does not end, `EnvironmentFailure` where a foreign environment fails.
    """
    lanes = env.num_envs
    quota = episodes // lanes + (np.arange(lanes) < episodes % lanes)
    begin_key, loop_key = jax.random.split(key)
    blocks: list[Transition] = []
    try:
        actor = _begin(env, policy, begin_key)
        finished = np.zeros(lanes, int)
        while np.any(finished < quota):
            if len(blocks) * UNROLL >= MAX_STEPS * quota.max():
                raise ValueError(
                    f"an episode of this environment did not end within {len(blocks) * UNROLL} steps: give the environment "
                    "a time limit (gymnasium.make(..., max_episode_steps=N), or rtg.envs.TimeLimit)"
                )
            actor, steps = _go_on(env, policy, actor, jax.random.fold_in(loop_key, len(blocks)))
            blocks.append(jax.device_get(steps))
            finished += np.sum(blocks[-1].terminated | blocks[-1].truncated, axis=0)
    except Exception as error:
        failure = failure_of(env)
        raise (failure or error) from (error if failure else None)
    table: Any = jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)
    done = table.terminated | table.truncated
    stop = [np.flatnonzero(done[:, lane])[n - 1] + 1 if n else 0 for lane, n in enumerate(quota)]
    row = jax.tree.map(lambda x: jnp.asarray(np.concatenate([x[:n, lane] for lane, n in enumerate(stop)])), table)
    return Dataset.of(row, env_spec(env))


@jax.jit
def _begin(env: VectorEnv, policy: Policy, key: Array) -> Actor:
    return begin(env, policy, key)


@jax.jit
def _go_on(env: VectorEnv, policy: Policy, actor: Actor, key: Array) -> tuple[Actor, Transition]:
    actor, rollout, _ = collect(env, policy, actor, key, UNROLL)
    return actor, rollout.transitions


def _environment(described: dict[str, Any], env: Any, backend: str, episodes: int) -> tuple[str, VectorEnv]:
    """The name of the environment to play in, and L of them, L a divisor of the number of episodes where we may choose."""
    kwargs: dict[str, Any] = {}
    name = env if isinstance(env, str) else type(env).__name__
    if env is None:
        if not described["by_name"]:
            raise ValueError(
                f"the run was made with an environment object ({described['id']}), which a file cannot hold: "
                "name the environment to play in"
            )
        name = env = described["id"]
        backend = described["backend"] if backend == "auto" else backend
        # Rewards of a dataset are the environment's own, whatever they were divided by for the learner.
        kwargs = {key: value for key, value in described["kwargs"].items() if key != "normalise_reward"}
    if isinstance(env, VectorEnv):
        return name, env
    compiled = backend not in ("gymnasium", "envpool") and (not isinstance(env, str) or env in COMPILED)
    return name, make(env, lanes_for(episodes, compiled), backend=backend, **kwargs)  # type: ignore[arg-type]


def numbered_dataset(name: str) -> Path:
    """The first folder `datasets/NAME-NUMBER` that is not there yet."""
    number = 1
    while (Path("datasets") / f"{name}-{number}").exists():
        number += 1
    return Path("datasets") / f"{name}-{number}"
