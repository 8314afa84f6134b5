"""Pictures of environments outside the compiled program: drawn while somebody acts in them, since they cannot be set back."""

import contextlib
import dataclasses
import io
import warnings
from typing import Any

import gymnasium
import numpy as np
from PIL import Image

from ..core import VectorEnv
from ..envs.atari import PREFIX
from ..envs.gymnasium import hosted
from ..envs.registry import make
from ..runner.plan import Plan
from ..runner.play import without_a_screen


class Filmed(gymnasium.Wrapper):
    """An environment that keeps, of every observation an action was taken at, the picture."""

    def __init__(self, env: gymnasium.Env):
        gymnasium.Wrapper.__init__(self, env)
        self._taken: list[bytes] = []
        self._present: bytes | None = None

    def reset(self, **options: Any) -> Any:
        """As the environment does it."""
        found = self.env.reset(**options)
        self._present = self._draw()
        return found

    def step(self, action: Any) -> Any:
        """As the environment does it, with a picture of what was before kept."""
        if self._present is not None:
            self._taken.append(self._present)
        found = self.env.step(action)
        self._present = self._draw()
        return found

    def take(self) -> list[bytes]:
        """The pictures since the last call, one a step."""
        taken, self._taken = self._taken, []
        return taken

    def _draw(self) -> bytes | None:
        return drawn(self.env)


def png(picture: np.ndarray) -> bytes:
    """An 8-bit picture as a PNG file."""
    target = io.BytesIO()
    Image.fromarray(picture).save(target, "PNG", compress_level=1)
    return target.getvalue()


class Held(gymnasium.Wrapper):
    """An environment that stays where its episode ended until it is seeded anew, so that the end can be looked at.

    A vector environment asks for the next episode at once, without a seed: it gets the end once more.
    """

    def __init__(self, env: gymnasium.Env):
        gymnasium.Wrapper.__init__(self, env)
        self._last: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """As the environment does it, where there is a seed or nothing has begun."""
        if seed is not None or self._last is None:
            self._last = self.env.reset(seed=seed, options=options)
        return self._last

    def step(self, action: Any) -> Any:
        """As the environment does it."""
        found = self.env.step(action)
        self._last = (found[0], found[4])
        return found

    def picture(self) -> bytes | None:
        """What the environment draws now, as a PNG file; None where it draws nothing."""
        return drawn(self.env)


def drawn(env: gymnasium.Env) -> bytes | None:
    """An environment's picture as a PNG file; one that cannot draw is shown in numbers: None."""
    with contextlib.suppress(Exception):
        picture: Any = env.render() if env.render_mode in ("rgb_array", "rgb_array_list") else None
        picture = picture[-1] if isinstance(picture, list) and picture else picture
        if isinstance(picture, np.ndarray) and picture.ndim == 3:
            return png(picture.astype(np.uint8))
    return None


def singles(env: VectorEnv) -> Any:
    """Where the single environments of one that Gymnasium steps lie, in its list `envs`; None for all others."""
    found = [door.host.envs for door in hosted(env)]
    return found[0] if found and isinstance(found[0], gymnasium.vector.SyncVectorEnv) else None


def drawing(described: dict[str, Any], env: VectorEnv) -> VectorEnv:
    """The same environment made anew so that it can draw, where it is one of Gymnasium's by name and has that mode; else as it was."""
    if described["backend"] != "gymnasium" or not described["by_name"] or "render_mode" in described["kwargs"]:
        return env
    if described["id"].startswith(PREFIX) or singles(env) is None:
        return env
    without_a_screen()
    arguments = {**described["kwargs"], "render_mode": "rgb_array"}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a mode that the environment does not have
            found = make(described["id"], described["num_envs"], backend="gymnasium", **arguments)
    except ValueError:
        return env
    for old in hosted(env):
        old.close()
    return found


def film(part: Plan) -> Plan:
    """The plan with Gymnasium's environment drawing while it is acted in, where it is one by name that can; else as it was."""
    if part.env is None:
        return part
    shown = drawing(part.config["env"], part.env)
    if shown is part.env:
        return part
    algorithm: Any = part.algorithm
    envs = singles(shown)
    envs.films = envs.envs = [Filmed(one) for one in envs.envs]
    return dataclasses.replace(part, env=shown, algorithm=dataclasses.replace(algorithm, env=shown))
