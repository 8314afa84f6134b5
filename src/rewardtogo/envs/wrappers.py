"""Wrappers of pure environments that change what is seen and how an action is given; rewards and ends stay as they are.

`MaskObservation`, `NoisyObservation` and `DelayObservation` make a problem partially observed (notes, 1.1: observations
o_t ~ p(o_t | s_t) in place of states); `FrameStack` gives back what the last few observations determine.

A wrapper knows nothing of automatic resets: `vectorize` goes around it and resets it whole, so that a stack or a delay
never reaches into the episode before, and `final_observation` is what the agent would have seen.
"""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep


class Remembering(eqx.Module):
    """State of a wrapper that remembers: the wrapped environment's state, and something that was observed."""

    inner: State
    memory: PyTree[Array]


class FrameStack(Environment):
    """Shows the last `size` observations, oldest first, joined along the last axis (an image's channels): `[size * O]`.

    An episode starts with its first observation repeated.
    """

    env: Environment
    size: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if self.size < 1:
            raise ValueError(f"FrameStack.size must be at least 1, not {self.size}")
        if not _box(self, self.env.observation_space).shape:
            raise ValueError("FrameStack joins vectors or images, and this environment observes a single number")

    @property
    def observation_space(self) -> spaces.Box:
        space = _box(self, self.env.observation_space)
        low, high = (np.concatenate([bound] * self.size, axis=-1) for bound in (space.low, space.high))
        return spaces.Box(low, high, dtype=_type(space))

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        inner, observation = self.env.reset(key)
        stack = jnp.concatenate([jnp.asarray(observation)] * self.size, axis=-1)
        return Remembering(inner, stack), stack

    def step(self, state: Remembering, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        inner, timestep = self.env.step(state.inner, action, key)
        newest = jnp.asarray(timestep.final_observation)
        stack = jnp.concatenate([state.memory[..., newest.shape[-1] :], newest], axis=-1)
        return Remembering(inner, stack), _seen(timestep, stack)


class MaskObservation(Environment):
    """Shows only the entries `keep` of a vector: `MaskObservation(CartPole(), keep=(0, 2))` hides the velocities."""

    env: Environment
    keep: tuple[int, ...] = eqx.field(static=True)

    def __check_init__(self) -> None:
        shape = _box(self, self.env.observation_space).shape
        if len(shape) != 1:
            raise ValueError(
                f"MaskObservation keeps entries of a vector, and this environment's observation is {shape}"
            )
        if not self.keep or len(set(self.keep)) < len(self.keep) or not all(0 <= i < shape[0] for i in self.keep):
            raise ValueError(
                f"MaskObservation.keep must be distinct numbers from 0 to {shape[0] - 1}, at least one, not {self.keep}"
            )

    @property
    def observation_space(self) -> spaces.Box:
        space, kept = _box(self, self.env.observation_space), list(self.keep)
        return spaces.Box(space.low[kept], space.high[kept], dtype=_type(space))

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        state, observation = self.env.reset(key)
        return state, jnp.asarray(observation)[np.array(self.keep)]

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        state, timestep = self.env.step(state, action, key)
        return state, _seen(timestep, jnp.asarray(timestep.final_observation)[np.array(self.keep)])


class NoisyObservation(Environment):
    """Adds Gaussian noise of standard deviation `scale`, a number or one for each entry, to what is seen."""

    env: Environment
    scale: float | Float[Array, "..."] | Float[np.ndarray, "..."]

    def __check_init__(self) -> None:
        space = _box(self, self.env.observation_space)
        if space.dtype.kind != "f":
            raise ValueError(f"NoisyObservation adds to floating-point observations, and these are {space.dtype}")
        if np.shape(self.scale) not in ((), space.shape):
            raise ValueError(
                f"NoisyObservation.scale must be a number or have the observation's shape {space.shape}, "
                f"not {np.shape(self.scale)}"
            )
        if not isinstance(self.scale, Tracer) and not np.all(np.asarray(self.scale) >= 0):
            raise ValueError(f"NoisyObservation.scale must be at least 0, not {self.scale}")

    @property
    def observation_space(self) -> spaces.Box:
        shape = _box(self, self.env.observation_space).shape
        return spaces.Box(-np.inf, np.inf, shape, np.float32)

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        reset_key, noise_key = jax.random.split(key)
        state, observation = self.env.reset(reset_key)
        return state, self.noisy(jnp.asarray(observation), noise_key)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        step_key, noise_key = jax.random.split(key)
        state, timestep = self.env.step(state, action, step_key)
        return state, _seen(timestep, self.noisy(jnp.asarray(timestep.final_observation), noise_key))

    def noisy(self, observation: Float[Array, "..."], key: PRNGKey) -> Float[Array, "..."]:
        """One noisy look."""
        noise = jax.random.normal(key, observation.shape, observation.dtype)
        return observation + jnp.asarray(self.scale, observation.dtype) * noise


class DelayObservation(Environment):
    """Shows every observation `steps` steps late: at time t that of time max(t - steps, 0)."""

    env: Environment
    steps: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"DelayObservation.steps must be at least 1, not {self.steps}")

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        inner, first = self.env.reset(key)
        queue = jax.tree.map(lambda x: jnp.stack([x] * self.steps), first)
        return Remembering(inner, queue), first

    def step(self, state: Remembering, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        inner, timestep = self.env.step(state.inner, action, key)
        shown = jax.tree.map(lambda queue: queue[0], state.memory)
        queue = jax.tree.map(
            lambda q, new: jnp.concatenate([q[1:], new[None]]), state.memory, timestep.final_observation
        )
        return Remembering(inner, queue), _seen(timestep, shown)


class ClipAction(Environment):
    """Accepts any real action and clips it into the environment's bounds."""

    env: Environment

    def __check_init__(self) -> None:
        _box(self, self.env.action_space)

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, _box(self, self.env.action_space).shape, np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        return self.env.reset(key)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        bounds = _box(self, self.env.action_space)
        return self.env.step(state, jnp.clip(jnp.asarray(action), bounds.low, bounds.high), key)


class RescaleAction(Environment):
    """Accepts actions in [-1, 1] and stretches them onto the environment's bounds, which must be finite."""

    env: Environment

    def __check_init__(self) -> None:
        bounds = _box(self, self.env.action_space)
        if not bounds.is_bounded():
            raise ValueError(
                "RescaleAction needs finite bounds to stretch onto, and this environment's actions have none"
            )

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, _box(self, self.env.action_space).shape, np.float32)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        return self.env.reset(key)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        bounds = _box(self, self.env.action_space)
        stretched = bounds.low + (jnp.asarray(action) + 1.0) * ((bounds.high - bounds.low) / 2)
        return self.env.step(state, jnp.clip(stretched, bounds.low, bounds.high), key)


def _box(wrapper: Environment, space: spaces.Space) -> spaces.Box:
    if not isinstance(space, spaces.Box):
        name = type(wrapper).__name__
        raise ValueError(f"{name} works on Box spaces, and this environment's is {space}: leave {name} out")
    return space


def _type(space: spaces.Box) -> type:
    return np.dtype(space.dtype).type


def _seen(timestep: Timestep, observation: Observation) -> Timestep:
    """`timestep` with another observation, at both places: wrappers go inside the automatic reset."""
    return Timestep(observation, timestep.reward, timestep.terminated, timestep.truncated, observation, timestep.extras)
