r"""A network that sees the last k observations joined: the simplest memory (notes 2.3.1).

$$\pi(a_t \mid o_{t-k+1}, \dots, o_t)$$

The frames are the memory, so that any learner that takes an `LSTM` takes this, and episodes reset it. The first layer grows in
proportion to k, where that of a recurrent network stays as it is. Before an episode has k observations, the first one is repeated,
as in `FrameStack`, which does the same to an environment.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core import Carry, Observation, PRNGKey, Spec
from .encoding import flat_size, flatten_observation, has_images
from .network import MLP, Network, Torso, as_network


class Stacked(Network):
    """`Stacked(4)`: the last 4 observations, through `MLP(64, 64)` where no other network is given."""

    size: int = eqx.field(static=True)
    network: Network

    def __init__(self, size: int = 4, network: Network | None = None):
        if size < 1:
            raise ValueError(
                f"a stack holds at least the newest observation, so that its size is 1 or more, not {size}"
            )
        self.size, self.network = size, as_network(MLP(64, 64) if network is None else network)
        if self.network.has_memory:
            raise ValueError(
                f"a stack of observations is a memory, and {type(self.network).__name__} is another one: give an MLP or a CNN"
            )

    @property
    def has_memory(self) -> bool:
        return True

    def build(self, spec: Spec, key: PRNGKey) -> "StackedTorso":
        joined = _joined(spec, self.size)
        return StackedTorso(self.network.build(joined, key), spec, self.size)


def _joined(spec: Spec, size: int) -> Spec:
    """What the inner network observes: a picture with more channels, or else one long vector."""
    if spec.is_image:
        low, high = spec.bounds()
        bounds = [tuple(np.concatenate([b] * size, -1).ravel().tolist()) for b in (low, high)]
        return dataclasses.replace(spec, shape=(*spec.shape[:-1], spec.shape[-1] * size), low=bounds[0], high=bounds[1])
    if has_images(spec):
        raise ValueError(
            "a stack joins one picture or parts without pictures, and this observation has both: use a GRU"
        )
    return Spec("box", (size * flat_size(spec),), low=(float("-inf"),), high=(float("inf"),))


class StackedTorso(Torso):
    """The memory is the frames, newest last, and how many of them there are."""

    inner: Torso
    spec: Spec = eqx.field(static=True)
    size: int = eqx.field(static=True)

    @property
    def features(self) -> int:
        return self.inner.features

    def init(self) -> Carry:
        frame = self.spec.zeros() if self.spec.is_image else jnp.zeros(flat_size(self.spec))
        return jnp.broadcast_to(frame, (self.size, *frame.shape)), jnp.zeros((), bool)

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "F"]]:
        frames, begun = carry
        newest = observation if self.spec.is_image else flatten_observation(self.spec, observation)
        moved = jnp.concatenate([frames[1:], newest[None]])
        frames = jnp.where(begun, moved, jnp.broadcast_to(newest, moved.shape))
        joined = jnp.concatenate(list(frames), axis=-1) if self.spec.is_image else frames.reshape(-1)
        return (frames, jnp.ones((), bool)), self.inner(self.inner.init(), joined)[1]
