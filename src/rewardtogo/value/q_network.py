r"""The Q network: a torso, a head with M numbers an action, and the policy that acts by their expectations.

A *dueling* head (Wang et al. 2016) has two streams, $Q(s, a) = V(s) + A(s, a) - \frac{1}{|A|} \sum_{a'} A(s, a')$, so that what a state
is worth is learned from every action. In a *noisy* head (`nn.noisy`) the weights are random while acting and learning.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from ..core import Action, Carry, EnvSpec, Observation, Policy, PRNGKey, Transition
from ..nn import Linear, Network, NoisyLinear, RunningNorm, Torso, action_mask, is_recurrent, perturbed, unroll
from ..ops.axes import over
from .outputs import Outputs

FORBIDDEN = -1e9
"""The Q value of a masked action: finite, so that nothing multiplied by 0 becomes NaN."""


class QHead(eqx.Module):
    """One or two streams of layers with ReLU between them; `value` is empty unless the head is dueling."""

    layers: tuple[Linear | NoisyLinear, ...]
    value: tuple[Linear | NoisyLinear, ...]
    actions: int = eqx.field(static=True)

    @staticmethod
    def of(
        features: int, actions: int, outputs: int, key: PRNGKey, sizes: tuple[int, ...], dueling: bool, noisy: bool
    ) -> "QHead":
        """Fresh parameters; `sizes` are the hidden layers of each stream."""
        layer = NoisyLinear.of if noisy else Linear.of
        value_key, key = jax.random.split(key) if dueling else (key, key)

        def stream(width: int, key: PRNGKey) -> tuple[Linear | NoisyLinear, ...]:
            *keys, last = jax.random.split(key, len(sizes) + 1) if sizes else [key]
            widths = (features, *sizes)
            hidden = [layer(*pair, key=k) for pair, k in zip(zip(widths[:-1], sizes, strict=True), keys, strict=True)]
            return (*hidden, layer(widths[-1], width, last, gain=1.0))

        return QHead(stream(actions * outputs, key), stream(outputs, value_key) if dueling else (), actions)

    @property
    def noisy(self) -> bool:
        """Whether its weights are random."""
        return isinstance(self.layers[0], NoisyLinear)

    def __call__(self, features: Float[Array, "F"]) -> Float[Array, "A M"]:
        advantage = _through(self.layers, features).reshape(self.actions, -1)
        if not self.value:
            return advantage
        return _through(self.value, features)[None] + advantage - advantage.mean(0, keepdims=True)


def _through(layers: tuple[Linear | NoisyLinear, ...], x: Float[Array, "F"]) -> Float[Array, "G"]:
    for layer in layers[:-1]:
        x = jax.nn.relu(layer(x))
    return layers[-1](x)


class QNetwork(eqx.Module):
    """A torso and M outputs an action."""

    torso: Torso
    head: QHead

    @staticmethod
    def of(
        network: Network,
        spec: EnvSpec,
        key: PRNGKey,
        outputs: int = 1,
        sizes: tuple[int, ...] = (),
        dueling: bool = False,
        noisy: bool = False,
    ) -> "QNetwork":
        """Fresh parameters."""
        torso_key, head_key = jax.random.split(key)
        torso = network.build(spec.observation, torso_key)
        head = QHead.of(torso.features, spec.action.counts[0], outputs, head_key, sizes, dueling, noisy)
        return QNetwork(torso, head)

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "A M"]]:
        """Memory after the observation, and the outputs of every action."""
        carry, features = self.torso(carry, observation)
        return carry, self.head(features)

    def drawn(self, key: PRNGKey) -> "QNetwork":
        """The same network with its noise drawn, itself where it has none."""
        return perturbed(self, key) if self.head.noisy else self

    def along(self, t: Transition, burn_in: int = 0) -> tuple[Float[Array, "*N A M"], Float[Array, "*N A M"]]:
        """Outputs at every observation and every `next_observation`, of transitions `[N]` or of sequences `[T, N]`; with a memory
        each sequence goes on from the memory that was stored with its first step.

        The first `burn_in` steps only bring the memory up to date with these parameters, and have no outputs: `[T - burn_in, N]`.
        """
        if not is_recurrent(self.torso):
            t = jax.tree.map(lambda x: x[burn_in:], t) if burn_in else t
            read = over(t.reward.ndim, lambda o: self((), o)[1])
            return read(t.observation), read(t.next_observation)

        def one(t: Transition) -> tuple[Array, Array]:
            carry = jax.tree.map(lambda x: x[0], t.extras["carry"])
            if burn_in:
                before = jax.tree.map(lambda x: x[:burn_in], (t.observation, t.done))
                t = jax.tree.map(lambda x: x[burn_in:], t)
                carry = jax.lax.stop_gradient(self._after(carry, *before))
            carries, features = unroll(self.torso, carry, t.observation, t.done)
            _, following = jax.vmap(lambda c, o: self(c, o))(carries, t.next_observation)
            return jax.vmap(self.head.__call__)(features), following

        return jax.vmap(one, in_axes=1, out_axes=1)(t)

    def _after(self, carry: Carry, observations: Observation, done: Bool[Array, "T"]) -> Carry:
        """The memory that the step after a sequence starts from."""
        carries, _ = unroll(self.torso, carry, observations, done)
        return jax.tree.map(lambda fresh, old: jnp.where(done[-1], fresh, old[-1]), self.torso.init(), carries)


def expected(outputs: Outputs, values: Float[Array, "*N A M"], observation: Observation) -> Float[Array, "*N A"]:
    """Q of every action; masked ones get `FORBIDDEN`."""
    return allowed_only(outputs.mean(values), observation)


def allowed_only(q: Float[Array, "*N A"], observation: Observation) -> Float[Array, "*N A"]:
    """The same numbers, `FORBIDDEN` where the observation's mask forbids the action."""
    mask = action_mask(observation)
    return q if mask is None else jnp.where(mask > 0, q, FORBIDDEN)


def greedy_probabilities(
    q: Float[Array, "*N A"], epsilon: ScalarLike, observation: Observation
) -> Float[Array, "*N A"]:
    """The epsilon-greedy policy: argmax Q, the first where there are several, or any allowed action with probability epsilon."""
    mask = action_mask(observation)
    allowed = jnp.ones_like(q) if mask is None else (mask > 0).astype(q.dtype)
    best = jax.nn.one_hot(jnp.argmax(q, -1), q.shape[-1], dtype=q.dtype)
    return best * (1.0 - epsilon) + allowed / allowed.sum(-1, keepdims=True) * epsilon


class GreedyPolicy(Policy):
    """argmax_a Q(s, a), or a uniformly random allowed action with probability `epsilon`.

    With `noise` the network's noise is drawn for every step. With `keep` the probability of the action is kept, as `log_prob`.
    """

    network: QNetwork
    outputs: Outputs
    norm: RunningNorm | None
    epsilon: Float[Array, ""]
    noise: bool = eqx.field(static=True)
    keep: bool = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return self.network.torso.init()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        noise_key, key = jax.random.split(key) if self.noise else (key, key)
        carry, q = self._q(self.network.drawn(noise_key) if self.noise else self.network, carry, observation)
        explore_key, action_key = jax.random.split(key)
        mask = action_mask(observation)
        allowed = jnp.zeros_like(q) if mask is None else jnp.where(mask > 0, 0.0, -jnp.inf)
        anything = jax.random.categorical(action_key, allowed)
        chosen = jnp.where(jax.random.uniform(explore_key) < self.epsilon, anything, jnp.argmax(q)).astype(jnp.int32)
        if not self.keep:
            return carry, chosen, {}
        return carry, chosen, {"log_prob": jnp.log(greedy_probabilities(q, self.epsilon, observation)[chosen])}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        q = self._q(self.network, carry, observation)[1]
        return {"q_values": q, "value": q.max()}

    def _q(self, network: QNetwork, carry: Carry, observation: Observation) -> tuple[Carry, Float[Array, "A"]]:
        carry, values = network(carry, observation if self.norm is None else self.norm(observation))
        return carry, expected(self.outputs, values, observation)
