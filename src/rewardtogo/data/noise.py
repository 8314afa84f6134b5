"""Noise on actions: it makes a demonstrator leave its path, so that its data shows the way back (DART, Laskey et al.
2017).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core import Action, PRNGKey, Spec

EXPERT = "expert_action"
"""Name, in `Transition.extras`, of the action that an expert chose where another one was taken."""


def perturb(spec: Spec, action: Action, noise: float | Array, key: PRNGKey, mask: Array | None = None) -> Action:
    """One action with noise, still inside its space.

    - A box gets Gaussian noise of standard deviation `noise`, in units of half its width (of 1 where it has no bounds).
    - A choice (each entry, where there are several) is replaced by a uniformly random one with probability `noise`;
      one that `mask` forbids is never taken.
    """
    if spec.kind == "box":
        low, high = spec.bounds()
        bounded = np.isfinite(low) & np.isfinite(high)
        unit = np.where(bounded, (np.where(bounded, high, 1.0) - np.where(bounded, low, -1.0)) / 2, 1.0).astype(
            np.float32
        )
        return spec.clip(action + noise * unit * jax.random.normal(key, spec.shape, jnp.float32))
    replace_key, other_key = jax.random.split(key)
    if mask is None:
        other = spec.sample(other_key)
    else:
        other = jax.random.categorical(other_key, jnp.where(mask > 0, 0.0, -jnp.inf)).astype(action.dtype)
    return jnp.where(jax.random.uniform(replace_key, spec.shape) < noise, other, action)


def check_noise(spec: Spec, noise: float) -> None:
    """Raise `ValueError` unless `noise` makes sense for actions of this kind."""
    most = np.inf if spec.kind == "box" else 1.0
    if not (0.0 <= noise <= most and np.isfinite(noise)):
        what = "a standard deviation of at least 0" if spec.kind == "box" else "a probability from 0 to 1"
        raise ValueError(f"the noise on {spec.kind.replace('_', '-')} actions is {what}, not {noise}")
