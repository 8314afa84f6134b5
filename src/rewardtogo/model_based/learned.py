r"""A model that was learned, to plan in: particles that follow members, and what is made of the returns they end with (notes 8.3.3).

    theta ~ p(theta | D);   for each t   s_{t+1} ~ p(s_{t+1} | s_t, a_t, theta);   R = sum_t r(s_t, a_t);   J = the mean of many R

Particles carry the state, each by one member for the whole rollout (TS-infinity, the scheme above) or by another at each step (TS1; Chua
et al. 2018), and all do the same actions (erratum E8.14): J = 1/N sum_i sum_t r(s_{t,i}, a_t) (item 8.61).
"""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core import Action, Observation, PRNGKey, Spec
from ..nn import RunningNorm, flatten_observation
from .ensembles import Ensemble, Prediction
from .planned import Imagining, encode_action

OBJECTIVES = ("mean", "lcb", "ucb", "quantile")
"""What can be made of returns that differ from member to member: neither optimistic nor pessimistic; pessimistic; optimistic; either."""


class Objective(eqx.Module):
    """One number for the returns of several members (item 8.51).

    mean, mean - kappa sd ("lcb"), mean + kappa sd ("ucb"), or the quantile of the given level.
    """

    kappa: Float[Array, ""]
    level: Float[Array, ""]
    kind: Literal["mean", "lcb", "ucb", "quantile"] = eqx.field(static=True, default="mean")

    @staticmethod
    def of(
        kind: Literal["mean", "lcb", "ucb", "quantile"] = "mean", kappa: float = 1.0, level: float = 0.25
    ) -> "Objective":
        """From plain numbers."""
        return Objective(jnp.asarray(kappa, jnp.float32), jnp.asarray(level, jnp.float32), kind)

    def __call__(self, returns: Float[Array, "M"]) -> Float[Array, ""]:
        """J of M returns."""
        if self.kind == "mean":
            return returns.mean()
        if self.kind == "quantile":
            return jnp.quantile(returns, self.level.astype(returns.dtype))
        # A little more than 0, where the root has no derivative.
        sd = jnp.sqrt(returns.var() + 1e-12)
        return returns.mean() + (self.kappa if self.kind == "ucb" else -self.kappa) * sd


class Belief(eqx.Module):
    """Where a rollout stands: particles `[E, K, O]`, the reward that led here, the discounted return of each particle so far, the weight of
    the next reward, and the chance that each goes on.
    """

    particles: Float[Array, "E K O"]
    reward: Float[Array, ""]
    returns: Float[Array, "E K"]
    weight: Float[Array, ""]
    alive: Float[Array, "E K"]


class LearnedModel(Imagining):
    """Members as a `Model` to plan in.

    - `objective`: what is made of the returns of different members. Rewards are handed out so that their discounted sum, by
      `discount`, is this of the returns. Members' returns are means over their particles; under TS1 a particle has no member, and
      counts by itself.
    - `ends`: whether an episode was ever seen to end; otherwise none does.
    - `particles`: K for each member.
    - `propagation`: `"tsinf"` keeps a particle with its member for the whole rollout, `"ts1"` shuffles them over the members at each step
      (item 8.62), `"mean"` follows the members' means without noise.
    - `noisy`: whether the members' variances mean anything.
    - `predict_delta`: whether the change of the state was learned, or the next state (erratum E8.16).
    - `known_reward`: r(o, a, o') of flat observations, where it need not be learned.
    """

    ensemble: Ensemble
    inputs: RunningNorm
    targets: RunningNorm
    objective: Objective
    discount: Float[Array, ""]
    ends: Bool[Array, ""]
    observation: Spec = eqx.field(static=True)
    action: Spec = eqx.field(static=True)
    particles: int = eqx.field(static=True, default=1)
    propagation: Literal["tsinf", "ts1", "mean"] = eqx.field(static=True, default="tsinf")
    noisy: bool = eqx.field(static=True, default=True)
    predict_delta: bool = eqx.field(static=True, default=True)
    known_reward: Callable | None = eqx.field(static=True, default=None)

    @property
    def members(self) -> int:
        """E."""
        return self.ensemble.layers[0].bias.shape[0]

    def encode(self, observation: Observation) -> Belief:
        flat = flatten_observation(self.observation, observation)
        shape = (self.members, self.particles)
        return Belief(
            jnp.broadcast_to(flat, (*shape, flat.size)), jnp.zeros(()), jnp.zeros(shape), jnp.ones(()), jnp.ones(shape)
        )

    def predict(self, states: Float[Array, "E N O"], actions: Float[Array, "E N A"]) -> Prediction:
        """The members' words, standardised, on states and encoded actions of their own."""
        return self.ensemble(jax.vmap(jax.vmap(self.inputs))(jnp.concatenate([states, actions], -1)))

    def transition(self, state: Belief, action: Action, key: PRNGKey) -> Belief:
        noise_key, order_key = jax.random.split(key)
        before, alive = state.particles, state.alive
        encoded = encode_action(self.action, action)
        said = self.predict(before, jnp.broadcast_to(encoded, (*alive.shape, encoded.size)))
        y = said.mean
        if self.noisy and self.propagation != "mean":
            y = y + jnp.exp(0.5 * said.log_variance) * jax.random.normal(noise_key, y.shape, y.dtype)
        y = self.targets.mean[""][None, None] + self.targets.sd()[None, None] * y
        change = y[..., : before.shape[-1]]
        after = before + change if self.predict_delta else change
        if self.known_reward is None:
            rewards = y[..., -1]
        else:
            known = self.known_reward
            rewards = jax.vmap(jax.vmap(lambda o, o_: known(o, action, o_)))(before, after)
        earned = alive * rewards
        returns = state.returns + state.weight * earned
        reward = self._gained(state, returns, earned)
        alive = alive * jnp.where(self.ends, jax.nn.sigmoid(-said.end), 1.0)
        if self.propagation == "ts1":
            order = jax.random.permutation(order_key, alive.size)
            shuffle = lambda x: x.reshape(alive.size, *x.shape[2:])[order].reshape(x.shape)  # noqa: E731
            after, alive, returns = shuffle(after), shuffle(alive), shuffle(returns)
        return Belief(after, reward, returns, state.weight * self.discount.astype(state.weight.dtype), alive)

    def _gained(self, state: Belief, returns: Float[Array, "E K"], earned: Float[Array, "E K"]) -> Float[Array, ""]:
        """What the last step added to the objective of the returns, before it is discounted."""
        if self.objective.kind == "mean":
            return earned.mean()
        by_member = lambda x: x.ravel() if self.propagation == "ts1" else x.mean(1)  # noqa: E731
        risen = self.objective(by_member(returns)) - self.objective(by_member(state.returns))
        return risen / jnp.maximum(state.weight, jnp.finfo(risen.dtype).tiny)
