"""One Gymnasium environment as the door's vector environments hold it, in this process or in one of its own."""

from collections.abc import Callable
from typing import Any, no_type_check

import gymnasium
import gymnasium.spaces as spaces
import numpy as np
from gymnasium.envs.registration import EnvSpec

from ..core import MASK


def title(env: gymnasium.Env) -> str:
    """What messages call an environment: its id, or its class where it has none."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


@no_type_check  # a run-time type checker's wrappers could not be pickled
def single(env: Any, kwargs: dict[str, Any], keep: tuple[str, ...]) -> Callable[[], gymnasium.Env]:
    """A function that makes the environment of an id or a maker, or hands out one that exists already.

    What it makes names itself (`title`), knows its `time_limit`, says in words what is wrong with an observation's
    shape, and passes on only the entries `keep` of `info`: other entries need not be alike in all copies, and
    Gymnasium's vector environments fail where they are not.
    """
    # Only modules and plain values below, and the class inside: so the function is pickled by value, and a worker
    # process imports neither this library nor JAX, which take seconds each.
    gym, boxes, array, mask = gymnasium, spaces.Box, np.asarray, MASK
    by_id = isinstance(env, (str, EnvSpec))

    def make():
        if isinstance(env, gym.Env):
            made = env
        else:
            made = gym.make(env, **{"disable_env_checker": True, **kwargs}) if by_id else env(**kwargs)
        if not isinstance(made, gym.Env):
            raise TypeError(f"it is a {type(made).__name__}, not a gymnasium.Env")
        space = made.observation_space
        box = space if isinstance(space, boxes) else None

        class Lean(gym.Wrapper):
            def title(self):
                return self.env.spec.id if self.env.spec is not None else type(self.env.unwrapped).__name__

            def time_limit(self):
                return None if self.env.spec is None else self.env.spec.max_episode_steps

            def reset(self, *, seed=None, options=None):
                observation, info = self.env.reset(seed=seed, options=options)
                return looked_at(observation), lean(info)

            def step(self, action):
                result = self.env.step(action)
                if len(result) != 5:
                    raise ValueError(
                        f"step gave {len(result)} values instead of the five of Gymnasium: observation, reward, "
                        "terminated, truncated, info"
                    )
                observation, reward, terminated, truncated, info = result
                return looked_at(observation), reward, terminated, truncated, lean(info)

        def looked_at(observation):
            if box is not None:
                value = array(observation)
                if value.shape != box.shape or (value.dtype.kind == "f" and box.dtype.kind != "f"):
                    raise ValueError(
                        f"the observation has shape {value.shape} and type {value.dtype}, and its space says "
                        f"{box.shape} and {box.dtype}"
                    )
            return observation

        def lean(info):
            kept = {name: info[name] for name in keep if info.get(name) is not None}
            return {
                name: array(value, "int8") if name == mask else array(value, float).item()
                for name, value in kept.items()
            }

        return Lean(made)

    return make
