"""Pictures of what a policy comes to in environments outside the compiled program: drawn while it acts, since they cannot be set back."""

import contextlib
import dataclasses
import io
from typing import Any

import gymnasium
import numpy as np
from PIL import Image

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
        # An environment that cannot draw is shown in numbers.
        with contextlib.suppress(Exception):
            picture = self.env.render()
            if isinstance(picture, np.ndarray) and picture.ndim == 3:
                return png(picture)
        return None


def png(picture: np.ndarray, scale: int = 1) -> bytes:
    """An 8-bit picture as a PNG file, each point `scale` points wide."""
    image = Image.fromarray(picture)
    if scale > 1:
        image = image.resize((image.width * scale, image.height * scale), Image.Resampling.NEAREST)
    target = io.BytesIO()
    image.save(target, "PNG", compress_level=1)
    return target.getvalue()


def film(part: Plan) -> Plan:
    """The plan with Gymnasium's environment drawing while it is acted in, where it is one by name that can; else as it was."""
    described, env = part.config["env"], part.env
    if (
        not hosted(env)
        or described["backend"] != "gymnasium"
        or not described["by_name"]
        or described["id"].startswith(PREFIX)
    ):
        return part
    without_a_screen()
    arguments = {**described["kwargs"], "render_mode": "rgb_array"}
    try:
        drawn = make(described["id"], described["num_envs"], backend="gymnasium", **arguments)
    except ValueError:
        return part
    algorithm: Any = part.algorithm
    envs: Any = hosted(drawn)[0].host.envs
    envs.films = envs.envs = [Filmed(one) for one in envs.envs]
    for old in hosted(env):
        old.close()
    return dataclasses.replace(part, env=drawn, algorithm=dataclasses.replace(algorithm, env=drawn))
