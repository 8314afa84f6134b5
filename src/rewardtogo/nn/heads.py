"""Heads: from features to a distribution over actions of any space, and to values."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from ..core import PRNGKey, Spec
from ..ops.distributions import Bernoulli, Categorical, DiagGaussian, Distribution, MultiCategorical
from .network import Linear

ACTION_KINDS = ("discrete", "multi_discrete", "multi_binary", "box")
"""The kinds of actions that `ActionHead` has a distribution for."""


class ActionHead(eqx.Module):
    """A linear layer and a distribution: categorical, multi-categorical, Bernoulli, or Gaussian with a free log std.

    A Gaussian works in units of the action: where the box is bounded, output 0 is its centre and ±1 its bounds.
    The small gain makes the first policy nearly uniform (Andrychowicz et al. 2021).
    """

    linear: Linear
    log_std: Float[Array, "..."]
    spec: Spec = eqx.field(static=True)

    @staticmethod
    def of(features: int, spec: Spec, key: PRNGKey, gain: float = 0.01, log_std: ScalarLike = 0.0) -> "ActionHead":
        """A fresh head for actions of this kind. `log_std` is that of a Gaussian in units of half the box."""
        outputs = sum(spec.counts) if spec.counts else spec.size
        scale = half_width(spec)
        spread = jnp.full(spec.shape, log_std) + jnp.log(scale) if spec.kind == "box" else jnp.zeros(0)
        return ActionHead(Linear.of(features, outputs, key, gain), spread, spec)

    def __call__(self, features: Float[Array, "F"], mask: Array | None = None) -> Distribution:
        out = self.linear(features)
        if self.spec.kind == "discrete":
            return Categorical(out) if mask is None else Categorical.masked(out, mask)
        if self.spec.kind == "multi_discrete":
            return MultiCategorical(out, self.spec.counts, self.spec.shape)
        if self.spec.kind == "multi_binary":
            return Bernoulli(out.reshape(self.spec.shape))
        mean = jnp.asarray(centre(self.spec)) + half_width(self.spec) * out.reshape(self.spec.shape)
        return DiagGaussian(mean, self.log_std)


def half_width(spec: Spec) -> np.ndarray:
    """Half the width of a bounded box; 1 where it has no bounds, and for other spaces."""
    if spec.kind != "box":
        return np.ones(spec.shape, np.float32)
    low, high = spec.bounds()
    bounded = np.isfinite(low) & np.isfinite(high)
    return np.where(bounded, (np.where(bounded, high, 1) - np.where(bounded, low, -1)) / 2, 1).astype(np.float32)


def centre(spec: Spec) -> np.ndarray:
    """The middle of a bounded box; 0 where it has no bounds."""
    low, high = spec.bounds()
    bounded = np.isfinite(low) & np.isfinite(high)
    return np.where(bounded, (np.where(bounded, high, 0) + np.where(bounded, low, 0)) / 2, 0).astype(np.float32)
