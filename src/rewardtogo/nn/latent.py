r"""A policy with a hidden variable, trained as a conditional variational autoencoder (notes 2.3.2 and chapter 10).

$$\pi(a \mid s) = \int p(a \mid s, z)\, N(z; 0, I)\, dz, \qquad
\log \pi(a \mid s) \ge \mathbb{E}_{z \sim q(z \mid s, a)}[\log p(a \mid s, z)] - D_{KL}\big(q(z \mid s, a) \,\Vert\, N(0, I)\big)$$

with a Gaussian p(a | s, z) around a network's output, and a Gaussian q whose mean and spread another network makes of features and
action. Acting draws z first; its mean as a function of z may have several peaks, or a curve of them.

What is maximised is the importance-weighted bound with K draws, log 1/K sum_k p(a | s, z_k) N(z_k; 0, I) / q(z_k | s, a), which is
the bound above for K = 1 and comes nearer to log pi with K. With one draw q must keep clear of every z that means the other
peak, and the actions of the gap that it leaves lie between the peaks.

Source: notes 2.3.2; Kingma and Welling 2014; Sohn et al. 2015; Burda et al. 2016 (K draws).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, ScalarLike

from ..core import Action, PRNGKey, Spec, setting
from ..ops.distributions import DiagGaussian, Distribution
from ..ops.mixtures import GaussianMixture, normal_nodes
from .heads import Head, HeadRecipe, at_least, centre, half_width, require_kind
from .network import Linear

NODES = 64
"""Points of N(0, I) that the integral over z is estimated with."""
Z_GAIN = 12.0
"""Gain of the layer that z enters by: actions then change fast along z, and little of N(0, I) falls between two peaks."""


class Latent(HeadRecipe):
    """`--learner.head latent --learner.head.size 2`."""

    size: int = setting(2, "Z: numbers in the hidden variable", at_least=1)
    hidden: int = setting(64, "hidden units of the networks that make actions of it, and it of actions", at_least=1)

    samples: int = setting(8, "K: hidden variables drawn for the bound; 1 is the plain one", at_least=1)

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("box",)

    def build(self, features: int, spec: Spec, key: PRNGKey) -> "LatentHead":
        require_kind(self, spec)
        keys = jax.random.split(key, 5)
        return LatentHead(
            observed=Linear.of(features, self.hidden, keys[0]),
            hidden=Linear.of(self.size, self.hidden, keys[1], Z_GAIN),
            mean=Linear.of(self.hidden, spec.size, keys[2], 0.5),
            encoder=Linear.of(features + spec.size, self.hidden, keys[3]),
            posterior=Linear.of(self.hidden, 2 * self.size, keys[4], 0.1),
            # A wide Gaussian explains everything by itself, and the hidden variable is then never used.
            log_std=jnp.log(jnp.asarray(0.1 * half_width(spec))),
            spec=spec,
            samples=self.samples,
        )


class LatentHead(Head):
    """Decoder: features and z through a hidden layer to the mean of the action. Encoder: features and action to q(z | s, a)."""

    observed: Linear
    hidden: Linear
    mean: Linear
    encoder: Linear
    posterior: Linear
    log_std: Float[Array, "*A"]
    spec: Spec = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    def __call__(self, features: Float[Array, "F"], mask: Array | None = None) -> "LatentLaw":
        del mask
        return LatentLaw(self.observed(features), self.hidden, self.mean, self.log_std, self.spec)

    def loss(
        self, features: Float[Array, "F"], action: Action, key: PRNGKey, mask: Array | None = None
    ) -> Float[Array, ""]:
        """Minus the bound; its sample with `samples` = 1 has the exact KL divergence in it, which is less noisy."""
        mean, log_std = self.encode(features, action)
        posterior, prior = DiagGaussian(mean, log_std), DiagGaussian(jnp.zeros_like(mean), jnp.zeros_like(mean))
        law = self(features, mask)
        draws = jax.vmap(posterior.sample)(jax.random.split(key, self.samples))
        explained = jax.vmap(lambda z: law.given(z).log_prob(action))(draws)
        if self.samples == 1:
            return posterior.kl(prior) - explained[0]
        ratio = jax.vmap(lambda z: prior.log_prob(z) - posterior.log_prob(z))(draws)
        return jnp.log(self.samples) - jax.nn.logsumexp(explained + ratio)

    def encode(self, features: Float[Array, "F"], action: Action) -> tuple[Float[Array, "Z"], Float[Array, "Z"]]:
        """Mean and log standard deviation of q(z | s, a)."""
        scaled = ((action - centre(self.spec)) / half_width(self.spec)).reshape(-1)
        out = self.posterior(jnp.tanh(self.encoder(jnp.concatenate([features, scaled]))))
        mean, log_std = jnp.split(out, 2)
        return mean, jnp.clip(log_std, -6.0, 2.0)

    def with_least_std(self, least: ScalarLike) -> "LatentHead":
        return eqx.tree_at(lambda h: h.log_std, self, at_least(self.log_std, least, self.spec))


class LatentLaw(Distribution):
    """Draws z and then the action given it. Densities, `entropy`, `kl` and `mode` are those of the mixture over `NODES` fixed z,
    the integral by quadrature: an estimate.
    """

    context: Float[Array, "H"]
    hidden: Linear
    mean: Linear
    log_std: Float[Array, "*A"]
    spec: Spec = eqx.field(static=True)

    def given(self, z: Float[Array, "Z"]) -> GaussianMixture:
        """p(a | s, z), as a mixture of one."""
        return GaussianMixture(jnp.zeros(1), self._mean(z)[None], self.log_std[None])

    def mixture(self) -> GaussianMixture:
        """The law with N(0, I) in place by `NODES` points of equal weight."""
        nodes = jnp.asarray(normal_nodes(NODES, self.hidden.weight.shape[1]))
        log_std = jnp.broadcast_to(self.log_std, (NODES, *self.log_std.shape))
        return GaussianMixture(jnp.zeros(NODES), jax.vmap(self._mean)(nodes), log_std)

    def sample(self, key: Key[Array, ""]) -> Action:
        z_key, noise_key = jax.random.split(key)
        z = jax.random.normal(z_key, self.hidden.weight.shape[1:])
        return self._mean(z) + jnp.exp(self.log_std) * jax.random.normal(noise_key, self.log_std.shape)

    def log_prob(self, value: Action) -> Float[Array, ""]:
        return self.mixture().log_prob(value)

    def sample_and_log_prob(self, key: Key[Array, ""]) -> tuple[Action, Float[Array, ""]]:
        value = self.sample(key)
        return value, self.log_prob(value)

    def entropy(self) -> Float[Array, ""]:
        return self.mixture().entropy()

    def mode(self) -> Action:
        return self.mixture().mode()

    def kl(self, other: "LatentLaw") -> Float[Array, ""]:
        return self.mixture().kl(other.mixture())

    def _mean(self, z: Array) -> Array:
        out = self.mean(jnp.tanh(self.context + self.hidden(z))).reshape(self.spec.shape)
        return jnp.asarray(centre(self.spec)) + jnp.asarray(half_width(self.spec)) * out
