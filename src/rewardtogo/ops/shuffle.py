"""Random orders, cheaply."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int32, Key


def permutations(key: Key[Array, ""], count: int, size: int) -> Int32[Array, "count size"]:
    """`count` random orders of `size` things, for minibatches.

    Sorts random numbers that carry their index in the low bits: one sort of plain integers, several times faster than
    `jax.random.permutation`. Orders are uniform but for ties of the random bits above the index, which keep their order:
    for a thousand things that concerns one pair in 2^22.
    """
    bits = max(1, (size - 1).bit_length())
    random = jax.random.bits(key, (count, size), jnp.uint32)
    index = jnp.arange(size, dtype=jnp.uint32)
    packed = jnp.sort((random >> bits << bits) | index[None], axis=-1)
    return (packed & jnp.uint32((1 << bits) - 1)).astype(jnp.int32)
