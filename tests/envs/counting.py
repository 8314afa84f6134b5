"""Environments that count, for the tests of the door to Gymnasium. Imports no JAX: worker processes import it."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Counting(gym.Env):
    """Observes [episode, step, a random number]; episodes last 2 to 5 steps, even ones end and odd ones are cut."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = spaces.Discrete(3, start=1)

    def __init__(self, masked=False):
        self.masked, self.episode = masked, 0

    def look(self):
        return np.array([self.episode, self.step_number, self.np_random.random()])

    def info(self):
        ragged = {"junk": None if self.step_number % 2 else np.zeros(self.step_number), "who": "x" * self.step_number}
        mask = {"action_mask": np.arange(3) != self.step_number % 3} if self.masked else {}
        return {**ragged, **mask}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode = 0 if seed is not None else self.episode + 1
        self.step_number, self.length = 0, int(self.np_random.integers(2, 6))
        return self.look(), self.info()

    def step(self, action):
        assert action in (1, 2, 3)
        self.step_number += 1
        over, even = self.step_number == self.length, self.length % 2 == 0
        success = {"is_success": even, "late": None} if over else {}
        reward = float(action) + 10 * self.step_number
        return self.look(), reward, over and even, over and not even, {**self.info(), **success}


class Narrow(Counting):
    """The same in 32 bits, which no copy is made of on the way in."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,))

    def look(self):
        return super().look().astype(np.float32)


class Plain(Counting):
    """The same with an empty info, which Gymnasium's own vector environments can put together."""

    def info(self):
        return {"action_mask": np.arange(3) != self.step_number % 3} if self.masked else {}

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, {k: v for k, v in info.items() if v is not None}


class Echo(gym.Env):
    """Observes the action it was given, after checking that it is one."""

    def __init__(self, space):
        self.observation_space = self.action_space = space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        if not self.action_space.contains(action):
            raise ValueError(f"{action!r} is not in {self.action_space}")
        return action, 0.0, False, False, {}


class Faulty(gym.Env):
    """Goes wrong in step number `after + 1`, as `how` says."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Discrete(2)

    def __init__(self, how="raise", after=5):
        self.how, self.after, self.count = how, after, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        if self.how == "reset":
            raise RuntimeError("no ground")
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.count += 1
        observation, reward = np.zeros(2, np.float32), 1.0
        if self.count > self.after:
            if self.how == "raise":
                raise ValueError("oh dear, 100 % lost")
            if self.how == "four":
                return observation, reward, False, {}
            observation = {"nan": np.array([0, np.nan], np.float32), "shape": np.zeros(3, np.float32)}.get(
                self.how, observation
            )
            reward = {"reward": np.inf}.get(self.how, reward)
        return observation, reward, False, False, {}


class Frames(gym.Env):
    """Pictures as Atari's, at no cost of their own."""

    observation_space = spaces.Box(0, 255, (84, 84, 4), np.uint8)
    action_space = spaces.Discrete(2)
    picture = np.zeros((84, 84, 4), np.uint8)

    def reset(self, *, seed=None, options=None):
        return self.picture, {}

    def step(self, action):
        return self.picture, 0.0, False, False, {}
