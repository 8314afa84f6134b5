"""Heads: from features to a distribution over actions of any space.

A recipe (`HeadRecipe`) builds a `Head` for a space of actions, as a `Network` builds a `Torso`:

    Standard          categorical, multi-categorical, Bernoulli, Gaussian: one peak in a box
    Mixture           a mixture of Gaussians                                    (`mixture.py`)
    Autoregressive    bins, each entry given those before it                    (`autoregressive.py`)
    Latent            a Gaussian given a hidden variable, a conditional VAE     (`latent.py`)
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from ..core import Action, Configured, PRNGKey, Spec
from ..ops.distributions import Bernoulli, Categorical, DiagGaussian, Distribution, MultiCategorical
from .network import Linear

ACTION_KINDS = ("discrete", "multi_discrete", "multi_binary", "box")
"""The kinds of actions that `ActionHead` has a distribution for."""


class Head(eqx.Module):
    """The last part of a policy's network, with its parameters."""

    spec: eqx.AbstractVar[Spec]

    @abstractmethod
    def __call__(self, features: Float[Array, "F"], mask: Array | None = None) -> Distribution:
        """The law of the action; `mask` says which choices are allowed, where there are choices."""

    @abstractmethod
    def loss(
        self, features: Float[Array, "F"], action: Action, key: PRNGKey, mask: Array | None = None
    ) -> Float[Array, ""]:
        """What maximum likelihood minimises for one action: -log p(action), or an upper bound of it."""

    @abstractmethod
    def with_least_std(self, least: ScalarLike) -> "Head":
        """The same head with standard deviations of `least` or more, in units of half the box."""


class HeadRecipe(Configured):
    """A recipe for a head."""

    @property
    @abstractmethod
    def action_kinds(self) -> tuple[str, ...]:
        """The kinds of actions it has a law for."""

    @abstractmethod
    def build(self, features: int, spec: Spec, key: PRNGKey) -> Head:
        """A head with fresh parameters. Raises `ValueError` for actions it has no law for."""


class Standard(HeadRecipe):
    """The usual law of each kind of space (`ActionHead`)."""

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    def build(self, features: int, spec: Spec, key: PRNGKey) -> "ActionHead":
        return ActionHead.of(features, spec, key)


class ActionHead(Head):
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
        return ActionHead(linear=Linear.of(features, outputs, key, gain), log_std=spread, spec=spec)

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

    def loss(
        self, features: Float[Array, "F"], action: Action, key: PRNGKey, mask: Array | None = None
    ) -> Float[Array, ""]:
        del key
        return -self(features, mask).log_prob(action)

    def with_least_std(self, least: ScalarLike) -> "ActionHead":
        if self.spec.kind != "box":
            return self
        return eqx.tree_at(lambda h: h.log_std, self, at_least(self.log_std, least, self.spec))


def at_least(log_std: Float[Array, "..."], least: ScalarLike, spec: Spec) -> Float[Array, "..."]:
    """Logarithms of standard deviations, raised to that of `least` times half the box where they are below."""
    return jnp.maximum(log_std, jnp.log(least * half_width(spec)))


def require_kind(recipe: HeadRecipe, spec: Spec) -> None:
    """Raise `ValueError` unless the recipe has a law for actions of this kind."""
    if spec.kind not in recipe.action_kinds:
        name = type(recipe).__name__.lower()
        raise ValueError(
            f"the head {name} is for {' or '.join(k.replace('_', '-') for k in recipe.action_kinds)} actions, and these are "
            f"{spec.kind.replace('_', '-')}: use the head standard"
        )


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
