r"""What is believed of the parameters of a network: an ensemble, a Gaussian for each weight, or dropout (notes 8.3.3).

All that planning needs of p(theta | D) is E networks drawn from it, side by side. Three ways to have them, each a recipe:

    Bootstrap   E networks with first weights and data of their own: (1/E) sum_e delta(theta - theta_e) (erratum E8.14)
    MeanField   q(theta) = prod_j N(mu_j, sigma_j^2), fitted by the evidence lower bound (Blundell et al. 2015)
    Dropout     q: units are on or off, theta the weights that are left (Gal and Ghahramani 2016)

The last two maximise, by reparametrised draws,

$$\mathbb{E}_{\theta \sim q} \Big[ \sum_{i \in D} \log p(y_i \mid x_i, \theta) \Big] - \mathrm{KL}(q \,\|\, p(\theta)),$$

here over |D| and with the other sign. The members of the first maximise the likelihood of their data, and nothing holds them to a prior.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from ..core import Configured, Number, PRNGKey, number, setting
from ..nn.network import Linear
from .ensembles import Ensemble, bootstrap_weights


class Posterior(Configured):
    """A recipe of what is kept of p(theta | D), and how networks are drawn from it."""

    @abstractmethod
    def init(
        self, inputs: int, targets: int, sizes: tuple[int, ...], members: int, key: PRNGKey
    ) -> PyTree[Float[Array, "..."]]:
        """Its parameters, before any data."""

    @abstractmethod
    def draw(self, parameters: PyTree, members: int, key: PRNGKey) -> Ensemble:
        """Members theta_e ~ q, differentiable in the parameters."""

    @abstractmethod
    def shares(self, indices: Int[Array, "N"], members: int) -> Float[Array, "E N"]:
        """How often each member has each sample."""

    @abstractmethod
    def divergence(self, parameters: PyTree) -> Float[Array, ""]:
        """KL(q || p(theta)), up to a constant; 0 without a prior."""


class Bootstrap(Posterior):
    """An ensemble. With resampling a member has each sample as often as a Poisson variable of mean 1 says, which is the bootstrap in
    the limit of much data, and depends on nothing but the place of the sample in the data, so that nothing has to be stored.
    """

    resample: bool = setting(
        True, "each member has its own sample of the data; otherwise only its own first weights (erratum E8.15)"
    )

    def init(self, inputs: int, targets: int, sizes: tuple[int, ...], members: int, key: PRNGKey) -> Ensemble:
        return Ensemble.of(inputs, targets, sizes, members, key)

    def draw(self, parameters: Ensemble, members: int, key: PRNGKey) -> Ensemble:
        del members, key
        return parameters

    def shares(self, indices: Int[Array, "N"], members: int) -> Float[Array, "E N"]:
        return bootstrap_weights(indices, members) if self.resample else jnp.ones((members, len(indices)))

    def divergence(self, parameters: Ensemble) -> Float[Array, ""]:
        del parameters
        return jnp.zeros(())


class Weights(eqx.Module):
    """Means of the weights of one network, and the logarithms of their deviations."""

    mean: tuple[Linear, ...]
    log_sd: tuple[Linear, ...]


class MeanField(Posterior):
    """Independent Gaussians for the weights ("Bayes by backprop"). A prior weight is N(0, prior^2 / inputs of its layer), a bias
    N(0, prior^2).

    Its optimum in a linear model has the right mean, and the variances 1 / Lambda_jj of the precision Lambda: those of the posterior where
    the features are orthogonal, too small where they are not.
    """

    prior: Number = number(1.0, "deviation of the prior, of a bias; of a weight over the root of its inputs", above=0)
    first: Number = number(0.05, "deviations to begin with, in units of the prior's", above=0)
    temperature: Number = number(
        1.0, "weight of the divergence; below 1 the data count more than they should (cold posterior)", at_least=0
    )

    def init(self, inputs: int, targets: int, sizes: tuple[int, ...], members: int, key: PRNGKey) -> Weights:
        del members
        mean = one_network(inputs, targets, sizes, key)
        return Weights(mean, jax.tree.map(lambda scale: jnp.log(self.first * scale), prior_scales(mean, self.prior)))

    def draw(self, parameters: Weights, members: int, key: PRNGKey) -> Ensemble:
        def one(key: PRNGKey) -> tuple[Linear, ...]:
            means, structure = jax.tree.flatten(parameters.mean)
            spreads = jax.tree.leaves(parameters.log_sd)
            keys = jax.random.split(key, len(means))
            noise = [jax.random.normal(k, m.shape, m.dtype) for k, m in zip(keys, means, strict=True)]
            moved = [m + jnp.exp(s) * e for m, s, e in zip(means, spreads, noise, strict=True)]
            return jax.tree.unflatten(structure, moved)

        return Ensemble(jax.vmap(one)(jax.random.split(key, members)))

    def shares(self, indices: Int[Array, "N"], members: int) -> Float[Array, "E N"]:
        return jnp.ones((members, len(indices)))

    def divergence(self, parameters: Weights) -> Float[Array, ""]:
        def kl(scale: Array, mean: Array, log_sd: Array) -> Array:
            return (jnp.log(scale) - log_sd + 0.5 * (jnp.exp(2.0 * log_sd) + mean**2) / scale**2 - 0.5).sum()

        scales = prior_scales(parameters.mean, self.prior)
        parts = jax.tree.map(kl, scales, parameters.mean, parameters.log_sd)
        return self.temperature * sum(jax.tree.leaves(parts), jnp.zeros(()))


class Dropout(Posterior):
    """One network whose hidden units are dropped at random, in training and in prediction: a member is one choice of units for all
    inputs and for a whole rollout. What is left is scaled by 1 / (1 - rate).

    The divergence is its usual stand-in, a decay of the weights, (1 - rate) |W|^2 / (2 s^2) with the prior's deviation s as in `MeanField`
    (Gal and Ghahramani 2016, section 3). In a linear model with dropped inputs it is ridge regression with the penalty
    rate / (1 - rate) sum_j w_j^2 |x_j|^2.
    """

    rate: Number = number(0.1, "chance that a unit is dropped", at_least=0, below=1)
    drop_inputs: bool = setting(False, "inputs are dropped too")
    prior: Number = number(1.0, "deviation of the prior, of a bias; of a weight over the root of its inputs", above=0)
    temperature: Number = number(1.0, "weight of the divergence", at_least=0)

    def init(self, inputs: int, targets: int, sizes: tuple[int, ...], members: int, key: PRNGKey) -> tuple[Linear, ...]:
        del members
        return one_network(inputs, targets, sizes, key)

    def draw(self, parameters: tuple[Linear, ...], members: int, key: PRNGKey) -> Ensemble:
        keep = 1.0 - self.rate

        def one(key: PRNGKey) -> tuple[Linear, ...]:
            layers = []
            for i, (layer, k) in enumerate(zip(parameters, jax.random.split(key, len(parameters)), strict=True)):
                if i == 0 and not self.drop_inputs:
                    layers.append(layer)
                    continue
                # A dropped unit is a column of zeros in the weights of the layer after it.
                left = jax.random.bernoulli(k, keep, layer.weight.shape[1:]) / keep
                layers.append(Linear(layer.weight * left[None, :], layer.bias))
            return tuple(layers)

        return Ensemble(jax.vmap(one)(jax.random.split(key, members)))

    def shares(self, indices: Int[Array, "N"], members: int) -> Float[Array, "E N"]:
        return jnp.ones((members, len(indices)))

    def divergence(self, parameters: tuple[Linear, ...]) -> Float[Array, ""]:
        total = jnp.zeros(())
        for i, (layer, scale) in enumerate(zip(parameters, prior_scales(parameters, self.prior), strict=True)):
            keep = 1.0 - self.rate if i > 0 or self.drop_inputs else 1.0
            total += (
                0.5 * (keep * (layer.weight / scale.weight) ** 2).sum() + 0.5 * ((layer.bias / scale.bias) ** 2).sum()
            )
        return self.temperature * total


def one_network(inputs: int, targets: int, sizes: tuple[int, ...], key: PRNGKey) -> tuple[Linear, ...]:
    """The layers of a single network of an ensemble."""
    return jax.tree.map(lambda x: x[0], Ensemble.of(inputs, targets, sizes, 1, key).layers)


def prior_scales(layers: tuple[Linear, ...], prior: Number) -> tuple[Linear, ...]:
    """The prior's deviation of each weight. N(0, prior^2 / inputs) keeps what goes through a layer as large as it came."""
    full = lambda layer: Linear(  # noqa: E731
        jnp.full_like(layer.weight, prior / layer.weight.shape[1] ** 0.5), jnp.full_like(layer.bias, prior)
    )
    return tuple(full(layer) for layer in layers)
