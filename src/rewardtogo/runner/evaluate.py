"""How good a policy is: whole episodes, as many from each environment, with a confidence interval.

Each of L environments plays the same number of episodes to their ends and what it does beyond that is ignored. Stopping at the first
N episodes that happen to end would favour short ones.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..core import Action, Actor, Algorithm, Carry, Observation, Policy, PRNGKey, State, VectorEnv, env_spec
from ..envs.gymnasium import failure_of
from ..loops.collect import begin, fresh_carry, reset_where

MAX_STEPS = 50_000
"""Steps an environment may take for one episode before evaluation gives up on it."""
BOOTSTRAP = 10_000


class Returns(eqx.Module):
    """Undiscounted returns and lengths of episodes, `[Q, L]`: Q episodes in each of L environments."""

    returns: Float[Array, "Q L"]
    lengths: Float[Array, "Q L"]
    finished: Float[Array, "L"]


@partial(jax.jit, static_argnames=("rows",))
def _play(env: VectorEnv, policy: Policy, key: Array, quota: Array | int, rows: int) -> Returns:
    """Play `quota` episodes in each environment, at most `rows`: one program serves every number up to it."""
    action_spec, lanes = env_spec(env).action, env.num_envs
    begin_key, carry_key, loop_key = jax.random.split(key, 3)
    fresh = fresh_carry(policy, carry_key, lanes)
    table = jnp.zeros((rows, lanes))

    def going(loop: tuple) -> Array:
        _, returns, step = loop
        return (returns.finished < quota).any() & (step < MAX_STEPS * quota)

    def body(loop: tuple[Actor, Returns, Array]) -> tuple[Actor, Returns, Array]:
        actor, found, step = loop
        act_keys, env_keys = jax.random.split(jax.random.fold_in(loop_key, step), (2, lanes))
        choose = jax.vmap(lambda c, o, k: policy(c, o, k))
        carry, action, _ = choose(actor.carry, actor.observation, act_keys)
        env_state, timestep = env.step(actor.env_state, action_spec.clip(action), env_keys)
        done = timestep.done
        total, length = actor.stats.return_so_far + timestep.score, actor.stats.length_so_far + 1.0
        here = (jnp.arange(rows, dtype=jnp.float32)[:, None] == found.finished[None, :]) & done[None, :]
        found = Returns(
            jnp.where(here, total[None, :], found.returns),
            jnp.where(here, length[None, :], found.lengths),
            found.finished + done,
        )
        stats = type(actor.stats)(jnp.where(done, 0.0, total), jnp.where(done, 0.0, length))
        return Actor(env_state, timestep.observation, reset_where(done, fresh, carry), stats), found, step + 1

    start = (begin(env, policy, begin_key), Returns(table, table, jnp.zeros(lanes)), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(going, body, start)[1]


class Either(Policy):
    """An algorithm's policy as it learns or as it is at its best, as `explore` says: one compiled program plays both.

    Each keeps a memory of its own, since they may differ in kind (a noise that remembers its last value).
    """

    best: Policy
    exploring: Policy
    explore: Bool[Array, ""]

    @staticmethod
    def of(algorithm: Algorithm, state: State, explore: bool) -> "Either":
        """The policies that a state holds."""
        return Either(algorithm.policy(state, False), algorithm.policy(state, True), jnp.asarray(explore))

    def init(self, key: PRNGKey) -> Carry:
        return self.best.init(key), self.exploring.init(key)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        def best() -> tuple[Carry, Action]:
            after, action, _ = self.best(carry[0], observation, key)
            return (after, carry[1]), action

        def exploring() -> tuple[Carry, Action]:
            after, action, _ = self.exploring(carry[1], observation, key)
            return (carry[0], after), action

        # One of them, not both: a policy that plans takes its time.
        after, action = jax.lax.cond(self.explore, exploring, best)
        return after, action, {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.best.inspect(carry[0], observation)


class Evaluator:
    """Plays policies in `env`, `episodes` at a time. Policies of one kind share one compiled program.

    A call may ask for another number of episodes; up to `most` the same program serves.
    With `seeds`, policies have a leading axis of seeds and so have the results.
    """

    def __init__(self, env: VectorEnv, episodes: int, seeds: bool = False, most: int = 0):
        if episodes < 1:
            raise ValueError(f"an evaluation needs at least one episode, not {episodes}")
        self.env, self.seeds, self.episodes = env, seeds, episodes
        self._rows = self._quota(max(episodes, most))

    def _quota(self, episodes: int) -> int:
        return -(-episodes // self.env.num_envs)

    def prepare(self, policy: Policy) -> None:
        """Compile what plays policies of this kind, by playing no episode at all."""
        self._play(policy, jax.random.key(0), 0, self._rows)

    def _play(self, policy: Policy, key: Array, quota: int, rows: int) -> Any:
        play: Callable[..., Any] = partial(_play, rows=rows)
        if self.seeds:
            play = jax.vmap(play, in_axes=(None, 0, None, None))
        return jax.device_get(play(self.env, policy, key, quota))

    def __call__(self, policy: Policy, key: Array, episodes: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Returns and lengths `[N]` (`[K, N]` with seeds), N the episodes asked for, rounded up to whole rounds.

        Raises `ValueError` where an episode does not end, `EnvironmentFailure` where a foreign environment fails.
        """
        quota = self._quota(self.episodes if episodes is None else episodes)
        try:
            found = self._play(policy, key, quota, max(self._rows, quota))
        except Exception as error:
            failure = failure_of(self.env)
            raise (failure or error) from (error if failure else None)
        if np.any(found.finished < quota):
            raise ValueError(
                f"an episode of this environment did not end within {MAX_STEPS * quota} steps, so it has no return: "
                "give the environment a time limit (gymnasium.make(..., max_episode_steps=N), or rtg.envs.TimeLimit)"
            )
        flat = (*found.returns.shape[:-2], -1)
        return found.returns[..., :quota, :].reshape(flat), found.lengths[..., :quota, :].reshape(flat)


def lanes_for(episodes: int, compiled: bool) -> int:
    """How many environments to evaluate in: the divisor of `episodes` nearest below 20 (compiled) or 8 (on the host)."""
    most = 20 if compiled else 8
    return max(n for n in range(1, min(most, episodes) + 1) if episodes % n == 0)


def confidence(
    values: np.ndarray, statistic: Callable[..., np.ndarray] = np.mean, level: float = 0.95
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic of independent values (Efron 1979), the same for the same values."""
    values = np.asarray(values, np.float64)
    if len(values) < 2:
        return float(values[0]), float(values[0])
    draws = np.random.default_rng(0).integers(0, len(values), (BOOTSTRAP, len(values)))
    spread = statistic(values[draws], axis=1)
    low, high = np.quantile(spread, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def summary(returns: np.ndarray, lengths: np.ndarray) -> dict[str, Any]:
    """What `rtg eval --json` prints."""
    return {
        "episodes": len(returns),
        "return_mean": float(np.mean(returns)),
        "return_std": float(np.std(returns, ddof=1)) if len(returns) > 1 else 0.0,
        "return_ci95": list(confidence(returns)),
        "length_mean": float(np.mean(lengths)),
    }
