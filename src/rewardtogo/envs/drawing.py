"""How an environment is shown: its own drawing (`core.Drawn`), or the picture that it observes, whatever wrappers are around it."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from ..core import MASK, Action, Drawn, Environment, Observation, Observed, PRNGKey, Spec, State, Timestep, from_space
from .canvas import enlarged
from .history import DiscreteHistory, History
from .reward_wrappers import RewardFunction, RewardFunctionState, ScaleReward
from .time_limit import FiniteHorizon, TimeLimit, TimeLimitState
from .wrappers import (
    ClipAction,
    DelayObservation,
    FrameStack,
    MaskObservation,
    NoisyObservation,
    Remembering,
    RescaleAction,
)

Picture = UInt8[np.ndarray, "H W 3"]

_AROUND = (
    TimeLimit, FiniteHorizon, FrameStack, DelayObservation, MaskObservation, NoisyObservation, ClipAction, RescaleAction,
    ScaleReward, RewardFunction, History, DiscreteHistory,
)  # fmt: skip
_KEEPING = (TimeLimitState, Remembering, RewardFunctionState)
"""States of wrappers that keep something beside the state of what is inside."""


class Pictured(Drawn):
    """`env` with a drawing from outside: `drawing(state, earlier)` as in `core.Drawn.render`. A function, or a hashable object."""

    env: Environment
    drawing: Callable[..., Any] = eqx.field(static=True)

    @property
    def observation_space(self) -> spaces.Space:
        return self.env.observation_space

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        return self.env.reset(key)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        return self.env.step(state, action, key)

    def render(self, state: State, earlier: Sequence[State] = ()) -> Picture | None:
        return self.drawing(state, earlier)


def inside(env: Environment, state: State) -> tuple[Environment, State]:
    """The environment inside of the wrappers of this room, and its part of a state."""
    while isinstance(env, _AROUND):
        env, state = env.env, state.inner if isinstance(state, _KEEPING) else state
    return env, state


def picture(env: Environment, state: State, observation: Any, earlier: Sequence[State] = ()) -> Picture | None:
    """What a state, and the observation that was made of it, look like. None where there is nothing to draw."""
    bare, now = inside(env, state)
    drawn = bare.render(now, [inside(env, s)[1] for s in earlier]) if isinstance(bare, Drawn) else None
    return observed(env.observation_space, observation) if drawn is None else drawn


def picture_of(env: Environment, observation: Any) -> Picture | None:
    """What was observed, as a picture: of the state that it tells, or else itself. None where it is neither."""
    told = _told(env, jax.tree.map(jnp.asarray, observation))
    if told is not None:
        bare, state = told
        drawn = bare.render(state) if isinstance(bare, Drawn) else None
        if drawn is not None:
            return drawn
    return observed(env.observation_space, observation)


def _told(env: Environment, observation: Observation) -> tuple[Environment, State] | None:
    """The environment inside and its state, as far as an observation tells it: numbers that are hidden are shown as zeros."""
    if isinstance(env, Pictured):
        found = _told(env.env, observation)
        return None if found is None else (env, found[1])
    if isinstance(env, Observed):
        return env, env.state_of(observation)
    if isinstance(env, MaskObservation):
        whole = jnp.zeros(cast(spaces.Box, env.env.observation_space).shape).at[np.array(env.keep)].set(observation)
        return _told(env.env, whole)
    if isinstance(env, (TimeLimit, ClipAction, RescaleAction, ScaleReward, RewardFunction)):
        return _told(env.env, observation)
    return None


def observed(space: spaces.Space, observation: Any) -> Picture | None:
    """An observation that is a picture or a board, or has one among its parts, enlarged; None for any other.

    Three channels of 8 bits are colours, other stacks of pictures are shown by the last one, the newest. Numbers are grey between their
    bounds; two planes of them are the stones of either side.
    """
    spec = from_space(space)
    parts = [(spec, observation)] if spec.kind != "dict" else [(s, observation[n]) for n, s in spec.parts if n != MASK]
    for part, value in parts:
        if is_picture(part):
            return _grid(part, np.asarray(value))
    return None


def is_picture(spec: Spec) -> bool:
    """Whether what a space holds is looked at as a picture or a board, and not as numbers."""
    return spec.kind == "box" and len(spec.shape) in (2, 3) and min(spec.shape[:2]) > 1


def _grid(spec: Spec, value: np.ndarray) -> Picture:
    low, high = (b.astype(np.float64) for b in spec.bounds())
    low, high = (low, high) if spec.is_bounded else (np.minimum(value.min(), 0), np.maximum(value.max(), 1))
    grey = (255 * (value - low) / np.maximum(high - low, 1e-9)).astype(np.uint8)
    if grey.ndim == 3 and grey.shape[2] == 2 and not spec.is_image:
        grey = np.stack([grey[..., 0], grey[..., 1] // 2, grey[..., 1]], -1)
    return enlarged(grey)
