"""A dataset of random walks in any spaces, with ends of both kinds."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import EnvSpec, Transition, from_space
from rewardtogo.data import Dataset

BOX = spaces.Box(-1.0, 1.0, (2,))


def walk(
    observation: spaces.Space = BOX,
    action: spaces.Space = spaces.Discrete(3),
    lengths: Sequence[int] = (3, 1, 4),
    extras: bool = False,
) -> tuple[Transition, EnvSpec]:
    """Transitions of random observations and actions; odd episodes are truncated, the others terminated."""
    spec = EnvSpec(from_space(observation), from_space(action))
    rng, size = np.random.default_rng(0), sum(lengths)
    see, act = jax.random.split(jax.random.key(0))
    seen = jax.vmap(lambda k: spec.observation.sample(k))(jax.random.split(see, size + len(lengths)))
    episode = np.repeat(np.arange(len(lengths)), lengths)
    place, last = np.arange(size) + episode, np.append(np.diff(episode) > 0, True)
    row = Transition(
        jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[place]), seen),
        jax.vmap(lambda k: spec.action.sample(k))(jax.random.split(act, size)),
        jnp.asarray(rng.normal(size=size), jnp.float32),
        jnp.asarray(last & (episode % 2 == 0)),
        jnp.asarray(last & (episode % 2 == 1)),
        jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[place + 1]), seen),
        {"log_prob": jnp.asarray(rng.normal(size=size), jnp.float32)} if extras else {},
    )
    return row, spec


@pytest.fixture
def walk_dataset() -> Callable[..., Dataset]:
    """`walk` as a dataset."""
    return lambda **options: Dataset.of(*walk(**options))


@pytest.fixture
def walk_transitions() -> Callable[..., Any]:
    """`walk` itself."""
    return walk
