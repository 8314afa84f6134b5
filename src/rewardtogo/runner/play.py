"""Watching a policy: one episode as a film, in the compiled environment it was trained in, or in Gymnasium's own, which draws itself."""

import importlib
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
from PIL import Image

from ..core import MASK, Environment, Learner, env_spec
from ..envs import atari
from .episode import compiled_env, drawn, endless, played
from .evaluate import MAX_STEPS
from .folder import RunFolder
from .policy import LoadedPolicy, load

ENDINGS = (".gif", ".mp4")
SECONDS = 6.0
"""How long a film of a compiled environment lasts, whose steps have no time of their own, within `SLOWEST` and `FASTEST`."""
SLOWEST = 2
"""Frames a second."""
MOST_FRAMES = 3000
"""Frames after which a film ends; the episode goes on without being drawn."""
FASTEST = 50
"""Frames a second beyond which programs that show GIFs slow them down; a faster environment is shown in every other frame."""


def play(
    run: str | Path,
    out: str | Path | None = None,
    seed: int = 0,
    checkpoint: str = "last",
    stochastic: bool = False,
    *,
    env: Any = None,
    learner: Learner | None = None,
) -> tuple[Path, float, int]:
    """Draw one episode into a film; returns its file, the episode's return and its length.

    - `out`: a `.gif` or `.mp4` (extra `video`); by default `episode.gif` in the run's folder.
    - `env`: for a run made with an environment object: a compiled one, one of Gymnasium's with `render_mode="rgb_array"`, or a function
      that makes either (the latter with that argument).
    - `learner`: needed for a run of a learner that is not part of the library.

    Raises `ValueError`, one sentence, where there is no picture to draw or a package is missing.
    """
    folder = RunFolder(run)
    config = folder.config()
    path = Path(out) if out is not None else folder.path / "episode.gif"
    require_film(path)
    policy = load(folder.path, learner, checkpoint)
    return film_of(policy, config["env"], path, seed, stochastic, env)


def require_film(path: Path) -> None:
    """Raise `ValueError` for a file that is no film by its ending."""
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"a film is written to a file ending in {' or '.join(ENDINGS)}, not to {path}")


def film_of(
    policy: LoadedPolicy,
    described: dict[str, Any],
    path: Path,
    seed: int = 0,
    stochastic: bool = False,
    env: Any = None,
) -> tuple[Path, float, int]:
    """An episode of a policy as a film. `described`: the environment as `config.json` has it."""
    require_film(path)
    compiled = compiled_env(described, env)
    if compiled is not None:
        return _compiled_film(compiled, described["id"], policy, path, seed, stochastic)
    original = drawable(described, env)
    try:
        with _Film(path, float(original.metadata.get("render_fps") or 30)) as film:
            total, length = _episode(original, policy, seed, stochastic, film)
    finally:
        if original is not env:
            original.close()
    return path, total, length


def _compiled_film(
    env: Environment, name: str, policy: LoadedPolicy, path: Path, seed: int, stochastic: bool
) -> tuple[Path, float, int]:
    if env_spec(env) != policy.spec:
        raise ValueError(f"the policy was not trained in {name}: it observes or acts in other spaces")
    states, observations, total = played(env, policy.policy(explore=stochastic), jax.random.key(seed), name, True)
    length = len(states) - 1
    rate = min(max(length / SECONDS, SLOWEST), FASTEST)
    with _Film(path, rate) as film:
        for i in range(length + 1):
            film.add(lambda i=i: drawn(env, name, states, observations, i))
        last = drawn(env, name, states, observations, length)
        # The end can be looked at for a second.
        for _ in range(round(rate)):
            film.add(lambda: last)
    return path, total, length


def without_a_screen() -> None:
    """Let environments draw into memory on a machine without a display."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("MUJOCO_GL", "egl")


def drawable(described: dict[str, Any], env: Any = None) -> gymnasium.Env:
    """Gymnasium's environment, ready to be drawn. Raises `ValueError` where there is none, or it has no picture."""
    without_a_screen()
    if isinstance(env, gymnasium.Env):
        return env
    name = described["id"]
    if env is None and not described["by_name"]:
        raise ValueError(
            f"the run was made with an environment object ({name}), which a file cannot hold: "
            "give it from Python with play(run, env=...)"
        )
    if env is None and name.startswith(atari.PREFIX):
        return atari.Game(name, render_mode="rgb_array", **described["kwargs"])
    if env is None and ":" not in name and name not in gymnasium.registry:
        raise ValueError(f"{name} is no environment: play shows runs in Gymnasium's environments and in compiled ones")
    make = env if env is not None else lambda **kwargs: gymnasium.make(name, disable_env_checker=True, **kwargs)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a mode that the environment does not have, which is said below
            made = make(render_mode="rgb_array", **described["kwargs"])
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise _no_picture(name, error) from error
    return made


def _no_picture(name: str, error: BaseException | None) -> ValueError:
    """Why `name` cannot be drawn, and which extra would help."""
    said = "" if error is None else " ".join(str(error).split())
    for word, extra in (("pygame", "render"), ("box2d", "box2d"), ("mujoco", "mujoco")):
        if word in said.lower():
            return ValueError(f"{name} is drawn with {word}, which is not installed: pip install 'rewardtogo[{extra}]'")
    return ValueError(f"{name} has no picture of the kind rgb_array{f' ({said})' if said else ''}: it cannot be shown")


def _frame(env: gymnasium.Env, name: str) -> np.ndarray:
    try:
        # Gymnasium warns where there is no such mode, which is said below.
        picture: Any = env.render() if env.render_mode in ("rgb_array", "rgb_array_list") else None
    except (gymnasium.error.Error, ImportError, NotImplementedError) as error:
        raise _no_picture(name, error) from error
    picture = picture[-1] if isinstance(picture, list) and picture else picture
    if not isinstance(picture, np.ndarray) or picture.ndim != 3:
        raise _no_picture(name, None)
    return picture.astype(np.uint8)


def _episode(env: gymnasium.Env, policy: LoadedPolicy, seed: int, stochastic: bool, film: "_Film") -> tuple[float, int]:
    name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    policy.reset(seed)
    observation, info = env.reset(seed=seed)
    total, length, over = 0.0, 0, False
    film.add(lambda: _frame(env, name))
    while not over:
        if length >= MAX_STEPS:
            raise endless(name)
        action = policy(_with_mask(observation, info, policy), deterministic=not stochastic)
        observation, reward, terminated, truncated, info = env.step(action)
        total, length, over = total + float(reward), length + 1, bool(terminated or truncated)
        film.add(lambda: _frame(env, name))
    return total, length


def _with_mask(observation: Any, info: dict[str, Any], policy: LoadedPolicy) -> Any:
    """The observation with the mask of allowed actions from `info`, where the policy learnt with it."""
    names = [name for name, _ in policy.spec.observation.parts]
    if MASK not in names or MASK not in info or (isinstance(observation, dict) and MASK in observation):
        return observation
    if isinstance(observation, tuple):
        observation = {str(i): part for i, part in enumerate(observation)}
    return {**(observation if isinstance(observation, dict) else {"observation": observation}), MASK: info[MASK]}


class _Film:
    """Frames on their way to a file: a GIF by Pillow, or an MP4 by imageio's ffmpeg."""

    def __init__(self, path: Path, fps: float):
        self.path, self.skip = path, max(1, round(fps / FASTEST))
        self.fps, self.seen = fps / self.skip, 0
        self.frames: list[Image.Image] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = _mp4(path, self.fps) if path.suffix.lower() == ".mp4" else None

    def add(self, draw: Callable[[], np.ndarray]) -> None:
        """Take the next frame, unless it is one too many."""
        self.seen += 1
        if (self.seen - 1) % self.skip or (self.seen - 1) // self.skip >= MOST_FRAMES:
            return
        picture = draw()
        if self._writer is not None:
            with warnings.catch_warnings():
                # JAX warns of the fork that starts ffmpeg; what is forked becomes ffmpeg at once and never uses JAX.
                warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)
                self._writer.append_data(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2])
        else:
            # As a palette picture at once: a film of full colours would fill the memory.
            self.frames.append(Image.fromarray(picture).quantize(256, Image.Quantize.FASTOCTREE))

    def __enter__(self) -> "_Film":
        return self

    def __exit__(self, failed: type[BaseException] | None, *more: object) -> None:
        """Write what was taken; nothing where the episode failed."""
        if self._writer is not None:
            self._writer.close()
            if failed is not None:
                self.path.unlink(missing_ok=True)
        elif failed is None:
            first, *others = self.frames
            duration = max(1000 // FASTEST, round(1000 / self.fps, -1))
            first.save(self.path, save_all=True, append_images=others, duration=duration, loop=0)


def _mp4(path: Path, fps: float) -> Any:
    try:
        importlib.import_module("imageio_ffmpeg")
        imageio = importlib.import_module("imageio.v2")
    except ImportError as error:
        raise ValueError(f"writing {path} needs imageio and ffmpeg: pip install 'rewardtogo[video]'") from error
    return imageio.get_writer(path, format="FFMPEG", fps=fps, macro_block_size=2)
