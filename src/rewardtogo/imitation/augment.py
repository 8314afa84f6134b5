"""Demonstrations from elsewhere than where the demonstrator was: every episode again, through another view (notes 2.2, 2.5).

The classic case is a car with a camera on each side (Pomerleau 1989; Bojarski et al. 2016): what the left one sees is what the driver would
see too far to the left, and the label is to steer right. So data that never left the middle of the road shows the way back to it. Nobody is
asked and nothing is driven; that the new label is right is the author's claim.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from ..core import Action, Observation
from ..data.episodes import Dataset
from ..data.noise import EXPERT

View = Callable[[Observation, Action], tuple[Observation, Action]]
"""From one observation and the expert's action there to another observation and what it would do in it. JAX must be able to trace it."""


def augmented(dataset: Dataset, *views: View) -> Dataset:
    """The dataset, and after it the same episodes once more for each of the views.

    Rewards and ends stay what they were. Raises `ValueError` where a view leaves the spaces of the environment.
    """
    t = dataset.transitions
    label = t.extras.get(EXPERT, t.action)
    parts = [t]
    for view in views:
        look = jax.jit(jax.vmap(view))
        observation, action = look(t.observation, label)
        following, _ = look(t.next_observation, label)
        extras = {**t.extras, EXPERT: action} if EXPERT in t.extras else t.extras
        parts.append(
            dataclasses.replace(t, observation=observation, action=action, next_observation=following, extras=extras)
        )
    return Dataset.of(jax.tree.map(lambda *rows: jnp.concatenate(rows), *parts), dataset.spec)
