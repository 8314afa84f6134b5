"""Probe environments: each so small that its values are known exactly, and each breaks one particular mistake.

In the order in which to try them on a learner: a constant reward, one that depends on the observation, one that comes
later, one that depends on the action, one that depends on both, a continuous action, then the two ends of an episode,
then memory. A learner that fails one of them and passes those before has its fault where the docstring says. The
order is that of A. Jones, "Debugging reinforcement learning systems" (2021); the ends are erratum E1.5: a terminal
state is worth 0, and a cut changes no value.

Unless it is said otherwise there are two actions, which do not matter, so that Q = V.
"""

from abc import abstractmethod

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core import Action, Environment, Observation, PRNGKey, State, Timestep


class Probe(Environment):
    """An environment with known values."""

    @abstractmethod
    def observations(self) -> Float[Array, "N O"]:
        """The observations whose values are known: all that actions are chosen from, unless it is said otherwise."""

    @abstractmethod
    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        """Their optimal values, in the same order."""

    @abstractmethod
    def value(self, gamma: float) -> float:
        """The optimal expected discounted return of an episode."""


class OneStep(Probe):
    """A constant reward: one step, one observation, r = 1, so V = 1.

    Breaks: the value loss or its optimiser; and the terminal mask, without which V = 1/(1 - γ) (erratum E1.5).
    """

    @property
    def observation_space(self) -> spaces.Box:
        return _box(0.0, 0.0)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        observation = jnp.zeros(1)
        return observation, observation

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del action, key
        return state, _timestep(state, 1.0, terminated=True)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.zeros((1, 1))

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        return np.ones(1)

    def value(self, gamma: float) -> float:
        return 1.0


class ObservedReward(Probe):
    """One step that shows -1 or 1 at random and pays what it shows: V(o) = o.

    Breaks: the gradient through the network, and observations that are shuffled against their rewards.
    """

    @property
    def observation_space(self) -> spaces.Box:
        return _box(-1.0, 1.0)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        observation = jax.random.rademacher(key, (1,), float)
        return observation, observation

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del action, key
        return state, _timestep(state, state[0], terminated=True)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.asarray([[-1.0], [1.0]])

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        return np.array([-1.0, 1.0])

    def value(self, gamma: float) -> float:
        return 0.0


class DelayedReward(Probe):
    """`steps` steps that show how many were taken; only the last pays, 1: V(t) = γ^(steps - 1 - t).

    Breaks: the discount and the direction of time in returns.
    """

    steps: int = eqx.field(default=2, static=True)

    def __check_init__(self) -> None:
        _at_least("DelayedReward.steps", self.steps, 1)

    @property
    def observation_space(self) -> spaces.Box:
        return _box(0.0, float(self.steps))

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        return jnp.zeros((), jnp.int32), jnp.zeros(1)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del action, key
        taken = state + 1
        last = taken >= self.steps
        return taken, _timestep(jnp.asarray(taken, float)[None], last, terminated=last)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.arange(self.steps, dtype=float)[:, None]

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        return float(gamma) ** np.arange(self.steps - 1, -1, -1)

    def value(self, gamma: float) -> float:
        return float(gamma) ** (self.steps - 1)


class ActionReward(Probe):
    """One step, one observation: action 1 pays 1 and action 0 pays -1. V = 1, and 0 under a uniform policy.

    Breaks: the policy's gradient and its sign.
    """

    @property
    def observation_space(self) -> spaces.Box:
        return _box(0.0, 0.0)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        observation = jnp.zeros(1)
        return observation, observation

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        return state, _timestep(state, jnp.where(action == 1, 1.0, -1.0), terminated=True)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.zeros((1, 1))

    def q_values(self, gamma: float) -> Float[np.ndarray, "N A"]:
        """Values of either action."""
        return np.array([[-1.0, 1.0]])

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        return np.ones(1)

    def value(self, gamma: float) -> float:
        return 1.0


class MatchingReward(Probe):
    """One step that shows -1 or 1 at random: action 0 pays 1 where -1 was shown, action 1 where 1 was, else -1. V = 1.

    Breaks: actions, observations and rewards that are shuffled against each other; a policy that does not look.
    """

    @property
    def observation_space(self) -> spaces.Box:
        return _box(-1.0, 1.0)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        observation = jax.random.rademacher(key, (1,), float)
        return observation, observation

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        return state, _timestep(state, jnp.where(action == 1, state[0], -state[0]), terminated=True)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.asarray([[-1.0], [1.0]])

    def q_values(self, gamma: float) -> Float[np.ndarray, "N A"]:
        """Values of either action where -1 is shown, then where 1 is."""
        return np.array([[1.0, -1.0], [-1.0, 1.0]])

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        return np.ones(2)

    def value(self, gamma: float) -> float:
        return 1.0


class QuadraticReward(Probe):
    """One step with a continuous action in [-1, 1]: r = -(a - target)². V = 0 at a = target.

    Breaks: continuous policies, their squashing and their scale.
    """

    target: float = eqx.field(default=0.5, static=True)

    @property
    def observation_space(self) -> spaces.Box:
        return _box(0.0, 0.0)

    @property
    def action_space(self) -> spaces.Box:
        return _box(-1.0, 1.0)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        observation = jnp.zeros(1)
        return observation, observation

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        return state, _timestep(state, -((jnp.asarray(action)[0] - self.target) ** 2), terminated=True)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.zeros((1, 1))

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        return np.zeros(1)

    def value(self, gamma: float) -> float:
        return 0.0

    def gaussian_value(self, mean: float, std: float) -> float:
        """The value of a Gaussian policy, which no bound clips: -((mean - target)² + std²)."""
        return -((mean - self.target) ** 2 + std**2)


class TruncatedLoop(Probe):
    """One state that leads to itself and pays 1, cut after `limit` steps (E1.5): V = 1/(1 - γ), for a cut is no end.

    With `terminates` the cut is a real end. Then time is part of the state, so t / limit is shown, and V(t) = (1 -
    γ^(limit - t))/(1 - γ). Breaks: a learner that treats truncation as termination, or the other way round.
    """

    limit: int = eqx.field(default=10, static=True)
    terminates: bool = eqx.field(default=False, static=True)

    def __check_init__(self) -> None:
        _at_least("TruncatedLoop.limit", self.limit, 1)

    @property
    def observation_space(self) -> spaces.Box:
        return _box(0.0, 1.0 if self.terminates else 0.0)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        return jnp.zeros((), jnp.int32), jnp.zeros(1)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del action, key
        taken = state + 1
        over = taken >= self.limit
        shown = jnp.asarray(taken, float)[None] / self.limit if self.terminates else jnp.zeros(1)
        return taken, _timestep(shown, 1.0, terminated=over & self.terminates, truncated=over & (not self.terminates))

    def observations(self) -> Float[Array, "N O"]:
        return jnp.arange(self.limit if self.terminates else 1, dtype=float)[:, None] / self.limit

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        left = np.arange(self.limit, 0, -1) if self.terminates else np.array([np.inf])
        return (1 - float(gamma) ** left) / (1 - float(gamma))

    def value(self, gamma: float) -> float:
        return float(self.values(gamma)[0])


class TruncatedCycle(Probe):
    """Two states that lead to each other, the first pays 1 and the second 0, cut after `limit` steps, an odd number.

    V = 1/(1 - γ²) in the first and γ/(1 - γ²) in the second. The cut falls in the second state and the next episode
    starts in the first. Breaks: a learner that bootstraps a cut from the reset observation in place of the final one,
    or that does not bootstrap it.
    """

    limit: int = eqx.field(default=3, static=True)

    def __check_init__(self) -> None:
        _at_least("TruncatedCycle.limit", self.limit, 1)
        if self.limit % 2 == 0:
            raise ValueError(
                f"TruncatedCycle.limit must be odd, not {self.limit}, or the cut falls in the state that begins one"
            )

    @property
    def observation_space(self) -> spaces.Box:
        return _box(0.0, 1.0, 2)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        return jnp.zeros((), jnp.int32), jnp.asarray([1.0, 0.0])

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del action, key
        taken = state + 1
        return taken, _timestep(jax.nn.one_hot(taken % 2, 2), state % 2 == 0, truncated=taken >= self.limit)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.eye(2)

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        return np.array([1.0, float(gamma)]) / (1 - float(gamma) ** 2)

    def value(self, gamma: float) -> float:
        return 1 / (1 - float(gamma) ** 2)


class RecallState(eqx.Module):
    """What must be remembered, and the number of steps taken."""

    cue: Int[Array, ""]
    taken: Int[Array, ""]


class RecallProbe(Probe):
    """A cue is shown at the start; the action `delay` steps later, when asked, must name it and pays 1: V = γ^delay.

    One action a cue. Observation: the cue as one-hot, at the start only, and whether it is asked for now. Without
    memory the best is a guess, `memoryless_value`. Breaks: recurrence, its resets, and the gradient through time. The
    known values are those of the first observations.
    """

    delay: int = eqx.field(default=3, static=True)
    cues: int = eqx.field(default=2, static=True)

    def __check_init__(self) -> None:
        _at_least("RecallProbe.delay", self.delay, 1)
        _at_least("RecallProbe.cues", self.cues, 2)

    @property
    def observation_space(self) -> spaces.Box:
        return _box(0.0, 1.0, self.cues + 1)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(self.cues)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        cue = jax.random.randint(key, (), 0, self.cues, jnp.int32)
        return RecallState(cue, jnp.zeros((), jnp.int32)), jax.nn.one_hot(cue, self.cues + 1)

    def step(self, state: RecallState, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del key
        asked = state.taken == self.delay
        state = RecallState(state.cue, state.taken + 1)
        shown = jnp.zeros(self.cues + 1).at[-1].set(state.taken == self.delay)
        return state, _timestep(shown, asked & (action == state.cue), terminated=asked)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.eye(self.cues + 1)[:-1]

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        return np.full(self.cues, float(gamma) ** self.delay)

    def value(self, gamma: float) -> float:
        return float(gamma) ** self.delay

    def memoryless_value(self, gamma: float) -> float:
        """The best that a policy can do which sees only the present observation."""
        return float(gamma) ** self.delay / self.cues


class CountingEnv(Probe):
    """The observation is the number of steps since the reset, and so is the reward; it terminates after `length` steps.

    Breaks: everything that mixes up steps or episodes, for each number says where it comes from.
    """

    length: int = eqx.field(default=5, static=True)

    def __check_init__(self) -> None:
        _at_least("CountingEnv.length", self.length, 1)

    @property
    def observation_space(self) -> spaces.Box:
        return _box(0.0, float(self.length))

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        del key
        return jnp.zeros((), jnp.int32), jnp.zeros(1)

    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        del action, key
        taken = state + 1
        return taken, _timestep(jnp.asarray(taken, float)[None], taken, terminated=taken >= self.length)

    def observations(self) -> Float[Array, "N O"]:
        return jnp.arange(self.length, dtype=float)[:, None]

    def values(self, gamma: float) -> Float[np.ndarray, "N"]:
        found = np.zeros(self.length + 1)
        for taken in reversed(range(self.length)):
            found[taken] = taken + 1 + gamma * found[taken + 1]
        return found[:-1]

    def value(self, gamma: float) -> float:
        return float(self.values(gamma)[0])


def _box(low: float, high: float, size: int = 1) -> spaces.Box:
    return spaces.Box(low, high, (size,), np.float32)


def _at_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise ValueError(f"{name} must be at least {least}, not {value}")


def _timestep(
    observation: Float[Array, "O"],
    reward: float | Array,
    terminated: bool | Bool[Array, ""] = False,
    truncated: bool | Bool[Array, ""] = False,
) -> Timestep:
    terminated, truncated = jnp.asarray(terminated, bool), jnp.asarray(truncated, bool)
    return Timestep(observation, jnp.asarray(reward, float), terminated, truncated, observation, {})
