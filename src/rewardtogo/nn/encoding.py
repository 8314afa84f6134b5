"""From an observation of any space to the numbers a network takes."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import MASK, Observation, Spec


def input_parts(spec: Spec) -> tuple[tuple[str, Spec], ...]:
    """The leaves of an observation that a network looks at: all but the action mask. A plain space is one leaf without a name."""
    return tuple((name, part) for name, part in spec.parts if name != MASK) if spec.kind == "dict" else (("", spec),)


def has_images(spec: Spec) -> bool:
    """Whether any part is a picture."""
    return any(part.is_image for _, part in input_parts(spec))


def action_mask(observation: Observation) -> Array | None:
    """The mask that the observation carries, or None."""
    return observation.get(MASK) if isinstance(observation, dict) else None


def leaf(observation: Observation, name: str) -> Array:
    """One named part of an observation (`""`: all of it)."""
    return observation[name] if name else observation


def flat_size(spec: Spec) -> int:
    """Length of `flatten_observation`'s result."""
    sizes = {"discrete": lambda s: s.counts[0], "multi_discrete": lambda s: sum(s.counts)}
    parts = input_parts(spec)
    if not parts:
        raise ValueError(
            "the observation is an action mask and nothing else: give it at least one part that can be learnt from"
        )
    return sum(sizes.get(part.kind, lambda s: s.size)(part) for _, part in parts)


def flatten_part(spec: Spec, value: Array) -> Float[Array, "F"]:
    """One leaf as a vector: choices one-hot, 8-bit numbers divided by 255, the rest as it is."""
    if spec.kind == "discrete":
        return jax.nn.one_hot(value, spec.counts[0], dtype=jnp.float32)
    if spec.kind == "multi_discrete":
        digits = jnp.ravel(value)
        return jnp.concatenate([jax.nn.one_hot(digits[i], n, dtype=jnp.float32) for i, n in enumerate(spec.counts)])
    scale = 255.0 if spec.dtype == "uint8" else 1.0
    return jnp.ravel(value).astype(jnp.float32) / scale


def flatten_observation(spec: Spec, observation: Observation) -> Float[Array, "F"]:
    """The whole observation as one vector, its parts in the order of their names."""
    parts = [flatten_part(part, leaf(observation, name)) for name, part in input_parts(spec)]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


class RunningNorm(eqx.Module):
    """Mean and variance of every real-valued part of the observations seen so far (Welford; Chan et al. 1979 for batches).

    Part of a learner's state, and so of every checkpoint and every exported policy. Calling it standardises one observation
    and clips to ±`limit` standard deviations. Parts that are not float boxes pass through.
    """

    mean: dict[str, Array]
    square: dict[str, Array]
    count: Float[Array, ""]
    limit: float = eqx.field(static=True, default=10.0)

    @staticmethod
    def of(spec: Spec) -> "RunningNorm":
        """Statistics of nothing yet: standardises with mean 0 and variance 1."""
        real = {
            name: jnp.zeros(part.shape)
            for name, part in input_parts(spec)
            if part.kind == "box" and part.dtype == "float32"
        }
        return RunningNorm(real, jax.tree.map(jnp.zeros_like, real), jnp.zeros(()))

    def update(self, observations: Observation) -> "RunningNorm":
        """Statistics with a batch of observations, any number of leading axes, added."""
        mean, square = {}, {}
        total = self.count
        for name, old in self.mean.items():
            batch = leaf(observations, name).reshape(-1, *old.shape)
            new, total, centre = batch.shape[0], self.count + batch.shape[0], batch.mean(0)
            gap = centre - old
            mean[name] = old + gap * (new / total)
            within = ((batch - centre[None]) ** 2).sum(0)
            square[name] = self.square[name] + within + gap**2 * (self.count * new / total)
        return RunningNorm(mean, square, total, self.limit)

    def sd(self, name: str = "") -> Array:
        """Standard deviation of a part (1 before anything was seen), a little more than 0."""
        variance = jnp.where(self.count > 1, self.square[name] / jnp.maximum(self.count, 1.0), 1.0)
        return jnp.sqrt(variance + 1e-8)

    def __call__(self, observation: Observation) -> Observation:
        def scaled(name: str) -> Array:
            z = (leaf(observation, name) - self.mean[name]) / self.sd(name)
            return jnp.clip(z, -self.limit, self.limit)

        if not isinstance(observation, dict):
            return scaled("") if "" in self.mean else observation
        return {name: scaled(name) if name in self.mean else value for name, value in observation.items()}
