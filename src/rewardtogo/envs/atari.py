"""Atari games of the Arcade Learning Environment (Bellemare et al. 2013), prepared as is usual (Machado et al. 2018; Mnih et al. 2015).

`ale-py` (extra `atari`) brings the games and steps B of them by threads of C++, which also do what each step of a game needs: the action is
repeated for 4 frames, the last two of which are joined by their maximum, made grey and 84 x 84; the last 4 pictures are stacked; an episode
begins with up to 30 idle frames. What is put right here, on the way to the door:

- Pictures have their channels last, `[84, 84, 4]`, the oldest first. An episode's first stack is blank but for its newest picture.
- Rewards are cut into [-1, 1], and the game's own score stays in `extras["raw_reward"]`, which is what returns are made of.
- `episodic_life` ends an episode, as terminated, where a life is lost, and the game goes on with the next one (`ale-py`'s option of that
  name would begin the game anew). The stack is blank then too, so that no picture of the life before is seen.

Actions are sometimes ignored in favour of the last one (`repeat_action_probability`, 0.25 in ids `-v5`), so that a game cannot be learnt by
heart. The limit of 108,000 frames, half an hour, truncates.

NumPy only, like everything behind the door.
"""

import importlib
from typing import Any

import gymnasium
import gymnasium.spaces as spaces
import gymnasium.vector as vector
import numpy as np
from gymnasium.vector.utils import batch_space

from ..catalogue import nearest

PREFIX = "ALE/"
"""How the ids of these games begin."""
RAW_REWARD = "raw_reward"
OPTIONS: dict[str, Any] = {
    "frame_skip": 4,
    "stack": 4,
    "size": 84,
    "noop_max": 30,
    "max_frames": 108_000,
    "clip_rewards": True,
    "episodic_life": False,
    "fire_reset": False,
    "full_action_space": False,
    "repeat_action_probability": None,
    "num_threads": 0,
}
"""What can be said of a game, and the defaults; None: what the id says."""


def _package() -> Any:
    try:
        importlib.import_module("ale_py")  # tells Gymnasium the ids
        return importlib.import_module("ale_py.vector_env")
    except ImportError as error:
        raise ValueError(
            f"Atari games need the package ale-py, which cannot be imported here ({error}): pip install 'rewardtogo[atari]'"
        ) from error


def _checked(name: str, kwargs: dict[str, Any]) -> dict[str, Any]:
    for option, value in kwargs.items():
        if option not in OPTIONS:
            raise ValueError(f"{name} has no option {option!r}: {nearest(option, OPTIONS)}")
        default = OPTIONS[option]
        if isinstance(default, bool) and not isinstance(value, bool):
            raise ValueError(f"the option {option} of {name} must be true or false, not {value!r}")
        least = {"frame_skip": 1, "stack": 1, "size": 1, "max_frames": 1}.get(option, 0)
        whole = isinstance(value, int) and not isinstance(value, bool)
        if isinstance(default, int) and not isinstance(default, bool) and not (whole and value >= least):
            raise ValueError(f"the option {option} of {name} must be a whole number of at least {least}, not {value!r}")
    given = OPTIONS | kwargs
    sticky = given["repeat_action_probability"]
    if sticky is not None and not (isinstance(sticky, (int, float)) and 0 <= sticky <= 1):
        raise ValueError(f"the option repeat_action_probability of {name} must be in [0, 1], not {sticky!r}")
    return given


class Atari(vector.VectorEnv):
    """B copies of one game.

    - `name`: an id such as `ALE/Pong-v5`.
    - `num_envs`: B.
    - `kwargs`: some of `OPTIONS`.

    Raises `ValueError` where `ale-py` is not installed, does not have the game, or an option cannot be so.
    """

    metadata = {"autoreset_mode": vector.AutoresetMode.SAME_STEP, "render_fps": 15}

    def __init__(self, name: str, num_envs: int = 1, kwargs: dict[str, Any] | None = None) -> None:
        package, given = _package(), _checked(name, dict(kwargs or {}))
        if num_envs < 1:
            raise ValueError(f"there must be at least one environment, not {num_envs}")
        known = [known for known in gymnasium.registry if known.startswith(PREFIX)]
        if name not in known:
            raise ValueError(f"there is no Atari game {name!r}: {nearest(name, known)}")
        self.spec = gymnasium.spec(name)
        said = self.spec.kwargs
        sticky = given["repeat_action_probability"]
        self._games: Any = package.AtariVectorEnv(
            said["game"],
            num_envs,
            autoreset_mode=vector.AutoresetMode.SAME_STEP,
            frameskip=given["frame_skip"],
            stack_num=given["stack"],
            img_height=given["size"],
            img_width=given["size"],
            noop_max=given["noop_max"],
            max_num_frames_per_episode=given["max_frames"],
            repeat_action_probability=said["repeat_action_probability"] if sticky is None else float(sticky),
            full_action_space=given["full_action_space"],
            use_fire_reset=given["fire_reset"],
            num_threads=given["num_threads"],
            reward_clipping=False,
        )
        self.num_envs, self._stack = num_envs, given["stack"]
        self._clip, self._by_life = given["clip_rewards"], given["episodic_life"]
        # How many pictures of its stack each copy may see: what is older is of the life before.
        self._lives, self._seen = np.zeros(num_envs), np.full(num_envs, given["stack"])
        shape: tuple[int, ...] = (given["size"], given["size"], given["stack"])
        self.single_observation_space = spaces.Box(0, 255, shape, np.uint8)
        self.single_action_space = self._games.single_action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """All copies begin a game."""
        if (options or {}).get("reset_mask") is not None:
            raise ValueError("these games begin anew by themselves in the step in which they end, and not when asked")
        seeds = None if seed is None else seed if isinstance(seed, int) else np.asarray(seed)
        pictures, info = self._games.reset(seed=seeds)
        self._lives = np.array(info["lives"])
        self._seen = np.full(self.num_envs, self._stack)
        return self._turned(pictures), {RAW_REWARD: np.zeros(self.num_envs)}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of all copies; where an episode ends, the observation is already the next one's first."""
        pictures, reward, terminated, truncated, said = self._games.step(np.asarray(actions, np.int32))
        over, raw = terminated | truncated, np.array(reward, np.float64)
        self._seen = np.where(over, self._stack, self._seen + 1)
        observation = self._blanked(self._turned(pictures))
        final, lives = observation, np.array(said["lives"])
        if over.any():
            final = observation.copy()
            final[over] = self._turned(said["final_obs"])[over]
        if self._by_life:
            lost = ~over & (lives < self._lives)
            terminated = terminated | lost
            self._seen = np.where(lost, 1, self._seen)
            observation = self._blanked(observation)
        self._lives = lives
        info: dict[str, Any] = {RAW_REWARD: raw}
        if (terminated | truncated).any():
            info |= {"final_obs": final, "final_info": {RAW_REWARD: raw}}
        return observation, np.clip(raw, -1.0, 1.0) if self._clip else raw, terminated, truncated, info

    def newest(self, observation: np.ndarray) -> np.ndarray:
        """The newest picture of a stack, in colour channels and four times as large, for a film."""
        return np.repeat(observation[..., -1:], 3, -1).repeat(4, 0).repeat(4, 1)

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._games = None

    @staticmethod
    def _turned(pictures: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.moveaxis(pictures, 1, -1))

    def _blanked(self, observation: np.ndarray) -> np.ndarray:
        stack = observation.shape[-1]
        if not self._by_life or (self._seen >= stack).all():
            return observation
        shown = np.arange(stack)[None] >= stack - self._seen[:, None]
        return observation * shown[:, None, None, :].astype(np.uint8)


class Game(gymnasium.Env):
    """One game as a single environment whose picture is what the agent sees, for `rtg play`. Rewards are the game's own score."""

    def __init__(self, name: str, render_mode: str | None = None, **kwargs: Any) -> None:
        self.games = Atari(name, 1, {**kwargs, "clip_rewards": False, "episodic_life": False})
        self.spec, self.render_mode = self.games.spec, render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": self.games.metadata["render_fps"]}
        self.observation_space = self.games.single_observation_space
        self.action_space = self.games.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin a game."""
        del options
        self._now = self.games.reset(seed=seed)[0][0]
        return self._now, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One step; after the last one a new game must be asked for."""
        observation, reward, terminated, truncated, info = self.games.step(np.asarray([action]))
        self._now = info["final_obs"][0] if "final_obs" in info else observation[0]
        return self._now, float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}

    def render(self) -> np.ndarray:
        """What the agent saw last."""
        return self.games.newest(self._now)
