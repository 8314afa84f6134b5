"""`make`: any environment, by name or as an object, as B environments side by side."""

from collections.abc import Callable
from typing import Any, Literal, cast

import gymnasium

from ..catalogue import ENVIRONMENTS, nearest
from ..core import Environment, VectorEnv
from .acrobot import Acrobot
from .atari import PREFIX, RAW_REWARD, Atari
from .board_games import ConnectFour, TicTacToe
from .cartpole import CartPole
from .cartpole_swing_up import CartPoleSwingUp
from .catch import Catch
from .drawing import Pictured
from .envpool import EnvPool
from .gymnasium import GymnasiumEnv, Source
from .imitation_problems import Braking, Drone, Lane, LastTwo, draw_tightrope
from .mountain_car import MountainCar, MountainCarContinuous
from .obstacles import Obstacles
from .opponents import PerfectOpponent, RandomOpponent, Versus
from .pendulum import Pendulum
from .pixel_double_integrator import PixelDoubleIntegrator
from .pixel_pendulum import PixelPendulum
from .planar_navigation import PlanarNavigation
from .probes import OneStep, RecallProbe, TruncatedLoop
from .reacher import Reacher
from .reward_wrappers import NormalizeReward
from .tabular import TabularEnv
from .tabular_problems import tightrope
from .time_limit import TimeLimit
from .toy_text import TABULAR, has_twin, toy_text
from .vectorize import vectorize
from .wrappers import FrameStack, MaskObservation

Backend = Literal["auto", "jax", "gymnasium", "envpool"]
BACKENDS = ("auto", "jax", "gymnasium", "envpool")

COMPILED: dict[str, Callable[..., Environment]] = {
    "CartPole-v1": lambda: TimeLimit(CartPole(), 500),
    "CartPoleNoVel-v1": lambda: TimeLimit(MaskObservation(CartPole(), keep=(0, 2)), 500),
    "Acrobot-v1": lambda: TimeLimit(Acrobot(), 500),
    "MountainCar-v0": lambda: TimeLimit(MountainCar(), 200),
    "MountainCarContinuous-v0": lambda: TimeLimit(MountainCarContinuous(), 999),
    "Pendulum-v1": lambda: TimeLimit(Pendulum(), 200),
    "PendulumNoVel-v1": lambda: TimeLimit(MaskObservation(Pendulum(), keep=(0, 1)), 200),
    "Catch": Catch,
    "Steering": lambda: TimeLimit(Lane(picture=True), 1000),
    "Lane": lambda: TimeLimit(Lane(), 200),
    "BrakeLight": Braking,
    "LastTwo": LastTwo,
    "Drone": Drone,
    "Tightrope": lambda: Pictured(TabularEnv(tightrope()), draw_tightrope),
    "PixelPendulum": lambda: TimeLimit(FrameStack(PixelPendulum(), 2), 200),
    "PixelPendulumOneFrame": lambda: TimeLimit(PixelPendulum(), 200),
    "PixelDoubleIntegrator": lambda: TimeLimit(FrameStack(PixelDoubleIntegrator(), 2), 15),
    "PlanarNavigation": lambda: TimeLimit(PlanarNavigation(), 40),
    "CartPoleSwingUp": lambda: TimeLimit(CartPoleSwingUp(), 100),
    "Obstacles": lambda: TimeLimit(Obstacles(), 100),
    "Reacher": lambda: TimeLimit(Reacher(), 50),
    "TicTacToe": lambda: Versus(TicTacToe(), RandomOpponent()),
    "TicTacToePerfect": lambda: Versus(TicTacToe(), PerfectOpponent()),
    "ConnectFour": lambda: Versus(ConnectFour(), RandomOpponent()),
    "ConnectFour5x5": lambda: Versus(ConnectFour(5, 5), RandomOpponent()),
    "OneStep": OneStep,
    "TruncatedLoop": TruncatedLoop,
    "RecallProbe": RecallProbe,
    # The default argument holds the name: a loop's variable would be the last one in all of them.
    **{name: (lambda name=name, **kwargs: toy_text(name, **kwargs)) for name in TABULAR},
}
"""Environments that run inside the compiled program, by name; those with a Gymnasium id are twins of Gymnasium's own."""


def make(
    env: Any,
    num_envs: int | None = None,
    *,
    backend: Backend = "auto",
    normalise_reward: float | None = None,
    **kwargs: Any,
) -> VectorEnv:
    """B environments side by side.

    - `env`: a Gymnasium id (`module:Id` included), one of ours (`rtg list --envs`), a function that makes an environment, a
      `core.Environment`, or a `VectorEnv` (given back as it is).
    - `num_envs`: B, 1 if not given.
    - `backend`: `"jax"` for the compiled twin, `"gymnasium"` for Gymnasium's own, `"envpool"` for EnvPool's (extra
      `envpool`), `"auto"` for the twin where there is one, else Gymnasium's.
    - `normalise_reward`: a discount in [0, 1]; rewards are then divided by the running standard deviation of the sums that they
      make with it (`NormalizeReward`). Returns that are reported stay the environment's own.
    - `kwargs`: go to `gymnasium.make` or `envpool.make`; an environment with arguments is Gymnasium's own, but for the toy environments,
      whose twins are made from their tables.

    Raises `ValueError` for names nobody knows, with the nearest, and for backends that do not have the environment.
    """
    if normalise_reward is not None:
        if isinstance(normalise_reward, bool) or not isinstance(normalise_reward, (int, float)):
            raise ValueError(
                f"normalise_reward is a discount, a number in [0, 1] such as 0.99, not {normalise_reward!r}"
            )
        return NormalizeReward(make(env, num_envs, backend=backend, **kwargs), float(normalise_reward))
    if backend not in BACKENDS:
        raise ValueError(f"there is no backend {backend!r}: choose one of {', '.join(BACKENDS)}")
    if isinstance(env, VectorEnv):
        if num_envs not in (None, env.num_envs):
            raise ValueError(
                f"this environment already has {env.num_envs} copies: leave num_envs out, or give one that has {num_envs}"
            )
        return env
    if isinstance(env, Environment) and backend != "envpool":
        return vectorize(env, num_envs or 1)
    if isinstance(env, str):
        return _by_name(env, 1 if num_envs is None else num_envs, backend, kwargs)
    if callable(env) and not isinstance(env, gymnasium.Env):
        made = env(**kwargs)
        if isinstance(made, VectorEnv) or (isinstance(made, Environment) and backend != "envpool"):
            return make(made, num_envs)
        if isinstance(made, gymnasium.Env):
            made.close()
    if backend == "envpool":
        raise ValueError(f"EnvPool makes environments by name, and was given {env!r}: leave the backend out")
    return GymnasiumEnv(cast(Source, env), num_envs, kwargs=kwargs)


def _by_name(name: str, num_envs: int, backend: Backend, kwargs: dict[str, Any]) -> VectorEnv:
    if num_envs < 1:
        raise ValueError(f"there must be at least one environment, not {num_envs}")
    if backend == "envpool":
        return GymnasiumEnv(EnvPool(name, num_envs, kwargs))
    if name.startswith(PREFIX) and backend != "jax":
        return GymnasiumEnv(Atari(name, num_envs, kwargs), extras=(RAW_REWARD,))
    if name in COMPILED and backend != "gymnasium" and (not kwargs or has_twin(name, kwargs)):
        return vectorize(COMPILED[name](**kwargs), num_envs)
    if name in COMPILED and kwargs and (backend == "jax" or name not in gymnasium.registry):
        raise ValueError(
            f"the compiled {name} takes no arguments, and was given {', '.join(kwargs)}: use --backend gymnasium or leave them out"
        )
    if backend == "jax":
        raise ValueError(
            f"{name} has no compiled twin: use --backend gymnasium, or one of {', '.join(sorted(COMPILED))}"
        )
    if name not in gymnasium.registry and ":" not in name:
        if name in COMPILED:
            raise ValueError(f"{name} is not one of Gymnasium's environments: use --backend jax")
        raise ValueError(f"there is no environment {name!r}: {nearest(name, [*gymnasium.registry, *ENVIRONMENTS])}")
    return GymnasiumEnv(name, num_envs, kwargs=kwargs)
