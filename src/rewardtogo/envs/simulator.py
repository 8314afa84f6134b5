"""A registered environment as the dynamics that a learner knows: a name in a file, an environment where it is used."""

import equinox as eqx

from ..catalogue import nearest
from ..core import Dynamics, Environment, Observed
from .registry import COMPILED
from .time_limit import TimeLimit


class Simulator(Dynamics):
    """The compiled environment of this name, without its time limit, which is no property of the dynamics.

    `build` raises `ValueError` for an unknown name, and for an environment whose observations do not tell its state.
    """

    env: str = eqx.field(default="", static=True)

    def build(self) -> Observed:
        if self.env in COMPILED:
            return simulator_of(COMPILED[self.env](), self.env)
        known = [name for name, make in COMPILED.items() if isinstance(without_limit(make()), Observed)]
        what = (
            f"there is no compiled environment {self.env!r}" if self.env else "a simulator needs an environment's name"
        )
        raise ValueError(f"{what}, and only compiled ones can be set to a state: {nearest(self.env, known)}")


def without_limit(env: Environment) -> Environment:
    """The environment inside of a time limit, or itself."""
    return env.env if isinstance(env, TimeLimit) else env


def simulator_of(env: Environment, name: str = "") -> Observed:
    """The environment as a simulator. Raises `ValueError` where its observations do not tell its state."""
    inner = without_limit(env)
    if not isinstance(inner, Observed):
        raise ValueError(
            f"nobody can go back to what was observed in {name or type(inner).__name__}, whose observations do not tell its state: "
            "use CartPole-v1, Acrobot-v1 or MountainCar-v0, or learn from single transitions by fqi or dqn"
        )
    return inner
