r"""A network that says where things are: convolutions, then for each channel the mean place of what it responds to.

$$p_c(i, j) \propto e^{\beta_c r_c(i, j)}, \qquad x_c = \sum_{ij} p_c(i, j)\, x_j, \quad y_c = \sum_{ij} p_c(i, j)\, y_i,$$

with places $x_j$, $y_i$ in [-1, 1] (a spatial softmax; Levine et al. 2016, Finn et al. 2016). Points move as what is seen moves: where
states are positions, they are nearly linear in them from the first step of learning on, which is what latent linear models ask for.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import Carry, Observation, PRNGKey, Spec
from .encoding import flat_size, flatten_part, has_images, input_parts, leaf
from .network import CNN, Linear, Network, Torso, convolve, joined


class FeaturePoints(Network):
    """Convolutions with ReLU between; of each channel of the last a point, and the logarithm of how strongly it responded; dense layers.

    - `channels`, `kernels`, `strides`: one entry a convolution.
    - `sizes`: of dense layers with ReLU after the points, where the other parts of an observation join; none by default.
    """

    channels: tuple[int, ...] = eqx.field(static=True)
    kernels: tuple[int, ...] = eqx.field(static=True)
    strides: tuple[int, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        channels: tuple[int, ...] = (16,),
        kernels: tuple[int, ...] = (5,),
        strides: tuple[int, ...] = (1,),
        sizes: tuple[int, ...] = (),
    ):
        # The same checks and layers as the convolutions of a CNN.
        plain = CNN(channels, kernels, strides, sizes)
        if not plain.channels:
            raise ValueError("FeaturePoints needs at least one convolution, whose channels have a point each")
        self.channels, self.kernels, self.strides, self.sizes = (
            plain.channels,
            plain.kernels,
            plain.strides,
            plain.sizes,
        )

    @property
    def has_memory(self) -> bool:
        return False

    def build(self, spec: Spec, key: PRNGKey) -> "FeaturePointsTorso":
        if not has_images(spec):
            raise ValueError(
                "FeaturePoints needs pictures, uint8 of [height, width, channels], and this environment has none: use an MLP"
            )
        plain = CNN(self.channels, self.kernels, self.strides, ()).build(spec, key)
        others = tuple((name, part) for name, part in input_parts(spec) if not part.is_image)
        width = 3 * self.channels[-1] * len(plain.images) + sum(flat_size(part) for _, part in others)
        widths = (width, *self.sizes)
        keys = jax.random.split(jax.random.fold_in(key, 1), max(1, len(self.sizes)))
        layers = tuple(Linear.of(*pair, key=k) for pair, k in zip(itertools.pairwise(widths), keys))  # noqa: B905
        sharpness = jnp.ones((len(plain.images), self.channels[-1]))
        return FeaturePointsTorso(plain.stacks, sharpness, layers, self.strides, plain.images, others, width)


def feature_points(responses: Float[Array, "H W C"], sharpness: Float[Array, "C"]) -> Float[Array, "3 C"]:
    """x, y (right and down, in [-1, 1]) and log mean e^(beta r) of each channel."""
    height, width, _ = responses.shape
    scaled = responses * sharpness[None, None]
    weight = jax.nn.softmax(scaled, (0, 1))
    x, y = jnp.linspace(-1.0, 1.0, width), jnp.linspace(-1.0, 1.0, height)
    strength = jax.nn.logsumexp(scaled, (0, 1)) - jnp.log(float(height * width))
    return jnp.stack([jnp.tensordot(x, weight.sum(0), 1), jnp.tensordot(y, weight.sum(1), 1), strength])


class FeaturePointsTorso(Torso):
    """One stack of convolutions a picture, their points, and the other parts, through dense layers with ReLU."""

    stacks: tuple[tuple[Linear, ...], ...]
    sharpness: Float[Array, "I C"]
    layers: tuple[Linear, ...]
    strides: tuple[int, ...] = eqx.field(static=True)
    images: tuple[tuple[str, Spec], ...] = eqx.field(static=True)
    others: tuple[tuple[str, Spec], ...] = eqx.field(static=True)
    width: int = eqx.field(static=True)

    @property
    def features(self) -> int:
        return self.layers[-1].bias.shape[0] if self.layers else self.width

    def init(self) -> Carry:
        return ()

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "F"]]:
        parts = [flatten_part(part, leaf(observation, name)) for name, part in self.others]
        for i, (stack, (name, _)) in enumerate(zip(self.stacks, self.images, strict=True)):
            x = leaf(observation, name).astype(jnp.float32) / 255.0
            for j, (layer, stride) in enumerate(zip(stack, self.strides, strict=True)):
                x = convolve(x if j == 0 else jax.nn.relu(x), layer, stride)
            parts.append(feature_points(x, self.sharpness[i]).ravel())
        return carry, joined(parts, self.layers)
