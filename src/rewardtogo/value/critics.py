r"""Networks for Q-learning with continuous actions: critics Q(s, a), several side by side, and actors.

They work in units of the box: 0 is its centre and -1 and 1 are its bounds, whatever these are.

A feed-forward critic reads observation and action together, so that every layer sees both. Where the recipe has a memory, the
memory is of observations, and the recipe's decoder reads what is remembered together with the action; a module of the user's own reads
the observation, and one dense layer of the same width joins its features and the action.

Source: notes 6.3.3; Lillicrap et al. 2016; Fujimoto et al. 2018 (two critics).
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core import MASK, Carry, EnvSpec, Observation, PRNGKey, Spec, Transition, require_action
from ..nn import GRU, LSTM, MLP, Custom, Linear, Network, Torso, is_recurrent, unroll
from ..nn.heads import centre, half_width
from ..ops.axes import over

SMALL = 0.01
"""Gain of last layers: the first actions are near the middle of the box, and the first values near 0."""
PAIR = "action", "observation"
"""Names of the two things that a critic reads together, in the order in which they are laid beside each other."""


# --- boxes ------------------------------------------------------------------------------------------------------------


def require_box(owner: str, spec: EnvSpec, bounded: bool = True) -> None:
    """Raise `ValueError` unless actions are a box, `bounded` in every direction, with at least one entry."""
    require_action(owner, spec, ("box",))
    action = spec.action
    if action.size == 0:
        raise ValueError(
            f"{owner} cannot choose actions without entries: the action space has the shape {action.shape}"
        )
    low, high = action.bounds()
    open_entries = np.argwhere(~(np.isfinite(low) & np.isfinite(high)))
    if bounded and len(open_entries):
        entry = tuple(int(i) for i in open_entries[0])
        raise ValueError(
            f"{owner} chooses actions between bounds, and entry {list(entry)} of this environment's actions lies in "
            f"[{low[entry]:g}, {high[entry]:g}]: put it in gymnasium.wrappers.RescaleAction or give its Box bounds, or use naf or ppo"
        )
    if np.any(low == high):
        raise ValueError(
            f"{owner} cannot scale actions whose lowest and highest value are the same: take entry "
            f"{[int(i) for i in np.argwhere(low == high)[0]]} out of the action space"
        )


def to_units(spec: Spec, action: Float[Array, "..."]) -> Float[Array, "..."]:
    """Actions of any number of leading axes in units of the box."""
    lead = (1,) * (action.ndim - len(spec.shape))
    return (action - centre(spec).reshape(lead + spec.shape)) / half_width(spec).reshape(lead + spec.shape)


def from_units(spec: Spec, units: Float[Array, "..."]) -> Float[Array, "..."]:
    """The inverse of `to_units`, clipped into the box, since the product may round to just outside."""
    lead = (1,) * (units.ndim - len(spec.shape))
    return spec.clip(centre(spec).reshape(lead + spec.shape) + half_width(spec).reshape(lead + spec.shape) * units)


# --- networks ---------------------------------------------------------------------------------------------------------


def features_along(torso: Torso, carry: Carry, t: Transition) -> tuple[Float[Array, "*N F"], Float[Array, "*N F"]]:
    """Features of every observation and every `next_observation`, of transitions `[N]` or sequences `[T, N]`; with a memory each
    sequence goes on from `carry` `[N]`, the memory before its first step, and is reset where an episode ends.
    """
    if not is_recurrent(torso):
        read = over(t.reward.ndim, lambda o: torso((), o)[1])
        return read(t.observation), read(t.next_observation)

    def one(carry: Carry, t: Transition) -> tuple[Array, Array]:
        carries, features = unroll(torso, carry, t.observation, t.done)
        return features, jax.vmap(lambda c, o: torso(c, o)[1])(carries, t.next_observation)

    return jax.vmap(one, in_axes=(0, 1), out_axes=1)(carry, t)


def _joint(action: Spec, seen: Spec) -> Spec:
    units = Spec("box", action.shape, low=(-1.0,), high=(1.0,))
    name, other = PAIR
    parts = (
        tuple((f"{other}.{k}", part) for k, part in seen.parts if k != MASK)
        if seen.kind == "dict"
        else ((other, seen),)
    )
    return Spec("dict", dtype="", parts=((name, units), *parts))


def _join(action: Array, seen: Observation) -> Observation:
    name, other = PAIR
    if isinstance(seen, dict):
        return {name: action, **{f"{other}.{k}": x for k, x in seen.items() if k != MASK}}
    return {name: action, other: seen}


class Critic(eqx.Module):
    """Q(s, a). `reader` is None where `torso` reads observation and action together; otherwise it reads the observation (with its
    memory), and `torso` its features and the action.
    """

    reader: Torso | None
    torso: Torso
    head: Linear

    @staticmethod
    def of(network: Network, spec: EnvSpec, key: PRNGKey) -> "Critic":
        """Fresh parameters."""
        reader_key, torso_key, head_key = jax.random.split(key, 3)
        if isinstance(network, (GRU, LSTM)):
            reader, last = (
                dataclasses.replace(network, decoder=MLP()).build(spec.observation, reader_key),
                network.decoder,
            )
        elif isinstance(network, Custom):
            reader = network.build(spec.observation, reader_key)
            last = MLP(reader.features, activation="relu")
        else:
            reader, last = None, network
        seen = spec.observation if reader is None else Spec("box", (reader.features,), low=(-np.inf,), high=(np.inf,))
        torso = last.build(_joint(spec.action, seen), torso_key)
        return Critic(reader, torso, Linear.of(torso.features, 1, head_key, gain=SMALL))

    def init(self) -> Carry:
        """The memory at the start of an episode."""
        return () if self.reader is None else self.reader.init()

    def see(self, carry: Carry, observation: Observation) -> tuple[Carry, Observation]:
        """The memory after an observation, and what is seen of it."""
        return (carry, observation) if self.reader is None else self.reader(carry, observation)

    def __call__(self, seen: Observation, units: Float[Array, "..."]) -> Float[Array, ""]:
        """Q of an action in units of the box, where this is seen."""
        return self.head(self.torso((), _join(units, seen))[1])[0]

    def see_along(self, carry: Carry, t: Transition) -> tuple[Observation, Observation]:
        """What is seen at every observation and every `next_observation`, `[N]` or `[T, N]`."""
        return (t.observation, t.next_observation) if self.reader is None else features_along(self.reader, carry, t)


class Critics(eqx.Module):
    """E critics as one, every array with a leading E: one product of matrices serves them all. What they see has the E too, unless
    they see plain observations.
    """

    each: Critic
    number: int = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    @staticmethod
    def of(network: Network, spec: EnvSpec, key: PRNGKey, number: int) -> "Critics":
        """Fresh parameters, others for each."""
        each = jax.vmap(lambda k: Critic.of(network, spec, k))(jax.random.split(key, number))
        return Critics(each, number, spec.action.shape)

    @property
    def _seen_axis(self) -> int | None:
        return None if self.each.reader is None else 0

    def init(self) -> Carry:
        """Their memories at the start of an episode."""
        return jax.vmap(lambda critic: critic.init())(self.each) if self.recurrent else ()

    @property
    def recurrent(self) -> bool:
        """Whether they have a memory."""
        return self.each.reader is not None and is_recurrent(self.each.reader)

    def remember(self, carry: Carry, observation: Observation) -> Carry:
        """Their memories after an observation: nothing to do without one."""
        return jax.vmap(lambda c, m: c.see(m, observation)[0])(self.each, carry) if self.recurrent else carry

    def see(self, carry: Carry, observation: Observation) -> Observation:
        """What they see of one observation."""
        look = lambda critic, carry: critic.see(carry, observation)[1]  # noqa: E731
        if self._seen_axis is None:
            return observation
        return jax.vmap(look, (0, 0 if self.recurrent else None))(self.each, carry)

    def see_along(self, carry: Carry, t: Transition) -> tuple[Observation, Observation]:
        """What they see at every observation and every `next_observation`, from the memories `[N]` before the first."""
        if self._seen_axis is None:
            return t.observation, t.next_observation
        if not self.recurrent:
            return jax.vmap(lambda critic: critic.see_along((), t))(self.each)
        return jax.vmap(lambda critic, carry: critic.see_along(carry, t), (0, 1))(self.each, carry)

    def __call__(self, seen: Observation, units: Float[Array, "..."]) -> Float[Array, "E *N"]:
        """Q of actions of any number of leading axes, by each critic."""
        axes = units.ndim - len(self.shape)
        return jax.vmap(lambda critic, seen: over(axes, critic)(seen, units), (0, self._seen_axis))(self.each, seen)

    def first(self) -> "Critics":
        """The first of them, by itself."""
        return Critics(jax.tree.map(lambda x: x[:1], self.each), 1, self.shape)


def least(q: Float[Array, "E *N"]) -> Float[Array, "*N"]:
    """The least of E values, place by place.

    By `where`: the derivative of `min` compares the values with their minimum and divides by how many are equal, which is none where the
    compiler has computed a value twice and rounded it differently.
    """
    return functools.reduce(lambda a, b: jnp.where(a < b, a, b), list(q))


class Actor(eqx.Module):
    """A torso and `number` outputs for each entry of the action."""

    torso: Torso
    head: Linear
    shape: tuple[int, ...] = eqx.field(static=True)

    @staticmethod
    def of(network: Network, spec: EnvSpec, key: PRNGKey, number: int = 1) -> "Actor":
        """Fresh parameters."""
        torso_key, head_key = jax.random.split(key)
        torso = network.build(spec.observation, torso_key)
        head = Linear.of(torso.features, number * spec.action.size, head_key, gain=SMALL)
        return Actor(torso, head, (number, *spec.action.shape))

    def init(self) -> Carry:
        """The memory at the start of an episode."""
        return self.torso.init()

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "..."]]:
        """The memory after the observation, and the outputs, `[number, *action]`."""
        carry, features = self.torso(carry, observation)
        return carry, self.read(features)

    def read(self, features: Float[Array, "F"]) -> Float[Array, "..."]:
        """The outputs for features of the torso."""
        return self.head(features).reshape(self.shape)

    def along(self, carry: Carry, t: Transition) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The outputs at every observation and every `next_observation`."""
        now, following = features_along(self.torso, carry, t)
        read = over(t.reward.ndim, self.read)
        return read(now), read(following)
