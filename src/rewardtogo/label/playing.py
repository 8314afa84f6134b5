"""A person plays an environment, and the episodes that are kept become a dataset of demonstrations (item 2.4).

The environment is that of training: the compiled twin or Gymnasium's own behind its door. Attempt k of seed s begins with the key
`fold_in(key(s), k)`: its 0th fold resets, its fold t + 1 is that of step t. So a script that plays gives, bit for bit, what stepping the
environment by hand gives, and an attempt that was thrown away costs nothing but its number.

An episode that ends is kept, and on the disk at once; until the next one begins it can be thrown away still. One that goes on can be
thrown away, or cut and kept as truncated.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium.envs.registration as registration
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..core import MASK, PRNGKey, State, VectorEnv, env_spec
from ..data.growing import GrowingDataset
from ..data.trajectories import Trajectory
from ..envs.drawing import observed, picture
from ..envs.gymnasium import failure_of, hosted
from ..envs.registry import make
from ..envs.vectorize import Vectorized
from ..runner.collect import numbered_dataset
from ..runner.experts import PERSON
from ..runner.folder import safe_name
from ..runner.plan import described_env, versions
from .actions import allowed, element
from .film import Held, drawing, png, singles

EPISODES = 10
"""Episodes where nobody says how many."""
MOST_EPISODES = 1_000_000
FASTEST = 15.0
"""Steps a second beyond which few people can play; who can may ask for more."""


class Playing:
    """An environment that somebody plays, and the dataset of what they kept. Made by `start_playing`; from one thread at a time.

    - `observation`: what is seen now, one element; `step`, `total`: actions in this episode so far, and the sum of their rewards.
    - `attempt`: the number of this episode among all that were begun, from 0; those thrown away count.
    - `over`: how it ended, `"terminated"`, `"truncated"` or `"cut"`; None while it goes on.
    - `dataset`: the folder, `episodes`: how many it is to have.
    """

    def __init__(self, described: dict[str, Any], env: VectorEnv, dataset: GrowingDataset, seed: int, episodes: int):
        self.described, self.env, self.spec, self.dataset = described, env, env_spec(env), dataset
        self.episodes = episodes
        self.attempt = int(dataset.about.get("begun", 0))
        self.over: str | None = None
        self._seed_key = jax.random.key(seed)
        found = singles(env)
        if found is not None:
            found.envs = [Held(one) for one in found.envs]
        self._held: Held | None = None if found is None else found.envs[0]
        try:
            if not hosted(env):  # compiled before the first step is played, and not in it
                state, _ = _reset(env, self._seed_key)
                _step(env, state, self.spec.action.zeros(), self._seed_key, np.int32(0))
            self._begin()
        except BaseException:
            self.close()
            raise

    # --- where it stands ---------------------------------------------------------------------------------------------------------

    @property
    def kept(self) -> int:
        """Episodes in the dataset."""
        return self.dataset.num_episodes

    @property
    def complete(self) -> bool:
        """Whether as many episodes are kept as were asked for."""
        return self.kept >= self.episodes

    @property
    def allowed(self) -> np.ndarray | None:
        """Which actions are allowed now, where the observation says so."""
        return allowed(self.spec.action, self.observation)

    def picture(self) -> bytes | None:
        """What is seen now as a PNG file; None where the environment has no picture."""
        if self._held is not None and (drawn := self._held.picture()) is not None:
            return drawn
        if isinstance(self.env, Vectorized):
            seen = picture(self.env.env, _only(jax.device_get(self._state)), self.observation)
        else:
            seen = observed(self.spec.observation.to_space(), self.observation)
        return None if seen is None else png(seen)

    def result(self) -> dict[str, Any]:
        """`episodes`, `steps`, `return_mean` and `length_mean` of the dataset, as `rtg collect` gives them; None for means of nothing."""
        lengths, returns = self.dataset.lengths, self.dataset.returns
        return {
            "episodes": self.kept,
            "steps": sum(lengths),
            "return_mean": float(np.mean(returns)) if returns else None,
            "length_mean": float(np.mean(lengths)) if lengths else None,
        }

    # --- what the player does ----------------------------------------------------------------------------------------------------

    def act(self, action: Any) -> None:
        """Take an action, an element of the action space (discrete ones count from 0). At its end the episode is kept.

        Raises `ValueError` where it is not in the space, forbidden, or the episode is over; `EnvironmentFailure` where a
        foreign environment fails.
        """
        if self.over is not None:
            raise ValueError(
                f"this episode is over after {self.step} steps: begin the next one, or throw this one away"
            )
        taken = element(self.spec.action, action, self.allowed)
        self._state, (after, reward, terminated, truncated) = self._guarded(
            lambda: _step(self.env, self._state, jnp.asarray(taken), self._key, np.int32(self.step))
        )
        self._actions.append(taken)
        self._rewards.append(reward)
        self._observations.append(after)
        self.observation = after
        self.total += float(reward)
        if terminated or truncated:
            self._keep("terminated" if terminated else "truncated", bool(terminated), bool(truncated))

    def keep(self) -> None:
        """Cut the episode here and keep it as truncated: its last observation still has a value."""
        if self.over is not None:
            raise ValueError("this episode is over and kept already: begin the next one")
        if not self._actions:
            raise ValueError("no action is taken in this episode yet, so there is nothing to keep")
        self._keep("cut", False, True)

    def discard(self) -> None:
        """Throw this episode away, the one in progress or the one that has just ended, and begin another one."""
        if self.over is not None:
            self.dataset.drop()
        self._begin()

    def begin(self) -> None:
        """Begin the next episode, when the last one is over."""
        if self.over is None:
            raise ValueError("this episode is not over yet: keep it as it is, or throw it away")
        if self.complete:
            raise ValueError(f"all {self.episodes} episodes are kept: ask for more with more episodes")
        self._begin()

    def close(self) -> None:
        """Let go of the environment and the folder; what was kept is on the disk already."""
        self.dataset.close()
        for env in hosted(self.env):
            env.close()

    def __enter__(self) -> "Playing":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # --- episodes ----------------------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        self._key = jax.random.fold_in(self._seed_key, self.attempt)
        self.attempt += 1
        self._state, self.observation = self._guarded(lambda: _reset(self.env, self._key))
        self._observations, self._actions, self._rewards = [self.observation], [], []
        self.over, self.total = None, 0.0

    @property
    def step(self) -> int:
        """Actions taken in this episode."""
        return len(self._actions)

    def _keep(self, how: str, terminated: bool, truncated: bool) -> None:
        stack = lambda *parts: jnp.asarray(np.stack(parts))  # noqa: E731
        episode = Trajectory(
            jax.tree.map(stack, *self._observations),
            stack(*self._actions),
            stack(*self._rewards),
            jnp.asarray(terminated),
            jnp.asarray(truncated),
            {},
        )
        self.dataset.add(episode, begun=self.attempt)
        self.over = how

    def _guarded(self, call: Callable[[], Any]) -> Any:
        """What a program gives, in NumPy. Raises the environment's own failure, in one sentence, in place of JAX's."""
        try:
            state, found = call()
            return state, jax.device_get(found)
        except Exception as error:
            failure = failure_of(self.env)
            raise (failure or error) from (error if failure else None)


@jax.jit
def _reset(env: VectorEnv, key: PRNGKey) -> tuple[State, PyTree[Array]]:
    state, observation = env.reset(jax.random.fold_in(key, 0)[None])
    return state, _only(observation)


@jax.jit
def _step(
    env: VectorEnv, state: State, action: Array, key: PRNGKey, step: Array
) -> tuple[State, tuple[PyTree[Array], Array, Array, Array]]:
    key = jax.random.fold_in(key, step + 1)
    if isinstance(env, Vectorized):
        # As in `Vectorized.step`, but without the automatic reset: where the episode ended is to be looked at.
        inner = env.env
        state, t = jax.vmap(lambda s, a, k: inner.step(s, a, k))(state, action[None], jax.random.split(key)[:1])
    else:
        state, t = env.step(state, action[None], key[None])
    return state, _only((t.final_observation, t.reward, t.terminated, t.truncated))


def _only(tree: PyTree) -> PyTree:
    """That of the one environment there is."""
    return jax.tree.map(lambda x: x[0], tree)


def start_playing(
    env: Any,
    *,
    out: str | Path | None = None,
    episodes: int = EPISODES,
    seed: int | None = None,
    backend: str = "auto",
    env_kwargs: dict[str, Any] | None = None,
    player: str = PERSON,
) -> Playing:
    """Begin to play an environment, or go on with a dataset that was begun so.

    - `env`, `backend`, `env_kwargs`: as in `rtg.train`.
    - `out`: the dataset's folder; `datasets/ENV-NUMBER` if not given. One that holds episodes which the same player played in the same
      environment is added to.
    - `episodes`: how many it is to have, those included that are there already.
    - `seed`: of the environment, 0 if not given; that of the dataset where there is one.
    - `player`: who plays, as `dataset.json` will say.

    Raises `ValueError`, in one sentence, for a request that cannot be met; `Damaged` where the folder's data cannot be read.
    """
    if isinstance(episodes, bool) or not isinstance(episodes, int) or not 1 <= episodes <= MOST_EPISODES:
        raise ValueError(f"there must be at least one episode and at most {MOST_EPISODES:,}, not {episodes}")
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**32):
        raise ValueError(f"a seed is a whole number from 0 to 2^32 - 1, not {seed}")
    kwargs = dict(env_kwargs or {})
    if "normalise_reward" in kwargs:
        raise ValueError("demonstrations have the environment's own rewards: leave normalise_reward out")
    made = make(env, None if isinstance(env, VectorEnv) else 1, backend=backend, **kwargs)  # type: ignore[arg-type]
    described = described_env(env, made, kwargs)
    if made.num_envs != 1:
        raise ValueError(f"one environment can be played at a time, and this has {made.num_envs} copies: give one of 1")
    if env_spec(made).action.kind == "dict":
        raise ValueError(
            f"the actions of {described['id']} are dictionaries, which no dataset here holds: give it a plain action space"
        )
    made = drawing(described, made)
    about: dict[str, Any] = {
        "env": described["id"],
        "kwargs": kwargs,
        "backend": described["backend"],
        "collector": {"player": player},
        "versions": versions(),
    }
    dataset = _dataset(out, described["id"], made, about, seed)
    if dataset.num_episodes >= episodes:
        dataset.close()
        raise ValueError(
            f"{dataset.path} has {dataset.num_episodes} episodes already, of the {episodes} that it is to have in all: ask for more"
        )
    return Playing(described, made, dataset, dataset.about["seed"], episodes)


def _dataset(
    out: str | Path | None, name: str, env: VectorEnv, about: dict[str, Any], seed: int | None
) -> GrowingDataset:
    path = numbered_dataset(safe_name(name)) if out is None else Path(out)
    same = ["env", "kwargs", "collector", *(["seed"] if seed is not None else [])]
    dataset = GrowingDataset(path, env_spec(env), about if seed is None else {**about, "seed": seed}, same)
    dataset.about.setdefault("seed", 0)
    return dataset


def play_by(function: Callable[[Any], Any], playing: Playing) -> int:
    """A scripted player: plays with `function` of one observation until all episodes are kept. Returns how many it played."""
    before = playing.kept
    while not playing.complete:
        if playing.over is not None:
            playing.begin()
        playing.act(np.asarray(function(playing.observation)).tolist())
    return playing.kept - before


def playable_rate(playing: Playing) -> float:
    """Steps a second for a person: the environment's own where it says how fast it is drawn, at most `FASTEST`; 0 waits for each action.

    Boards and tables wait, for nothing moves in them of itself.
    """
    spec, described = playing.spec.observation, playing.described
    if spec.kind == "discrete" or MASK in (name for name, _ in spec.parts):
        return 0.0
    doors = hosted(playing.env)
    metadata = doors[0].host.envs.metadata if doors else _metadata(described["id"]) if described["by_name"] else {}
    frames = metadata.get("render_fps")
    return min(float(frames), FASTEST) if isinstance(frames, (int, float)) and frames > 0 else 0.0


def _metadata(name: str) -> dict[str, Any]:
    """What Gymnasium's original of a twin says of itself."""
    base = name.replace("NoVel", "")
    entry = registration.registry[base].entry_point if base in registration.registry else None
    maker: Any = registration.load_env_creator(entry) if isinstance(entry, str) else entry
    return {} if maker is None else maker.metadata
