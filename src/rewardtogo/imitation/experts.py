"""Experts: whoever can say what should be done (item 2.3).

An expert is a `Policy`: a trained one, a planner (`MPC`), a table that dynamic programming found, or a function made one by
`as_expert`. `Fallible` makes a worse one of it, as people are (notes 2.2).
"""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core import MASK, Action, Carry, EnvSpec, Observation, Policy, PRNGKey
from ..data.noise import check_noise, perturb


class FunctionExpert(Policy):
    """A function of the observation, or of observation and key, that JAX can trace."""

    function: Callable = eqx.field(static=True)
    spec: EnvSpec = eqx.field(static=True)
    random: bool = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        action = self.function(observation, key) if self.random else self.function(observation)
        return carry, jnp.asarray(action).astype(self.spec.action.dtype), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        del carry, observation
        return {}


class HostExpert(Policy):
    """A function of NumPy arrays, called outside the compiled program once for every observation. It must not use JAX."""

    function: Callable = eqx.field(static=True)
    spec: EnvSpec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        del key
        action = self.spec.action
        ask = lambda o: np.asarray(self.function(o), action.dtype).reshape(action.shape)  # noqa: E731
        shape = jax.ShapeDtypeStruct(action.shape, np.dtype(action.dtype))
        return carry, jax.pure_callback(ask, shape, observation, vmap_method="sequential"), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        del carry, observation
        return {}


def as_expert(source: Any, spec: EnvSpec) -> Policy:
    """An expert for these spaces from a `Policy`, or from a function `(observation)` or `(observation, key)` of one observation.

    A function that JAX cannot trace is called with NumPy arrays, outside the compiled program. Raises `ValueError` where its
    actions are none of this space.
    """
    if isinstance(source, Policy):
        expert = source
    elif not callable(source):
        raise ValueError(f"an expert is a policy or a function of an observation, not {source!r}")
    else:
        expert = _of_function(source, spec)
    require_expert(expert, spec)
    return expert


def require_expert(expert: Any, spec: EnvSpec) -> None:
    """Raise `ValueError` unless `expert` is a policy that observes and acts in these spaces."""
    if not isinstance(expert, Policy):
        raise ValueError(
            f"an expert is a policy, and {expert!r} is none: make one of a function with as_expert(function, spec)"
        )
    key, observation = jax.random.key(0), spec.observation.zeros()
    try:
        found = jax.eval_shape(lambda: expert(expert.init(key), observation, key)[1])
    except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
        raise ValueError(f"the expert cannot say what to do in this environment: {_first_line(error)}") from error
    action = spec.action
    if (
        not isinstance(found, jax.ShapeDtypeStruct)
        or found.shape != action.shape
        or found.dtype != np.dtype(action.dtype)
    ):
        raise ValueError(
            f"the expert answers with {found.shape if isinstance(found, jax.ShapeDtypeStruct) else found} and the environment "
            f"takes one action of shape {action.shape} and type {action.dtype}"
        )


def _of_function(function: Callable, spec: EnvSpec) -> Policy:
    parameters = inspect.signature(function).parameters.values()
    required = [
        p for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]
    if len(required) not in (1, 2):
        raise ValueError(
            f"an expert is a function of (observation) or (observation, key), and {function!r} takes {len(required)}"
        )
    expert = FunctionExpert(function, spec, len(required) == 2)
    observation, key = spec.observation.zeros(), jax.random.key(0)
    try:
        jax.eval_shape(lambda o, k: expert((), o, k)[1], observation, key)
    except TypeError as traced:  # what JAX raises where a value is needed that is not there yet
        try:
            answer = np.asarray(function(jax.tree.map(np.asarray, observation)))
        except Exception as error:
            raise ValueError(
                f"the expert {function!r} fails at an observation of zeros: {_first_line(error)}"
            ) from traced
        if answer.size != spec.action.size:
            raise ValueError(
                f"the expert {function!r} answers with {answer.size} numbers, and an action here has {spec.action.size}"
            ) from None
        return HostExpert(function, spec)
    return expert


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


class Fallible(Policy):
    """An expert as people are: wrong now and then, and late (item 2.9).

    - `noise`: how wrong, as in `data.perturb`: the chance that a choice is replaced by a random one, the spread in a box.
    - `delay`: an answer is that to the observation of so many steps ago (at first, to the first).
    - `votes`: asked so often for each label; the choice that is named most often counts, in a box the median of each entry.
    """

    expert: Policy
    spec: EnvSpec = eqx.field(static=True)
    noise: float = eqx.field(static=True, default=0.0)
    delay: int = eqx.field(static=True, default=0)
    votes: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        check_noise(self.spec.action, self.noise)
        if self.delay < 0 or self.votes < 1:
            raise ValueError(
                f"a delay is at least 0 steps and there is at least one vote, not {self.delay} and {self.votes}"
            )

    def init(self, key: PRNGKey) -> Carry:
        action = self.spec.action.zeros()
        late = jnp.broadcast_to(action, (self.delay, *action.shape))
        return self.expert.init(key), late, jnp.zeros((), bool)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        inner, late, begun = carry
        act_key, noise_key = jax.random.split(key)
        inner, action, extras = self.expert(inner, observation, act_key)
        line = jnp.concatenate([late, action[None]])
        line = jnp.where(begun, line, jnp.broadcast_to(action, line.shape))
        return (inner, line[1:], jnp.ones((), bool)), self._said(line[0], observation, noise_key), extras

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.expert.inspect(carry[0], observation)

    def _said(self, action: Action, observation: Observation, key: PRNGKey) -> Action:
        mask = observation.get(MASK) if isinstance(observation, dict) else None
        keys = jax.random.split(key, self.votes)
        said = jax.vmap(lambda k: perturb(self.spec.action, action, self.noise, k, mask))(keys)
        if self.spec.action.kind == "box":
            return jnp.median(said, axis=0)
        # For each vote, how many are like it: the most frequent choice, the first of equals.
        alike = (said[:, None] == said[None, :]).sum(1)
        return jnp.take_along_axis(said, alike.argmax(0)[None], axis=0)[0]
