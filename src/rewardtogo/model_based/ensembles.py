r"""Networks side by side that say how sure they are, and the variances of what they say together (notes 8.3.3; Chua et al. 2018).

Every member e says of targets y, such as the change of the state and the reward,

$$p_e(y \mid s, a) = N(\mu_e(s, a), \operatorname{diag} \sigma_e^2(s, a)),$$

and how likely the episode ends. Their mixture has the variance

$$\operatorname{Var} y = \underbrace{\tfrac1E \sum_e \sigma_e^2}_{\text{aleatoric}} + \underbrace{\operatorname{Var}_e
\mu_e}_{\text{epistemic}}$$

(erratum E8.14: variances are averaged, not samples). A member's own entropy, 1/2 log det(2 pi e S), is of the first kind only: where
there were no data it may well be small (item 8.52).
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..core import PRNGKey
from ..nn.network import Linear

LEAST_LOG_VARIANCE, MOST_LOG_VARIANCE = -10.0, 0.5
"""Bounds of the logarithm of a member's variance, of standardised quantities; approached smoothly."""
POISSON = (0.36787944, 0.73575888, 0.91969860, 0.98101184, 0.99634015, 0.99940582)
"""Distribution function of a Poisson variable of mean 1."""


class Prediction(eqx.Module):
    """What the members say of targets: mean and log variance `[E, N, D]`, and the logit of an end `[E, N]`."""

    mean: Float[Array, "E N D"]
    log_variance: Float[Array, "E N D"]
    end: Float[Array, "E N"]


class Ensemble(eqx.Module):
    """E networks of one shape side by side: dense layers with SiLU, and a head for D targets. One product of matrices a layer for all."""

    layers: tuple[Linear, ...]

    @staticmethod
    def of(inputs: int, targets: int, sizes: tuple[int, ...], members: int, key: PRNGKey) -> "Ensemble":
        """Fresh networks."""
        widths = (inputs, *sizes)
        keys = jax.random.split(key, (len(widths), members))
        outputs = (*sizes, 2 * targets + 1)
        gains = [2.0**0.5] * len(sizes) + [0.1]
        build = lambda k, i, o, gain: jax.vmap(lambda k: Linear.of(i, o, k, gain))(k)  # noqa: E731
        return Ensemble(tuple(build(k, i, o, g) for k, i, o, g in zip(keys, widths, outputs, gains, strict=True)))

    def __call__(self, x: Float[Array, "E N I"]) -> Prediction:
        """The members' words on inputs of their own."""
        for i, layer in enumerate(self.layers):
            x = jnp.einsum("eni,eoi->eno", x, layer.weight) + layer.bias[:, None, :]
            x = jax.nn.silu(x) if i < len(self.layers) - 1 else x
        targets = (x.shape[-1] - 1) // 2
        mean, raw, end = x[..., :targets], x[..., targets:-1], x[..., -1]
        below = MOST_LOG_VARIANCE - jax.nn.softplus(MOST_LOG_VARIANCE - raw)
        return Prediction(mean, LEAST_LOG_VARIANCE + jax.nn.softplus(below - LEAST_LOG_VARIANCE), end)


def gaussian_nll(
    prediction: Prediction, targets: Float[Array, "N D"], noise: float | Float[Array, "*D"] | None = None
) -> Float[Array, "E N"]:
    """1/2 [(y - mu)^2 / sigma^2 + log sigma^2] summed over the targets (item 8.53).

    With `noise`, a deviation, sigma is that and not what the members say; at 1 it is half the squared error.
    """
    error = (targets[None] - prediction.mean) ** 2
    if noise is not None:
        fixed = jnp.broadcast_to(jnp.asarray(noise, error.dtype), error.shape)
        return (0.5 * error / fixed**2 + jnp.log(fixed)).sum(-1)
    return 0.5 * (error * jnp.exp(-prediction.log_variance) + prediction.log_variance).sum(-1)


def aleatoric(prediction: Prediction) -> Float[Array, "N D"]:
    """The mean of the members' variances."""
    return jnp.exp(prediction.log_variance).mean(0)


def epistemic(prediction: Prediction) -> Float[Array, "N D"]:
    """The variance of the members' means (item 8.54)."""
    return prediction.mean.var(0)


def total_variance(prediction: Prediction) -> Float[Array, "N D"]:
    """Of the mixture: aleatoric and epistemic (item 8.55)."""
    return aleatoric(prediction) + epistemic(prediction)


def output_entropy(prediction: Prediction) -> Float[Array, "E N"]:
    """Entropy of each member's own Gaussian, 1/2 log det(2 pi e S), in nats (item 8.52)."""
    return 0.5 * (math.log(2.0 * math.pi * math.e) + prediction.log_variance).sum(-1)


def bootstrap_weights(indices: Int[Array, "N"], members: int) -> Float[Array, "E N"]:
    """How often each member has each sample: Poisson of mean 1, the same for a place in the data whenever it is asked (item 8.59)."""

    def one(member: Array, index: Array) -> Array:
        uniform = jax.random.uniform(jax.random.fold_in(jax.random.fold_in(jax.random.key(7), member), index))
        return (uniform > jnp.asarray(POISSON)).sum().astype(jnp.float32)

    return jax.vmap(lambda e: jax.vmap(lambda i: one(e, i))(indices))(jnp.arange(members))


def is_held_out(indices: Int[Array, "N"], share: float | Array) -> Bool[Array, "N"]:
    """A fixed share of the places in the data, chosen by chance, that no member learns from."""
    draw = lambda i: jax.random.uniform(jax.random.fold_in(jax.random.key(11), i))  # noqa: E731
    return jax.vmap(draw)(indices) < share
