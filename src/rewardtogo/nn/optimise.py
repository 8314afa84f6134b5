"""Gradient descent as every learner here does it: Adam on a gradient whose global norm is bounded."""

from typing import TypeVar, cast

import equinox as eqx
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..core import Number

Parameters = TypeVar("Parameters")


class Adam(eqx.Module):
    """Adam (Kingma and Ba 2015) after clipping by the global norm. Its numbers may be traced: building it in each update is free.

    All parameters are treated as one long vector, and so is the state: a network of a dozen small arrays is a tenth faster so.
    """

    rate: Number
    max_grad_norm: Number
    eps: float = 1e-8

    def init(self, parameters: Parameters) -> optax.OptState:
        """The state before the first step; it does not depend on the numbers."""
        return Adam(0.0, 1.0)._transformation().init(ravel_pytree(parameters)[0])

    def _transformation(self) -> optax.GradientTransformation:
        return optax.chain(optax.clip_by_global_norm(self.max_grad_norm), optax.adam(self.rate, eps=self.eps))

    def step(
        self, parameters: Parameters, gradient: Parameters, state: optax.OptState
    ) -> tuple[Parameters, optax.OptState]:
        """One step down the gradient."""
        flat, unravel = ravel_pytree(parameters)
        change, state = self._transformation().update(ravel_pytree(gradient)[0], state)
        return unravel(flat + cast(Array, change)), state


def global_norm(tree: Parameters) -> Float[Array, ""]:
    """Euclidean norm of all the numbers in a tree."""
    # As one vector, which `Adam` makes of it anyway: the compiler computes the norm once.
    return jnp.sqrt(jnp.sum(jnp.square(ravel_pytree(tree)[0])))
