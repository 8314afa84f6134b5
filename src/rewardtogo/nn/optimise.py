"""Gradient descent as every learner here does it: on a gradient whose global norm is bounded, by Adam, RMSProp or plainly."""

from typing import TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..core import Number

Parameters = TypeVar("Parameters")


RULES = ("adam", "rmsprop", "sgd")
"""Names of the rules an `Optimiser` can follow."""


class Optimiser(eqx.Module):
    """Clipping by the global norm, then a rule: Adam (Kingma and Ba 2015), RMSProp (Tieleman and Hinton 2012; decay 0.99, no momentum,
    as A3C has it), or plain descent, theta - rate * gradient.

    All parameters are treated as one long vector, and so is the state: a network of a dozen small arrays is a tenth faster so. Its
    numbers may be traced: building one in each update is free.
    """

    rate: Number
    max_grad_norm: Number
    eps: float = 1e-8
    rule: str = eqx.field(static=True, default="adam")

    def init(self, parameters: Parameters) -> optax.OptState:
        """The state before the first step; it does not depend on the numbers."""
        numbers = Optimiser(0.0, 1.0, rule=self.rule)  # a schedule has no value yet
        return numbers._transformation().init(ravel_pytree(parameters)[0])

    def _transformation(self) -> optax.GradientTransformation:
        rule = {
            "adam": lambda: optax.adam(self.rate, eps=self.eps),
            "rmsprop": lambda: optax.rmsprop(self.rate, decay=0.99, eps=self.eps, eps_in_sqrt=False),
            "sgd": lambda: optax.sgd(self.rate),
        }[self.rule]()
        return optax.chain(optax.clip_by_global_norm(self.max_grad_norm), rule)

    def step(
        self, parameters: Parameters, gradient: Parameters, state: optax.OptState
    ) -> tuple[Parameters, optax.OptState]:
        """One step down the gradient."""
        flat, unravel = ravel_pytree(parameters)
        change, state = self._transformation().update(ravel_pytree(gradient)[0], state)
        return unravel(flat + cast(Array, change)), state


def global_norm(tree: Parameters) -> Float[Array, ""]:
    """Euclidean norm of all the numbers in a tree."""
    # As one vector, which `Optimiser` makes of it anyway: the compiler computes the norm once.
    return jnp.sqrt(jnp.sum(jnp.square(ravel_pytree(tree)[0])))


def towards(target: Parameters, network: Parameters, tau: Number) -> Parameters:
    """The rule phi' <- (1 - tau) phi' + tau phi: where the target network moves; at tau = 1 exactly to the network."""
    return jax.tree.map(lambda old, new: jnp.where(tau == 1.0, new, old + tau * (new - old)), target, network)
