"""A network that looks at some entries of a vector and at no others.

For experts who see more than their pupil does (the truth beside a camera's picture of it), for causes that are known to matter, and to
find out what an entry is good for. The environment's `MaskObservation` hides entries from everybody; this hides them from one network.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..core import Carry, Observation, PRNGKey, Spec
from .network import MLP, Network, Torso, as_network


class Entries(Network):
    """`Entries((0, 2), MLP(64))`: a network of entries 0 and 2. Raises `ValueError`, when it is built, for entries that there are not."""

    keep: tuple[int, ...] = eqx.field(static=True)
    network: Network

    def __init__(self, keep: tuple[int, ...] = (0,), network: Network | None = None):
        self.keep = tuple(int(i) for i in keep)
        self.network = as_network(MLP(64, 64) if network is None else network)
        if not self.keep or len(set(self.keep)) < len(self.keep):
            raise ValueError(f"a network looks at distinct entries, at least one of them, not at {self.keep}")

    @property
    def has_memory(self) -> bool:
        return self.network.has_memory

    def build(self, spec: Spec, key: PRNGKey) -> "EntriesTorso":
        return EntriesTorso(self.network.build(entries_of(spec, self.keep), key), self.keep)


def entries_of(spec: Spec, keep: tuple[int, ...]) -> Spec:
    """What is left of a vector's spec. Raises `ValueError` where it is no vector of real numbers or has no such entries."""
    if spec.kind != "box" or len(spec.shape) != 1:
        what = spec.kind.replace("_", "-") if spec.kind != "box" else f"a box of shape {spec.shape}"
        raise ValueError(f"entries can be kept of a vector, and this observation is {what}")
    if not all(0 <= i < spec.shape[0] for i in keep):
        raise ValueError(f"the entries of this observation are 0 to {spec.shape[0] - 1}, not {keep}")
    low, high = (tuple(np.ravel(bound)[list(keep)].tolist()) for bound in spec.bounds())
    return Spec("box", (len(keep),), spec.dtype, low=low, high=high)


class EntriesTorso(Torso):
    """The network inside, shown its entries."""

    inner: Torso
    keep: tuple[int, ...] = eqx.field(static=True)

    @property
    def features(self) -> int:
        return self.inner.features

    def init(self) -> Carry:
        return self.inner.init()

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "F"]]:
        return self.inner(carry, observation[np.array(self.keep)])
