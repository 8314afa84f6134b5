"""A mixture of Gaussians over a box: several peaks, where one Gaussian would lie between them (notes 2.3.2; Bishop 1994).

Weights and means are linear in the features; each component has standard deviations of its own, which do not depend on the
observation. Deviation from mixture density networks, where they do: the likelihood of data without noise then runs away in
single observations.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from ..core import Action, PRNGKey, Spec, setting
from ..ops.mixtures import GaussianMixture
from .heads import Head, HeadRecipe, at_least, centre, half_width, require_kind
from .network import Linear


class Mixture(HeadRecipe):
    """`--learner.head mixture --learner.head.components 5`."""

    components: int = setting(5, "K: Gaussians in the mixture", at_least=1)

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("box",)

    def build(self, features: int, spec: Spec, key: PRNGKey) -> "MixtureHead":
        require_kind(self, spec)
        weight_key, mean_key, place_key = jax.random.split(key, 3)
        count = self.components
        means = Linear.of(features, count * spec.size, mean_key, 0.01)
        # Components that begin in one place stay together: each begins somewhere in the box.
        places = jax.random.uniform(place_key, means.bias.shape, minval=-1.0, maxval=1.0)
        means = eqx.tree_at(lambda m: m.bias, means, places)
        log_std = jnp.broadcast_to(jnp.log(0.5 * half_width(spec)), (count, *spec.shape))
        weights = Linear.of(features, count, weight_key, 0.01)
        return MixtureHead(weights=weights, means=means, log_std=log_std, spec=spec)


class MixtureHead(Head):
    """Linear layers for the logits of the weights and for the means, and free standard deviations."""

    weights: Linear
    means: Linear
    log_std: Float[Array, "K *A"]
    spec: Spec = eqx.field(static=True)

    def __call__(self, features: Float[Array, "F"], mask: Array | None = None) -> GaussianMixture:
        del mask
        out = self.means(features).reshape(self.log_std.shape)
        mean = jnp.asarray(centre(self.spec))[None] + jnp.asarray(half_width(self.spec))[None] * out
        return GaussianMixture(self.weights(features), mean, self.log_std)

    def loss(
        self, features: Float[Array, "F"], action: Action, key: PRNGKey, mask: Array | None = None
    ) -> Float[Array, ""]:
        del key
        return -self(features, mask).log_prob(action)

    def with_least_std(self, least: ScalarLike) -> "MixtureHead":
        floor = jax.vmap(lambda log_std: at_least(log_std, least, self.spec))
        return eqx.tree_at(lambda h: h.log_std, self, floor(self.log_std))
