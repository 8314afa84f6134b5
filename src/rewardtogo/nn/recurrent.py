"""Networks with a memory: GRU (Cho et al. 2014) and LSTM (Hochreiter and Schmidhuber 1997) over an encoder shared by all steps."""

from typing import Literal

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core import Carry, Observation, PRNGKey, Spec, from_space
from .network import MLP, Linear, Network, Torso, as_network

UNROLL = 4
"""Steps per iteration of the scan over a sequence."""


class GRU(Network):
    """`GRU(64)`: an encoder, a gated recurrent unit of 64 numbers, and a decoder: `MLP(64)` both, where nothing is said."""

    size: int = eqx.field(static=True)
    encoder: Network
    decoder: Network

    def __init__(self, size: int = 64, encoder: Network | None = None, decoder: Network | None = None):
        self.size = _checked(size)
        self.encoder = _feedforward(MLP(64) if encoder is None else encoder, "encoder")
        self.decoder = _feedforward(MLP(size) if decoder is None else decoder, "decoder")

    @property
    def has_memory(self) -> bool:
        return True

    def build(self, spec: Spec, key: PRNGKey) -> "RecurrentTorso":
        return _build("gru", 3, self.size, self.encoder, self.decoder, spec, key)


class LSTM(Network):
    """`LSTM(64)`: an encoder, a long short-term memory of 64 numbers (and as many cells), and a decoder, as in `GRU`."""

    size: int = eqx.field(static=True)
    encoder: Network
    decoder: Network

    def __init__(self, size: int = 64, encoder: Network | None = None, decoder: Network | None = None):
        self.size = _checked(size)
        self.encoder = _feedforward(MLP(64) if encoder is None else encoder, "encoder")
        self.decoder = _feedforward(MLP(size) if decoder is None else decoder, "decoder")

    @property
    def has_memory(self) -> bool:
        return True

    def build(self, spec: Spec, key: PRNGKey) -> "RecurrentTorso":
        return _build("lstm", 4, self.size, self.encoder, self.decoder, spec, key)


def _checked(size: int) -> int:
    if size < 1:
        raise ValueError(f"a recurrent network needs at least one unit, not {size}")
    return size


def _feedforward(network: Network, place: str) -> Network:
    network = as_network(network)
    if network.has_memory:
        raise ValueError(
            f"a {type(network).__name__} cannot be the {place} of another memory, as its own would be lost: use an MLP or a CNN"
        )
    return network


def _build(
    kind: Literal["gru", "lstm"],
    gates: int,
    size: int,
    encoder: Network,
    decoder: Network,
    spec: Spec,
    key: PRNGKey,
) -> "RecurrentTorso":
    encoder_key, input_key, memory_key, decoder_key = jax.random.split(key, 4)
    torso = encoder.build(spec, encoder_key)
    after = decoder.build(from_space(spaces.Box(-1.0, 1.0, (size,))), decoder_key)
    # Each gate is orthogonal by itself, so that no gate starts with more weight than another.
    stack = lambda key, inputs: jax.vmap(lambda k: Linear.of(inputs, size, k, 1.0).weight)(jax.random.split(key, gates))  # noqa: E731
    inputs = stack(input_key, torso.features).reshape(gates * size, -1)
    bias = jnp.zeros(gates * size)
    # A forget gate that starts open keeps early gradients alive (Gers et al. 2000).
    bias = bias.at[size : 2 * size].set(1.0) if kind == "lstm" else bias
    memory = stack(memory_key, size).reshape(gates * size, size)
    return RecurrentTorso(torso, Linear(inputs, bias), memory, after, kind)


class RecurrentTorso(Torso):
    """Encoder, one cell, decoder. The memory is `(hidden, cell)`; a GRU's cell is empty."""

    encoder: Torso
    inputs: Linear
    memory: Float[Array, "G H"]
    decoder: Torso
    kind: Literal["gru", "lstm"] = eqx.field(static=True)

    @property
    def features(self) -> int:
        return self.decoder.features

    def init(self) -> Carry:
        zeros = jnp.zeros(self.memory.shape[1])
        return (zeros, zeros) if self.kind == "lstm" else (zeros, jnp.zeros(0))

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "F"]]:
        carry, hidden = self.remember(carry, self.read(observation))
        return carry, self.write(hidden)

    def write(self, hidden: Float[Array, "H"]) -> Float[Array, "F"]:
        """Features of what is remembered."""
        return self.decoder(self.decoder.init(), hidden)[1]

    def read(self, observation: Observation) -> Float[Array, "G"]:
        """What an observation sends to the gates: the part of a step that needs no memory."""
        return self.inputs(self.encoder(self.encoder.init(), observation)[1])

    def remember(self, carry: Carry, mine: Float[Array, "G"]) -> tuple[Carry, Float[Array, "H"]]:
        """The memory after what `read` gave, and the part of it that is shown."""
        hidden, cell = carry
        past = self.memory @ hidden
        if self.kind == "lstm":
            enter, forget, leave, content = jnp.split(mine + past, 4)
            cell = jax.nn.sigmoid(forget) * cell + jax.nn.sigmoid(enter) * jnp.tanh(content)
            hidden = jax.nn.sigmoid(leave) * jnp.tanh(cell)
            return (hidden, cell), hidden
        (update, reset, content), (update_past, reset_past, content_past) = jnp.split(mine, 3), jnp.split(past, 3)
        gate = jax.nn.sigmoid(update + update_past)
        candidate = jnp.tanh(content + jax.nn.sigmoid(reset + reset_past) * content_past)
        hidden = (1.0 - gate) * candidate + gate * hidden
        return (hidden, cell), hidden


def unroll(
    torso: Torso, carry: Carry, observations: Observation, done: Bool[Array, "T"]
) -> tuple[Carry, Float[Array, "T F"]]:
    """Features of a sequence `[T, ...]`, the memory reset after every step where an episode ended.

    Returns the memory after each observation and before any reset, `[T, ...]` (where values of `next_observation` are taken from),
    and the features `[T, F]`. The same numbers as acting step by step.
    """
    if isinstance(torso, RecurrentTorso):
        # Observations are encoded, and features decoded, all at once: only what needs the memory is done step by step.
        read, inputs = torso.remember, jax.vmap(lambda o: torso.read(o))(observations)
        write = jax.vmap(lambda hidden: torso.write(hidden))
    else:
        read, inputs, write = torso.__call__, observations, lambda features: features

    def step(carry: Carry, now: tuple[Observation, Array]) -> tuple[Carry, tuple[Carry, Array]]:
        given, done = now
        after, features = read(carry, given)
        reset = jax.tree.map(lambda fresh, old: jnp.where(done, fresh, old), torso.init(), after)
        return reset, (after, features)

    _, (carries, features) = jax.lax.scan(step, carry, (inputs, done), unroll=UNROLL)
    return carries, write(features)


def piece_length(steps: int, most: int) -> int:
    """The longest equal pieces of at most `most` steps that a sequence can be cut into."""
    return next(length for length in range(min(most, steps), 0, -1) if steps % length == 0)


def pieces(x: Array, length: int) -> Array:
    """Sequences `[T, B, ...]` cut into shorter ones, `[B * T / length, length, ...]`."""
    steps, num = x.shape[:2]
    return jnp.swapaxes(x, 0, 1).reshape(num * (steps // length), length, *x.shape[2:])


def is_recurrent(torso: Torso) -> bool:
    """Whether the torso has a memory."""
    return bool(jax.tree.leaves(torso.init()))
