"""The contracts of the library: abstract classes without fields, each implemented once by final classes.

An author of an algorithm writes a `Learner`; a loop (`OnPolicy`, `OffPolicy`, `Offline`) makes it an `Algorithm`, which the runner
trains. Every method is pure, of fixed shape, and can be compiled, scanned and mapped over.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import gymnasium.spaces as spaces
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8

from .fields import Configured
from .spec import EnvSpec, from_space
from .types import Action, Carry, Episodes, Observation, PRNGKey, State, Timestep


class Environment(eqx.Module):
    """One episode of a Markov decision process, as pure functions. A step after the end is undefined: `vectorize` resets."""

    @property
    @abstractmethod
    def observation_space(self) -> spaces.Space:
        """What `reset` and `step` observe."""

    @property
    @abstractmethod
    def action_space(self) -> spaces.Space:
        """What `step` accepts."""

    @abstractmethod
    def reset(self, key: PRNGKey) -> tuple[State, Observation]:
        """Start an episode."""

    @abstractmethod
    def step(self, state: State, action: Action, key: PRNGKey) -> tuple[State, Timestep]:
        """Take one action. Without a reset, `observation` and `final_observation` are the same."""


class Observed(Environment):
    """An environment whose observation tells its whole state, so that one can plan from what is seen."""

    @abstractmethod
    def state_of(self, observation: Observation) -> State:
        """The state that looks like this."""


class Drawn(Environment):
    """An environment with a picture, for those who watch it (`rtg play`, `rtg label`). Never part of a compiled program."""

    @abstractmethod
    def render(self, state: State, earlier: Sequence[State] = ()) -> UInt8[np.ndarray, "H W 3"] | None:
        """What a state looks like; `earlier` are those before it in the episode, of which a path can be drawn. None: it cannot be drawn."""


class Dynamics(eqx.Module):
    """A recipe of dynamics that are known: what a file can say in place of an environment."""

    @abstractmethod
    def build(self) -> Observed:
        """An environment that goes on from any observation."""


class VectorEnv(eqx.Module):
    """B environments side by side, which reset themselves: `Timestep.observation` opens the next episode where one ended."""

    @property
    @abstractmethod
    def num_envs(self) -> int:
        """B."""

    @property
    @abstractmethod
    def observation_space(self) -> spaces.Space:
        """Of one environment."""

    @property
    @abstractmethod
    def action_space(self) -> spaces.Space:
        """Of one environment."""

    @abstractmethod
    def reset(self, keys: Key[Array, "B"]) -> tuple[State, Observation]:
        """Start B episodes."""

    @abstractmethod
    def step(self, state: State, action: Action, keys: Key[Array, "B"]) -> tuple[State, Timestep]:
        """Take B actions and reset what ended."""


class Model(eqx.Module):
    """A known, identified or learned model of an environment: what planners look ahead with. One state, no batch axis."""

    @abstractmethod
    def encode(self, observation: Observation) -> State:
        """The model's state for an observation."""

    @abstractmethod
    def transition(self, state: State, action: Action, key: PRNGKey) -> State:
        """A sample of the next state."""

    @abstractmethod
    def reward(self, state: State, action: Action, next_state: State) -> Float[Array, ""]:
        """Reward of a transition."""

    @abstractmethod
    def terminal(self, state: State) -> Bool[Array, ""]:
        """Whether a state ends the episode."""


class Choices(Model):
    """A model whose actions are numbered, of one player, or of two whose gains are each other's losses.

    Rewards are the first player's. A state in which nothing is allowed counts as an end, like a terminal one.
    """

    @property
    @abstractmethod
    def num_actions(self) -> int:
        """A."""

    @abstractmethod
    def legal(self, state: State) -> Bool[Array, "A"]:
        """Which actions are allowed."""

    @abstractmethod
    def player(self, state: State) -> Int[Array, ""]:
        """Who is to move: 0 the first player, 1 the second."""

    @abstractmethod
    def observe(self, state: State) -> Observation:
        """What a state looks like to the player who is to move: what `encode` reads, and what a network looks at."""


class Game(Choices):
    """A model that knows how it starts, so that it can be played."""

    @property
    @abstractmethod
    def observation_space(self) -> spaces.Space:
        """What `observe` gives."""

    @abstractmethod
    def start(self, key: PRNGKey) -> State:
        """The state before the first move."""


class Policy(eqx.Module):
    """Chooses the action for one observation (loops `vmap` it). `carry` is its memory, `()` where it has none.

    The action may lie outside a box's bounds (a Gaussian's sample): whoever steps an environment clips it with `Spec.clip`, and a
    learner gets it as it was sampled, so that its density is right.
    """

    @abstractmethod
    def init(self, key: PRNGKey) -> Carry:
        """Memory at the start of an episode."""

    @abstractmethod
    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        """Memory after the observation, the action, and what a learner wants kept of the choice (`log_prob`)."""

    @abstractmethod
    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        """What it thinks: `value`, `q_values`, `probabilities`, `mean`, `std`, whichever it has."""


class Learner(Configured):
    """An algorithm without an environment: state, how it acts, and how it learns from a batch.

    `batch` declares what `update` wants: a `"rollout"` `[T, B]` fresh from its own policy, or `"transitions"` `[N]` or
    `"sequences"` `[T, N]` from a replay or a dataset. Loops check it when they are composed. In sequences, the memory that the
    policy had before each step is `extras["carry"]`, where it has one.
    """

    @property
    @abstractmethod
    def batch(self) -> Literal["rollout", "transitions", "sequences"]:
        """What `update` learns from."""

    @property
    @abstractmethod
    def action_kinds(self) -> tuple[str, ...]:
        """The kinds of action spaces (`Spec.kind`) it can act in."""

    @abstractmethod
    def init(self, spec: EnvSpec, key: PRNGKey) -> State:
        """Parameters, optimiser and whatever else changes; every leaf an array."""

    @abstractmethod
    def policy(self, state: State, explore: bool) -> Policy:
        """How it acts now: as it would to learn (`explore`), or as well as it can."""

    @abstractmethod
    def update(self, state: State, batch: Any, key: PRNGKey) -> tuple[State, dict[str, Array], Array | tuple[()]]:
        """Learn from a `Rollout` or a `Batch`: new state, scalar metrics, and priorities by sample, `[N]` or of each step `[T, N]`
        (or `()`).
        """


class Algorithm(eqx.Module):
    """What the runner trains: it sees nothing but this."""

    @property
    @abstractmethod
    def spec(self) -> EnvSpec:
        """The spaces that its policy acts in."""

    @property
    @abstractmethod
    def steps_per_iteration(self) -> int:
        """Environment steps (gradient steps offline) that one `step` takes."""

    @property
    @abstractmethod
    def initial_steps(self) -> int:
        """Environment steps that `init` takes (warm-up)."""

    @abstractmethod
    def with_horizon(self, iterations: int) -> "Algorithm":
        """The same algorithm, its schedules stretched over `iterations`, where they have no horizon yet."""

    @abstractmethod
    def init(self, key: PRNGKey) -> State:
        """The whole state: learner, environments, replay."""

    @abstractmethod
    def step(self, state: State, key: PRNGKey) -> tuple[State, tuple[dict[str, Array], Episodes]]:
        """One iteration."""

    @abstractmethod
    def learned(self, state: State) -> State:
        """The learner's part of the state: what must stay finite. Works on states of several seeds, with a leading axis, too."""

    @abstractmethod
    def policy(self, state: State, explore: bool = False) -> Policy:
        """The policy that the state holds."""


class Solution(eqx.Module):
    """What a solver returns: the answer, whether and why it stopped, and how it went."""

    value: State
    converged: Bool[Array | np.ndarray, "..."]
    stats: dict[str, Any]


def env_spec(env: Environment | VectorEnv) -> EnvSpec:
    """The spaces of an environment as hashable specs."""
    return EnvSpec(from_space(env.observation_space), from_space(env.action_space))


def require_action(owner: str, spec: EnvSpec, kinds: tuple[str, ...]) -> None:
    """Raise `ValueError` unless the learner `owner` can choose actions of this kind."""
    if spec.action.kind not in kinds:
        raise ValueError(
            f"{owner} chooses {' or '.join(k.replace('_', '-') for k in kinds)} actions, and this environment wants "
            f"{spec.action.kind.replace('_', '-')} ones: `rtg list` shows the algorithms that can"
        )


def float_metrics(metrics: dict[str, Array]) -> dict[str, Float[Array, ""]]:
    """Metrics as float32 scalars, whatever they were."""
    return {name: jnp.asarray(value, jnp.float32) for name, value in metrics.items()}
