r"""Autoregressive discretisation (notes 2.3.2): each entry of an action in bins, given the entries before it.

$$p(a \mid s) = \prod_k p(a_k \mid a_{<k}, s)$$

A softmax over bins has as many peaks as there are bins, and conditioning on the entries before makes any law of several entries
possible, with D softmaxes in place of one over all combinations. In a box the density is constant within a bin, so that it
integrates to 1; a sample is uniform within its bin, and the mode is the middle of one. Choices (`MultiDiscrete`) are their own bins.

Source: notes 2.3.2; Metz et al. 2017.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, ScalarLike

from ..core import Action, PRNGKey, Spec, setting
from ..ops.distributions import Distribution
from .heads import Head, HeadRecipe, require_kind
from .network import Linear

PATHS = 32
"""Sampled actions that an entropy or a KL of several entries is averaged over."""


class Autoregressive(HeadRecipe):
    """`--learner.head autoregressive --learner.head.bins 21`; for bounded boxes and multi-discrete actions."""

    bins: int = setting(21, "bins of each entry of a box", at_least=2)
    hidden: int = setting(64, "hidden units of each entry", at_least=1)

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("box", "multi_discrete")

    def build(self, features: int, spec: Spec, key: PRNGKey) -> "AutoregressiveHead":
        require_kind(self, spec)
        if spec.kind == "box" and not spec.is_bounded:
            raise ValueError("bins need a box with bounds, and this one has none on some side: use the head mixture")
        counts = spec.counts or (self.bins,) * spec.size
        entries, widest = len(counts), max(counts)
        feature_key, table_key, out_key = jax.random.split(key, 3)
        table = jax.random.normal(table_key, (entries, entries, widest, self.hidden)) / math.sqrt(entries)
        out = jax.vmap(lambda k: Linear.of(self.hidden, widest, k, 0.01))(jax.random.split(out_key, entries))
        inputs = Linear.of(features, entries * self.hidden, feature_key)
        return AutoregressiveHead(inputs=inputs, table=table, out=out, counts=counts, spec=spec)


class AutoregressiveHead(Head):
    """One hidden layer for each entry, which sees the features and the bins of the entries before it."""

    inputs: Linear
    table: Float[Array, "D D W H"]
    out: Linear
    counts: tuple[int, ...] = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)

    def __call__(self, features: Float[Array, "F"], mask: Array | None = None) -> "AutoregressiveLaw":
        del mask
        context = self.inputs(features).reshape(len(self.counts), -1)
        return AutoregressiveLaw(context, self.table, self.out, self.counts, self.spec)

    def loss(
        self, features: Float[Array, "F"], action: Action, key: PRNGKey, mask: Array | None = None
    ) -> Float[Array, ""]:
        del key
        return -self(features, mask).log_prob(action)

    def with_least_std(self, least: ScalarLike) -> "AutoregressiveHead":
        del least
        return self


class AutoregressiveLaw(Distribution):
    """The law of D entries, one after the other; `entropy` and `kl` are means over `PATHS` sampled actions, exact for one entry.

    `context` is what the hidden layer of each entry gets from the observation. `mode` takes the likeliest bin of each entry
    given those before it, which need not be the likeliest whole action.
    """

    context: Float[Array, "D H"]
    table: Float[Array, "D D W H"]
    out: Linear
    counts: tuple[int, ...] = eqx.field(static=True)
    spec: Spec = eqx.field(static=True)

    def bins_of(self, value: Action) -> Int[Array, "D"]:
        """The bin of each entry."""
        if self.spec.kind != "box":
            return value.reshape(-1).astype(jnp.int32)
        low, high = self._bounds()
        place = (value.reshape(-1) - low) / (high - low) * jnp.asarray(self.counts)
        return jnp.clip(jnp.floor(place).astype(jnp.int32), 0, jnp.asarray(self.counts) - 1)

    def value_of(self, bins: Int[Array, "D"], within: ScalarLike | Float[Array, "D"] = 0.5) -> Action:
        """The action in these bins, at the share `within` of their width."""
        if self.spec.kind != "box":
            return bins.astype(self.spec.dtype).reshape(self.spec.shape)
        low, high = self._bounds()
        return (low + (bins + within) * (high - low) / jnp.asarray(self.counts)).reshape(self.spec.shape)

    def log_probs(self, bins: Int[Array, "D"]) -> Float[Array, "D W"]:
        """Log p(. | a_<k) of each entry, for the entries before it as in `bins`."""
        rows = jax.vmap(lambda k: self._row(k, bins))(jnp.arange(len(self.counts)))
        return rows

    def sample(self, key: Key[Array, ""]) -> Action:
        bin_key, place_key = jax.random.split(key)
        within = jax.random.uniform(place_key, (len(self.counts),))
        return self.value_of(self._sample_bins(bin_key), within)

    def log_prob(self, value: Action) -> Float[Array, ""]:
        bins = self.bins_of(value)
        chosen = jnp.take_along_axis(self.log_probs(bins), bins[:, None], axis=1)
        return chosen.sum() - self._log_volume()

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Action, Float[Array, ""]]:
        value = self.sample(key)
        return value, self.log_prob(value)

    def entropy(self) -> Float[Array, ""]:
        return self._log_volume() - self._expect(self)

    def mode(self) -> Action:
        choose = lambda k, bins: bins.at[k].set(jnp.argmax(self._row(k, bins)).astype(jnp.int32))  # noqa: E731
        return self.value_of(jax.lax.fori_loop(0, len(self.counts), choose, self._none()))

    def kl(self, other: "AutoregressiveLaw") -> Float[Array, ""]:
        return self._expect(self) - self._expect(other)

    def _none(self) -> Int[Array, "D"]:
        return jnp.zeros(len(self.counts), jnp.int32)

    def _sample_bins(self, key: Array) -> Int[Array, "D"]:
        keys = jax.random.split(key, len(self.counts))
        draw = lambda k, bins: bins.at[k].set(jax.random.categorical(keys[k], self._row(k, bins)).astype(jnp.int32))  # noqa: E731
        return jax.lax.fori_loop(0, len(self.counts), draw, self._none())

    def _row(self, k: Int[Array, ""], bins: Int[Array, "D"]) -> Float[Array, "W"]:
        """Log p(a_k | a_<k)."""
        before = jnp.arange(len(self.counts))
        seen = jnp.where(before[:, None] < k, self.table[k][before, bins], 0.0).sum(0)
        layer = jax.tree.map(lambda x: x[k], self.out)
        logits = layer(jnp.tanh(self.context[k] + seen))
        allowed = jnp.arange(max(self.counts)) < jnp.asarray(self.counts)[k]
        return jax.nn.log_softmax(jnp.where(allowed, logits, 0.5 * jnp.finfo(logits.dtype).min))

    def _expect(self, other: "AutoregressiveLaw") -> Float[Array, ""]:
        """E[log q(bins)] under this law, for `other` = q: exact in each entry, given sampled entries before it."""

        def one(key: Array) -> Array:
            bins = self._sample_bins(key)
            log_p, log_q = self.log_probs(bins), other.log_probs(bins)
            terms = (jnp.exp(log_p) * jnp.where(log_p > -1e30, log_q, 0.0)).sum(-1)
            chosen = jnp.take_along_axis(log_p, bins[:, None], axis=1)[:, 0]
            before = jnp.cumsum(chosen) - chosen
            # Worth nothing, and has the gradient of the probabilities of the entries before, which were sampled.
            score = (before - jax.lax.stop_gradient(before)) * jax.lax.stop_gradient(terms)
            return (terms + score).sum()

        paths = 1 if len(self.counts) == 1 else PATHS
        return jax.vmap(one)(jax.random.split(jax.random.key(0), paths)).mean()

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.spec.bounds()
        return low.reshape(-1), high.reshape(-1)

    def _log_volume(self) -> float:
        """Logarithm of the volume of a cell of bins; 0 for choices."""
        if self.spec.kind != "box":
            return 0.0
        low, high = self._bounds()
        return float(np.log((np.float64(high) - low) / np.asarray(self.counts)).sum())
