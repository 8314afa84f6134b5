"""Two environments of your own: one for Gymnasium, one compiled with the learner.

rtg check-env environments:Corridor-v0         (from the folder of this file)
rtg train dqn environments:Corridor-v0 --steps 20000
"""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

import rewardtogo as rtg


class Corridor(gymnasium.Env):
    """Walk from the left end to the right one. The wall on the left cannot be walked into: that action is masked there."""

    def __init__(self, length: int = 8):
        self.length = length
        self.observation_space = spaces.Box(0.0, 1.0, (1,), np.float32)
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(0, self.length // 2))
        return self._observation(), {"action_mask": self._mask()}

    def step(self, action):
        self.place = max(0, self.place + (1 if action == 1 else -1))
        arrived = self.place == self.length - 1
        return self._observation(), float(arrived), arrived, False, {"action_mask": self._mask()}

    def _observation(self):
        return np.array([self.place / (self.length - 1)], np.float32)

    def _mask(self):
        return np.array([self.place > 0, True], np.int8)


gymnasium.register("Corridor-v0", Corridor, max_episode_steps=100)


class Drift(rtg.Drawn):
    """A point on a line that drifts at random; the action is a push, the cost the squared distance from 0.

    `rtg.Environment` is the base of those that are not to be shown.
    """

    noise: float = 0.1

    @property
    def observation_space(self):
        return spaces.Box(-np.inf, np.inf, (1,), np.float32)

    @property
    def action_space(self):
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, key):
        place = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
        return place, place

    def step(self, state, action, key):
        place = state + 0.5 * action + self.noise * jax.random.normal(key, (1,))
        lost = jnp.abs(place[0]) > 3.0
        return place, rtg.Timestep(
            observation=place,
            reward=1.0 - place[0] ** 2,
            terminated=lost,
            truncated=jnp.zeros((), bool),
            final_observation=place,
            extras={},
        )

    def render(self, state, earlier=()):
        """A line from -3 to 3 and the point, for `rtg play`: plain NumPy, never compiled."""
        picture = np.full((60, 420, 3), 255, np.uint8)
        picture[29:31], picture[20:40, 209:211] = 150, 150
        column = int(np.clip(70 * (float(state[0]) + 3.0), 5, 414))
        picture[25:35, column - 5 : column + 5] = (0, 114, 178)
        return picture
