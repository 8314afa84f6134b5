"""A stochastic policy without a value function: what learners use that never ask how good a state is."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core import Action, Carry, EnvSpec, Observation, Policy, PRNGKey
from ..ops.distributions import Categorical, DiagGaussian, Distribution
from ..ops.mixtures import GaussianMixture
from .encoding import RunningNorm, action_mask
from .heads import Head, HeadRecipe, Standard
from .network import Network, Torso
from .recurrent import is_recurrent, unroll


class ActorNetwork(eqx.Module):
    """A torso and a head that turns its features into the distribution of the action."""

    torso: Torso
    head: Head

    @staticmethod
    def of(network: Network, spec: EnvSpec, key: PRNGKey, head: HeadRecipe | None = None) -> "ActorNetwork":
        """Fresh parameters, with the usual head of the space unless another is given."""
        torso_key, head_key = jax.random.split(key)
        torso = network.build(spec.observation, torso_key)
        return ActorNetwork(torso, (head or Standard()).build(torso.features, spec.action, head_key))

    def init(self) -> Carry:
        """The memory at the start of an episode."""
        return self.torso.init()

    def __call__(self, carry: Carry, observation: Observation) -> tuple[Carry, Distribution]:
        """The memory after the observation, and the distribution of the action."""
        carry, features = self.torso(carry, observation)
        return carry, self.head(features, action_mask(observation))

    @property
    def recurrent(self) -> bool:
        """Whether there is a memory."""
        return is_recurrent(self.torso)

    def along(self, carry: Carry, observation: Observation, done: Bool[Array, "T"]) -> Distribution:
        """The distributions of a sequence `[T]`, from the memory before its first step, reset after each end."""
        features = self.features_along(carry, observation, done)
        return jax.vmap(lambda x, m: self.head(x, m))(features, action_mask(observation))

    def features_along(self, carry: Carry, observation: Observation, done: Bool[Array, "T"]) -> Float[Array, "T F"]:
        """What the head gets in each step of a sequence `[T]`."""
        return unroll(self.torso, carry, observation, done)[1]


class StochasticPolicy(Policy):
    """Acts with an `ActorNetwork`: samples to explore, otherwise takes the mode. Keeps the action's `log_prob`."""

    network: ActorNetwork
    norm: RunningNorm | None
    explore: bool = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return self.network.init()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        carry, distribution = self.look(carry, observation)
        if self.explore:
            action, log_prob = distribution.sample_and_log_prob(key)
        else:
            action = distribution.mode()
            log_prob = distribution.log_prob(action)
        return carry, action, {"log_prob": log_prob}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        _, distribution = self.look(carry, observation)
        thoughts = {"entropy": distribution.entropy()}
        if isinstance(distribution, Categorical):
            thoughts["probabilities"] = distribution.probs
        if isinstance(distribution, DiagGaussian):
            thoughts |= {"mean": distribution.mean, "std": jnp.exp(distribution.log_std)}
        if isinstance(distribution, GaussianMixture):
            thoughts |= {
                "weights": distribution.weights,
                "mean": distribution.mean,
                "std": jnp.exp(distribution.log_std),
            }
        return thoughts

    def look(self, carry: Carry, observation: Observation) -> tuple[Carry, Distribution]:
        """The memory after the observation, and the law that the action is drawn from."""
        return self.network(carry, observation if self.norm is None else self.norm(observation))
