"""Shows the last observations and actions in place of the newest observation: memory for policies that have none.

    x_t = (o_{t-k+1}, a_{t-k+1}, ..., o_{t-1}, a_{t-1}, o_t)

Any process becomes Markov if its state is its whole history (notes, 3.5): with `window` at least the number of steps of
an episode this is the whole of it, and a shorter window is all that is needed where the process has no longer memory.
Actions are part of it: what is seen next depends on them, and a policy that samples does not remember its own.

Source: notes, section 3.5; item 3.14.
"""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep
from .wrappers import Remembering


def _require_window(name: str, window: int) -> None:
    if window < 1:
        raise ValueError(f"{name}.window must be at least 1, not {window}: it counts observations, the newest included")


def _seen(timestep: Timestep, observation: Observation) -> Timestep:
    """`timestep` with another observation, at both places: wrappers go inside the automatic reset."""
    return Timestep(observation, timestep.reward, timestep.terminated, timestep.truncated, observation, timestep.extras)


class DiscreteHistory(Environment):
    """The window as one number, for tables: of `Discrete` observations, 0..Z-1, and `Discrete` actions, 0..A-1.

    The number is written with o_t as its last digit, in base Z, and before it a digit in base 1 + A Z for each earlier step,
    the latest last: 0 where the episode had not begun, else 1 + a Z + o. There are Z (1 + A Z)^(window - 1) numbers.
    """

    env: Environment
    window: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        _require_window("DiscreteHistory", self.window)
        for space in (self.env.observation_space, self.env.action_space):
            if not isinstance(space, spaces.Discrete) or space.start != 0:
                raise ValueError(
                    f"DiscreteHistory counts observations and actions from 0, and here one of the spaces is {space}: use History"
                )
        if self._size > np.iinfo(np.int32).max:
            raise ValueError(
                f"a window of {self.window} has {self._size} histories, more than an int32 counts: "
                "use a shorter window, or History"
            )

    @property
    def _counts(self) -> tuple[int, int]:
        return int(self.env.observation_space.n), int(self.env.action_space.n)  # type: ignore[attr-defined]

    @property
    def _size(self) -> int:
        observations, actions = self._counts
        return observations * (1 + actions * observations) ** (self.window - 1)

    @property
    def observation_space(self) -> spaces.Discrete:
        return spaces.Discrete(self._size)

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        inner, observation = self.env.reset(key)
        code = jnp.asarray(observation, jnp.int32)
        return Remembering(inner, code), code

    def step(self, state: Remembering, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        inner, timestep = self.env.step(state.inner, action, key)
        observations, actions = self._counts
        earlier, last = state.memory // observations, state.memory % observations
        digit = 1 + jnp.asarray(action, jnp.int32) * observations + last
        # Cut before the digit is added, so that no number on the way exceeds the greatest code.
        kept = earlier % (1 + actions * observations) ** max(self.window - 2, 0)
        before = kept * (1 + actions * observations) + digit if self.window > 1 else jnp.zeros((), jnp.int32)
        code = before * observations + jnp.asarray(timestep.final_observation, jnp.int32)
        return Remembering(inner, code), _seen(timestep, code)


class History(Environment):
    """The window as one vector, for networks, the oldest step first.

    Each earlier step is (1, o, a), all zeros where the episode had not begun; then comes o_t. Observations and actions may be
    `Box`, which are flattened, or `Discrete`, which become one-hot vectors.
    """

    env: Environment
    window: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        _require_window("History", self.window)
        for space in (self.env.observation_space, self.env.action_space):
            if not isinstance(space, (spaces.Box, spaces.Discrete)):
                raise ValueError(
                    f"History joins Box and Discrete spaces, and here one is {space}: flatten it with another wrapper first"
                )

    @property
    def observation_space(self) -> spaces.Box:
        (low, high), (action_low, action_high) = (
            _bounds(s) for s in (self.env.observation_space, self.env.action_space)
        )
        # Zeros stand for steps before the first, so they must be inside.
        lows = np.concatenate([np.minimum(np.concatenate([[0.0], low, action_low]), 0)] * (self.window - 1) + [low])
        highs = np.concatenate([np.maximum(np.concatenate([[1.0], high, action_high]), 0)] * (self.window - 1) + [high])
        return spaces.Box(lows.astype(np.float32), highs.astype(np.float32), dtype=np.float32)

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        inner, observation = self.env.reset(key)
        newest = _vector(self.env.observation_space, observation)
        before = jnp.zeros(self.observation_space.shape[0] - newest.size, jnp.float32)
        code = jnp.concatenate([before, newest])
        return Remembering(inner, code), code

    def step(self, state: Remembering, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        inner, timestep = self.env.step(state.inner, action, key)
        newest = _vector(self.env.observation_space, timestep.final_observation)
        past, last = state.memory[: -newest.size], state.memory[-newest.size :]
        done = jnp.concatenate([jnp.ones(1, jnp.float32), last, _vector(self.env.action_space, action)])
        before = jnp.concatenate([past, done])[done.size :]
        code = jnp.concatenate([before, newest])
        return Remembering(inner, code), _seen(timestep, code)


def _bounds(space: spaces.Space) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(space, spaces.Discrete):
        return np.zeros(int(space.n)), np.ones(int(space.n))
    return space.low.ravel(), space.high.ravel()  # type: ignore[attr-defined]


def _vector(space: spaces.Space, value: Observation) -> Array:
    if isinstance(space, spaces.Discrete):
        return jax.nn.one_hot(jnp.asarray(value) - int(space.start), int(space.n), dtype=jnp.float32)
    return jnp.ravel(jnp.asarray(value, jnp.float32))
