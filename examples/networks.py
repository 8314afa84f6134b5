"""A network of your own: any Equinox module that maps one observation to one feature vector."""

import equinox as eqx
import jax
import jax.numpy as jnp

import rewardtogo as rtg
from rewardtogo.nn import flat_size, flatten_observation


class Residual(eqx.Module):
    """A wide layer and a block around which the features flow."""

    spec: rtg.Spec = eqx.field(static=True)
    first: eqx.nn.Linear
    block: eqx.nn.Linear

    def __init__(self, spec, key, width=64):
        first_key, block_key = jax.random.split(key)
        self.spec = spec
        self.first = eqx.nn.Linear(flat_size(spec), width, key=first_key)
        self.block = eqx.nn.Linear(width, width, key=block_key)

    def __call__(self, observation):
        x = jnp.tanh(self.first(flatten_observation(self.spec, observation)))
        return x + jnp.tanh(self.block(x))
