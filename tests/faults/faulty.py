"""A learner that compiles in no time, environments that go wrong in one way each, and the check that a request left nothing behind."""

from pathlib import Path
from typing import Literal

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array

from rewardtogo.core import Action, Carry, EnvSpec, Learner, Observation, Policy, PRNGKey, Rollout, number, setting

SMALL = {"num_envs": 2, "steps": 32, "quiet": True, "loop": {"unroll": 4}}
"""Four iterations of a loop on policy."""


class Leaning(Policy):
    """Two actions; the first one has the logit `bias`."""

    bias: Array
    explore: bool = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        del observation
        sampled = jax.random.bernoulli(key, jax.nn.sigmoid(-self.bias)).astype(jnp.int32)
        return carry, sampled if self.explore else (self.bias < 0).astype(jnp.int32), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        del carry, observation
        return {}


class LeaningState(eqx.Module):
    bias: Array


class Leaner(Learner):
    """Moves one number by the mean reward. `explodes` makes it infinite."""

    rate: float = number(0.1, "how far it moves", above=0)
    explodes: bool = setting(False, "whether its parameter leaves the numbers")

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete",)

    def init(self, spec: EnvSpec, key: PRNGKey) -> LeaningState:
        del spec, key
        return LeaningState(jnp.zeros(()))

    def policy(self, state: LeaningState, explore: bool) -> Leaning:
        return Leaning(state.bias, explore)

    def update(self, state: LeaningState, batch: Rollout, key: PRNGKey) -> tuple[LeaningState, dict[str, Array], tuple]:
        del key
        reward = batch.transitions.reward.mean()
        bias = state.bias + self.rate * reward + (jnp.inf if self.explodes else 0.0)
        return LeaningState(bias), {"reward": reward}, ()


class Faulty(gymnasium.Env):
    """Episodes of 5 steps, until the fault shows: at step `at` of an episode, or at its start."""

    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, fault: str = "none", at: int = 3) -> None:
        self.fault, self.at, self.count = fault, at, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        if self.fault == "raises in reset":
            raise RuntimeError("the sensor is not plugged in")
        if self.fault == "wrong shape in reset":
            return np.zeros(4, np.float32), {}
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.count += 1
        observation, reward, ended = np.zeros(3, np.float32), 1.0, self.count >= 5
        if self.fault == "never ends":
            return observation, reward, False, False, {}
        if self.count == self.at:
            if self.fault == "raises":
                raise KeyError("joint 7")
            if self.fault == "nan observation":
                observation[1] = np.nan
            if self.fault == "infinite observation":
                observation[1] = np.inf
            if self.fault == "nan reward":
                reward = np.nan
            if self.fault == "infinite reward":
                reward = np.inf
            if self.fault == "wrong shape":
                observation = np.zeros((3, 1), np.float32)
            if self.fault == "wrong type":
                observation = np.array(["a", "b", "c"])
            if self.fault == "four values":
                return observation, reward, ended, {}
            if self.fault == "nothing":
                return None
        return observation, reward, ended, False, {}


def files_under(folder: Path) -> dict[str, bytes]:
    """Every path under a folder, and what each file holds."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"a folder" for p in folder.rglob("*")}
