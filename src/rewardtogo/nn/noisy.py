r"""Noisy layers (Fortunato et al. 2018): weights with a learned spread, so that a network explores by itself.

$$W = \mu_W + \sigma_W \odot f(\epsilon_\text{out}) f(\epsilon_\text{in})^T, \qquad b = \mu_b + \sigma_b \odot f(\epsilon_\text{out}),
\qquad f(x) = \mathrm{sign}(x) \sqrt{|x|},$$

with standard normal numbers for each input and each output ("factorised"). Noise is drawn for a whole network at once: `perturbed`
gives one with ordinary layers, whose gradient goes through to $\mu$ and $\sigma$. Without it a noisy layer is its mean.

Deviation from the paper: $\mu_W$ starts orthogonal, as every layer here, and not uniform.
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core import PRNGKey
from .network import Linear

Tree = TypeVar("Tree")


class NoisyLinear(eqx.Module):
    """A dense layer whose weights are random: their means, and their standard deviations."""

    mean: Linear
    spread: Linear

    @staticmethod
    def of(inputs: int, outputs: int, key: PRNGKey, gain: float = np.sqrt(2.0), sigma: float = 0.5) -> "NoisyLinear":
        """A fresh layer; every deviation starts at `sigma / sqrt(inputs)`."""
        start = sigma / np.sqrt(inputs)
        spread = Linear(jnp.full((outputs, inputs), start), jnp.full(outputs, start))
        return NoisyLinear(Linear.of(inputs, outputs, key, gain), spread)

    def __call__(self, x: Float[Array, "in"]) -> Float[Array, "out"]:
        return self.mean(x)

    def sample(self, key: PRNGKey) -> Linear:
        """An ordinary layer, drawn."""
        outputs, inputs = self.mean.weight.shape
        noise = jax.random.normal(key, (inputs + outputs,))
        noise = jnp.sign(noise) * jnp.sqrt(jnp.abs(noise))
        enter, leave = noise[:inputs], noise[inputs:]
        weight = self.mean.weight + self.spread.weight * leave[:, None] * enter[None, :]
        return Linear(weight, self.mean.bias + self.spread.bias * leave)


def _is_noisy(node: Any) -> bool:
    return isinstance(node, NoisyLinear)


def perturbed(tree: Tree, key: PRNGKey) -> Tree:
    """The same network with every noisy layer replaced by one that is drawn."""
    nodes, structure = jax.tree.flatten(tree, is_leaf=_is_noisy)
    noisy = [i for i, node in enumerate(nodes) if _is_noisy(node)]
    for i, k in zip(noisy, jax.random.split(key, max(1, len(noisy))), strict=False):
        nodes[i] = nodes[i].sample(k)
    return jax.tree.unflatten(structure, nodes)
