"""Networks: a frozen recipe (`MLP(64, 64)`) that a learner builds for a space and a key into a torso, observation in, features out.

Recipes are settings: static, hashable, printable. Torsos hold the parameters: every leaf is an array and the activation is static,
so that plain `jit`, `scan`, `vmap` and `grad` take them as they are. A torso has a memory (`()` for feed-forward ones), so that one
learner serves both kinds.
"""

import inspect
import itertools
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core import Carry, Observation, PRNGKey, Spec
from .encoding import flat_size, flatten_observation, flatten_part, has_images, input_parts, leaf

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "silu": jax.nn.silu,
    "gelu": jax.nn.gelu,
    "elu": jax.nn.elu,
}


class Linear(eqx.Module):
    """x -> W x + b, with orthogonal W (Saxe et al. 2014) of the given gain and b = 0."""

    weight: Float[Array, "out in"]
    bias: Float[Array, "out"]

    @staticmethod
    def of(inputs: int, outputs: int, key: PRNGKey, gain: float = np.sqrt(2.0)) -> "Linear":
        """A fresh layer."""
        return Linear(gain * orthogonal(key, (outputs, inputs)), jnp.zeros(outputs))

    def __call__(self, x: Float[Array, "in"]) -> Float[Array, "out"]:
        # The weight second: over a batch this is X W^T as it stands, while W x came out transposed, and over several networks side by side
        # (twin critics) took three times as long on a CPU.
        return jax.lax.dot_general(x, self.weight, (((0,), (1,)), ((), ()))) + self.bias


def orthogonal(key: PRNGKey, shape: tuple[int, int]) -> Float[Array, "out in"]:
    """A uniformly random matrix with orthonormal rows or columns, whichever are fewer.

    By Gram and Schmidt, each row cleared of the earlier ones twice, which is enough for orthogonality to rounding. Written out because
    batches of LAPACK's factorisations side by side can wait for each other for ever on a CPU of two cores, and take long to compile.
    """
    few, many = min(shape), max(shape)
    rows = jax.random.normal(key, (few, many))

    def clear(basis: Float[Array, "N M"], i: Int[Array, ""]) -> tuple[Float[Array, "N M"], None]:
        row = basis[i]
        earlier = jnp.where(jnp.arange(few)[:, None] < i, basis, 0.0)
        for _ in range(2):
            row = row - (earlier @ row) @ earlier
            row = row / jnp.linalg.norm(row)
        return basis.at[i].set(row), None

    basis, _ = jax.lax.scan(clear, rows, jnp.arange(few))
    return basis if shape == (few, many) else basis.T


class Torso(eqx.Module):
    """A built network."""

    @property
    @abstractmethod
    def features(self) -> int:
        """Length of the feature vector."""

    @abstractmethod
    def init(self) -> Carry:
        """Memory at the start of an episode."""

    @abstractmethod
    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "F"]]:
        """Memory after the observation, and features of it."""


class Network(eqx.Module):
    """A recipe for a torso."""

    @property
    @abstractmethod
    def has_memory(self) -> bool:
        """Whether the torso will have one."""

    @abstractmethod
    def build(self, spec: Spec, key: PRNGKey) -> Torso:
        """A torso with fresh parameters for observations of this kind."""


def _activation(name: str) -> str:
    if name not in ACTIVATIONS:
        raise ValueError(f"there is no activation {name!r}: choose one of {', '.join(ACTIVATIONS)}")
    return name


def _sizes(sizes: tuple[Any, ...], what: str) -> tuple[int, ...]:
    if any(isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1 for n in sizes):
        raise ValueError(f"{what} must be whole numbers of at least 1, not {sizes}")
    return tuple(int(n) for n in sizes)


class MLP(Network):
    """Dense layers: `MLP(64, 64)`, `MLP(256, 256, activation="relu")`. Pictures go through `CNN`'s layers first."""

    sizes: tuple[int, ...] = eqx.field(static=True)
    activation: str = eqx.field(static=True)

    def __init__(self, *sizes: int, activation: str = "tanh"):
        self.sizes = _sizes(sizes, "the sizes of an MLP")
        self.activation = _activation(activation)

    @property
    def has_memory(self) -> bool:
        return False

    def build(self, spec: Spec, key: PRNGKey) -> "MLPTorso | CNNTorso":
        if has_images(spec):
            return CNN(sizes=self.sizes).build(spec, key)
        widths = (flat_size(spec), *self.sizes)
        keys = jax.random.split(key, max(1, len(self.sizes)))
        layers = tuple(Linear.of(*pair, key=k) for pair, k in zip(itertools.pairwise(widths), keys))  # noqa: B905
        return MLPTorso(layers, spec, self.activation)


class MLPTorso(Torso):
    """Dense layers with one activation after each."""

    layers: tuple[Linear, ...]
    spec: Spec = eqx.field(static=True)
    activation: str = eqx.field(static=True)

    @property
    def features(self) -> int:
        return self.layers[-1].bias.shape[0] if self.layers else flat_size(self.spec)

    def init(self) -> Carry:
        return ()

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "F"]]:
        x = flatten_observation(self.spec, observation)
        for layer in self.layers:
            x = ACTIVATIONS[self.activation](layer(x))
        return carry, x


class CNN(Network):
    """Convolutions, then dense layers: by default those of Mnih et al. (2015), shrunk where a picture is too small for them.

    - `channels`, `kernels`, `strides`: one entry a convolution.
    - `sizes`: of the dense layers after them; parts of the observation that are no pictures join there.
    """

    channels: tuple[int, ...] = eqx.field(static=True)
    kernels: tuple[int, ...] = eqx.field(static=True)
    strides: tuple[int, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        channels: tuple[int, ...] = (32, 64, 64),
        kernels: tuple[int, ...] = (8, 4, 3),
        strides: tuple[int, ...] = (4, 2, 1),
        sizes: tuple[int, ...] = (512,),
    ):
        if not len(channels) == len(kernels) == len(strides):
            raise ValueError(
                f"a CNN needs as many channels as kernels and strides, not {len(channels)}, {len(kernels)} and {len(strides)}"
            )
        self.channels, self.kernels = _sizes(tuple(channels), "channels"), _sizes(tuple(kernels), "kernels")
        self.strides, self.sizes = _sizes(tuple(strides), "strides"), _sizes(tuple(sizes), "the dense sizes")

    @property
    def has_memory(self) -> bool:
        return False

    def build(self, spec: Spec, key: PRNGKey) -> "CNNTorso":
        images = [(name, part) for name, part in input_parts(spec) if part.is_image]
        others = [(name, part) for name, part in input_parts(spec) if not part.is_image]
        if not images:
            raise ValueError(
                "a CNN needs pictures, uint8 of [height, width, channels], and this environment has none: use an MLP"
            )
        keys = jax.random.split(key, len(images) + max(1, len(self.sizes)))
        stacks, width = [], sum(flat_size(part) for _, part in others)
        for (_, part), k in zip(images, keys, strict=False):
            stack, shape = self._stack(part.shape, k)
            stacks.append(stack)
            width += int(np.prod(shape))
        widths = (width, *self.sizes)
        layers = tuple(Linear.of(*pair, key=k) for pair, k in zip(itertools.pairwise(widths), keys[len(images) :]))  # noqa: B905
        return CNNTorso(tuple(stacks), layers, self.strides, tuple(images), tuple(others), width)

    def _stack(self, shape: tuple[int, ...], key: PRNGKey) -> tuple[tuple[Linear, ...], tuple[int, ...]]:
        height, width, depth = shape
        filters = []
        for k, channels, kernel, stride in zip(
            jax.random.split(key, len(self.channels)), self.channels, self.kernels, self.strides, strict=True
        ):
            kernel = min(kernel, height, width)
            filters.append(Linear.of(kernel * kernel * depth, channels, k))
            height, width, depth = (height - kernel) // stride + 1, (width - kernel) // stride + 1, channels
        return tuple(filters), (height, width, depth)


class CNNTorso(Torso):
    """One stack of convolutions a picture; their outputs and the other parts through dense layers with ReLU."""

    stacks: tuple[tuple[Linear, ...], ...]
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
        for stack, (name, _) in zip(self.stacks, self.images, strict=True):
            x = leaf(observation, name).astype(jnp.float32) / 255.0
            for layer, stride in zip(stack, self.strides, strict=True):
                x = jax.nn.relu(convolve(x, layer, stride))
            parts.append(x.ravel())
        return carry, joined(parts, self.layers)


def joined(parts: Sequence[Float[Array, "_"]], layers: tuple[Linear, ...]) -> Float[Array, "F"]:
    """Parts of an observation side by side, through dense layers with ReLU."""
    x = jnp.concatenate(parts)
    for layer in layers:
        x = jax.nn.relu(layer(x))
    return x


def convolve(x: Float[Array, "H W C"], layer: Linear, stride: int) -> Float[Array, "H2 W2 D"]:
    """A convolution without padding, as one product of matrices.

    The picture is cut into cells of `stride` by `stride` pixels, whose pixels become channels; then the kernel moves by whole cells, and
    what it sees is a few shifted copies side by side. XLA's own convolution takes eight times as long inside a loop on a CPU.
    """
    height, width, depth = x.shape
    side = round((layer.weight.shape[1] / depth) ** 0.5)
    high, wide, cells = (height - side) // stride + 1, (width - side) // stride + 1, -(-side // stride)
    rows, columns = high - 1 + cells, wide - 1 + cells
    # Where the kernel is no whole number of cells it gets zeros, and so does the picture where they look beyond its edge.
    x = x[: rows * stride, : columns * stride]
    x = jnp.pad(x, ((0, rows * stride - x.shape[0]), (0, columns * stride - x.shape[1]), (0, 0)))
    x = x.reshape(rows, stride, columns, stride, depth).transpose(0, 2, 1, 3, 4).reshape(rows, columns, -1)
    seen = jnp.concatenate([x[i : i + high, j : j + wide] for i in range(cells) for j in range(cells)], -1)
    kernel = layer.weight.reshape(-1, side, side, depth)
    more = cells * stride - side
    kernel = jnp.pad(kernel, ((0, 0), (0, more), (0, more), (0, 0)))
    kernel = kernel.reshape(-1, cells, stride, cells, stride, depth).transpose(0, 1, 3, 2, 4, 5)
    return seen @ kernel.reshape(kernel.shape[0], -1).T + layer.bias[None, None]


def _is_array(leaf: Any) -> bool:
    # NumPy's too: as a static part it could not be hashed.
    return isinstance(leaf, (jax.Array, np.ndarray))


def _required(function: Callable) -> list[str]:
    parameters = inspect.signature(function).parameters.values()
    return [
        p.name for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]


class Custom(Network):
    """Somebody's own network: a built Equinox module, or a function `(spec, key) -> module`. The module maps one observation, as
    the environment gives it, to a feature vector; `flatten_observation` helps with dictionaries and choices.

    A built module starts every seed from the same parameters; a function gives each seed its own.
    """

    module: Any
    static: Any = eqx.field(static=True)

    def __init__(self, module: Any):
        self.module, self.static = (
            eqx.partition(module, _is_array) if isinstance(module, eqx.Module) else (None, module)
        )

    @property
    def has_memory(self) -> bool:
        return False

    def build(self, spec: Spec, key: PRNGKey) -> "CustomTorso":
        built = isinstance(self.static, eqx.Module)
        if not built and len(_required(self.static)) != 2:
            raise ValueError(
                f"a function that makes a network takes (spec, key), and {self.static!r} takes ({', '.join(_required(self.static))})"
            )
        module = eqx.combine(self.module, self.static) if built else self.static(spec, key)
        if not callable(module):
            raise ValueError(
                f"a network must be a module that maps an observation to features, not {type(module).__name__}"
            )
        try:
            shape = jax.eval_shape(module, spec.zeros())
        except (TypeError, ValueError) as error:
            first = str(error).strip().splitlines()[0]
            raise ValueError(
                f"the network {type(module).__name__} does not take an observation of this environment: {first}"
            ) from error
        if not isinstance(shape, jax.ShapeDtypeStruct) or len(shape.shape) != 1:
            raise ValueError(
                f"the network {type(module).__name__} must map one observation to one feature vector, not to {shape}"
            )
        arrays, static = eqx.partition(module, _is_array)
        return CustomTorso(jax.tree.map(jnp.asarray, arrays), static, shape.shape[0])


class CustomTorso(Torso):
    """The arrays of a foreign module, the rest of it static."""

    arrays: Any
    static: Any = eqx.field(static=True)
    width: int = eqx.field(static=True)

    @property
    def features(self) -> int:
        return self.width

    def init(self) -> Carry:
        return ()

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "F"]]:
        return carry, eqx.combine(self.arrays, self.static)(observation)


def as_network(network: Any) -> Network:
    """A recipe from what a user may give: a recipe, an Equinox module, or a function `(spec, key) -> module`."""
    if isinstance(network, Network):
        return network
    if callable(network):
        return Custom(network)
    raise ValueError(
        f"a network is a recipe such as rtg.MLP(64, 64), an Equinox module or a function (spec, key) -> module, not {network!r}"
    )
