r"""Which way the search goes down its tree: a traversal rule, not a policy of control (notes, section 8.2.3; item 8.19).

Of the edges of a node, one for each action, a rule sees the mean return $\bar q_a$ scaled to [0, 1] from the side of the player who is to
move, how often $n_a$ each was taken, and how often $N$ returns were counted through the node.

    UCT    q_a + 2 C sqrt(2 ln N / n_a), unvisited ones first         (Kocsis and Szepesvari 2006; Browne et al. 2012)
    PUCT   q_a + c(N) p_a sqrt(N) / (1 + n_a),  c(N) = c_1 + ln((1 + N + c_2) / c_2)       (Silver et al. 2018)

The notes print the square root over the ratio only, and leave open what Q is: with a *sum* of returns, Q/N is the mean (erratum E8.9).
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core import Configured, Number, PRNGKey, number

Bounds = tuple[Number, Number] | None
"""The least and the greatest return, or None for the extremes met so far."""


class Edges(eqx.Module):
    """What is known of the actions in one node.

    - `mean`: of the returns through each action, 0 the least and 1 the greatest possible for the player to move; 0 where there is none.
    - `counts`: n_a.
    - `prior`: p_a, of a network, or the same for all that are allowed.
    - `visits`: N.
    """

    mean: Float[Array, "A"]
    counts: Float[Array, "A"]
    prior: Float[Array, "A"]
    visits: Float[Array, ""]


class TreePolicy(Configured):
    """The traversal rule: the search follows the action with the greatest score, ties by lot."""

    @abstractmethod
    def __call__(self, edges: Edges) -> Float[Array, "A"]:
        """A score for each action."""

    @abstractmethod
    def root_prior(self, prior: Float[Array, "A"], legal: Bool[Array, "A"], key: PRNGKey) -> Float[Array, "A"]:
        """The prior at the root, with noise where the rule explores so."""


class UCT(TreePolicy):
    """Upper confidence bounds for trees (items 8.23 and 8.24): an action never tried is worth infinitely much, so that each is tried once.

    C = 1/sqrt(2) is right for returns in [0, 1], which the search makes of them; at C = 0 the rule is greedy once all were tried.
    """

    exploration: Number = number(0.5**0.5, "C: weight of the confidence bound", at_least=0)

    def __call__(self, edges: Edges) -> Float[Array, "A"]:
        tried = jnp.maximum(edges.counts, 1.0)
        bound = 2.0 * self.exploration * jnp.sqrt(2.0 * jnp.log(jnp.maximum(edges.visits, 1.0)) / tried)
        return jnp.where(edges.counts > 0, edges.mean + bound, jnp.inf)

    def root_prior(self, prior: Float[Array, "A"], legal: Bool[Array, "A"], key: PRNGKey) -> Float[Array, "A"]:
        del legal, key
        return prior


class PUCT(TreePolicy):
    """AlphaZero's rule, which asks a learned prior first. An action never tried is worth what the others are on average.

    Deviations: AlphaZero takes values in [-1, 1] as they are and 0 for what was never tried; scaled ones are MuZero's, and so are c_1 and
    c_2. Noise at the root, for self-play, is off unless `noise` is set.
    """

    base: Number = number(1.25, "c_1: weight of the prior in small trees", at_least=0)
    growth: Number = number(19652.0, "c_2: visits after which the weight grows", above=0)
    noise: Number = number(0.0, "share of Dirichlet noise in the root's prior", at_least=0, at_most=1)
    concentration: Number = number(0.3, "alpha of the Dirichlet noise; about 10 over the number of moves", above=0)

    def __call__(self, edges: Edges) -> Float[Array, "A"]:
        tried = edges.counts > 0
        total = edges.counts.sum()
        average = jnp.where(total > 0, (edges.counts * edges.mean).sum() / jnp.maximum(total, 1.0), 0.5)
        weight = self.base + jnp.log((1.0 + edges.visits + self.growth) / self.growth)
        bonus = weight * edges.prior * jnp.sqrt(jnp.maximum(edges.visits, 1.0)) / (1.0 + edges.counts)
        return jnp.where(tried, edges.mean, average) + bonus

    def root_prior(self, prior: Float[Array, "A"], legal: Bool[Array, "A"], key: PRNGKey) -> Float[Array, "A"]:
        # A Dirichlet sample over the allowed actions: independent gammas, divided by their sum.
        gammas = jax.random.gamma(key, self.concentration, prior.shape) * legal
        return (1.0 - self.noise) * prior + self.noise * gammas / jnp.maximum(gammas.sum(), 1e-30)
