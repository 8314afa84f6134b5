r"""Embed to control: a latent state of pictures in which the dynamics are locally linear, and regulators there (Watter et al. 2015).

An encoder $q(z \mid x) = N(\mu, \Sigma)$ with diagonal $\Sigma$, a decoder $p(x \mid z)$, and dynamics that a network of z writes out,

$$z' = A(z) z + B(z) u + o(z), \qquad A = I + v r^\top,$$

so that $\hat q(z' \mid z, u) = N(A \mu + B u + o,\ A \Sigma A^\top)$. What is minimised over transitions (x, u, x') is

$$E\big[-\log p(x \mid z) - \log p(x' \mid \hat z')\big] + KL\big(q(z \mid x) \,\Vert\, N(0, I)\big)
+ \lambda\, KL\big(\hat q(z' \mid z, u) \,\Vert\, q(z' \mid x')\big),$$

whose last term makes what is predicted agree with what is seen. All divergences are in closed form: $\det A = 1 + r^\top v$ and the
diagonal of $A \Sigma A^\top$ need no matrix. To act is to encode, to plan from $\mu$ by iterated regulators with the cost $|z - z_g|^2$
plus a price of actions, and to do the first action; $z_g$ encodes the picture of the goal.

Deviations from the paper: nobody gives a picture of the goal, and so it is the one with the greatest reward that was seen in training
(rewards are used for nothing else); pictures are Gaussian with a fixed deviation in place of Bernoulli; dense networks; the transition
noise H is 0, as in the paper's own divergence.

Source: notes 8.3.4, reference 11.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from ..core import (
    Action,
    Batch,
    EnvSpec,
    Model,
    Number,
    Observation,
    Policy,
    PRNGKey,
    Spec,
    number,
    part,
    setting,
)
from ..nn import Optimiser, RunningNorm, flat_size, flatten_observation
from ..ops.distributions import DiagGaussian
from ..planning.mpc import ILQR, Planner
from .latent import Dense
from .planned import ModelLearner, encode_action, gaussian, planning, scaled

LEAST_STD = 1e-3
"""Of the encoder's Gaussian."""


class LocallyLinear(eqx.Module):
    """z' = z + v (r . z) + B u + o: the numbers of one point."""

    v: Float[Array, "L"]
    r: Float[Array, "L"]
    B: Float[Array, "L A"]
    o: Float[Array, "L"]

    @property
    def A(self) -> Float[Array, "L L"]:
        """I + v r^T."""
        return jnp.eye(len(self.v)) + self.v[:, None] * self.r[None]

    def __call__(self, z: Float[Array, "L"], u: Float[Array, "A"]) -> Float[Array, "L"]:
        return z + self.v * (self.r @ z) + self.B @ u + self.o


def predicted_kl(law: DiagGaussian, line: LocallyLinear, u: Float[Array, "A"], seen: DiagGaussian) -> Float[Array, ""]:
    """KL(N(A mu + B u + o, A Sigma A^T) || seen) of q(z | x) = N(mu, Sigma) = `law`, in time linear in L. Infinite where A is singular."""
    variance, target = law.std**2, seen.std**2
    v, r = line.v, line.r
    spread = variance + 2.0 * v * r * variance + v**2 * jnp.sum(r**2 * variance)
    gap = line(law.mean, u) - seen.mean
    log_det = 2.0 * jnp.sum(law.log_std) + 2.0 * jnp.log(jnp.abs(1.0 + r @ v))
    return 0.5 * (jnp.sum((spread + gap**2) / target) - len(v) + 2.0 * jnp.sum(seen.log_std) - log_det)


class E2CNetworks(eqx.Module):
    """Encoder, decoder, and the network that writes the dynamics about a point."""

    encoder: Dense
    decoder: Dense
    dynamics: Dense

    def encode(self, x: Float[Array, "O"]) -> DiagGaussian:
        """q(z | x)."""
        return gaussian(self.encoder(x), LEAST_STD)

    def about(self, z: Float[Array, "L"]) -> LocallyLinear:
        """A, B and o at z."""
        size = len(z)
        v, r, o, B = jnp.split(self.dynamics(z), [size, 2 * size, 3 * size])
        return LocallyLinear(v, r, B.reshape(size, -1), o)


class E2CTerms(eqx.Module):
    """The terms of the bound, for one transition or as means: squared errors summed over entries, and divergences in nats."""

    observation: Float[Array, "..."]
    next_observation: Float[Array, "..."]
    prior_kl: Float[Array, "..."]
    consistency_kl: Float[Array, "..."]


def e2c_terms(
    networks: E2CNetworks, x: Float[Array, "O"], u: Float[Array, "A"], following: Float[Array, "O"], key: PRNGKey
) -> E2CTerms:
    """The terms of one transition, with one sample of z."""
    law, seen = networks.encode(x), networks.encode(following)
    z = law.sample(key)
    line = networks.about(z)
    return E2CTerms(
        observation=jnp.sum((networks.decoder(z) - x) ** 2),
        next_observation=jnp.sum((networks.decoder(line(z, u)) - following) ** 2),
        prior_kl=law.kl(DiagGaussian(jnp.zeros_like(z), jnp.zeros_like(z))),
        consistency_kl=predicted_kl(law, line, u, seen),
    )


class E2CModel(Model):
    """What has been learned as a `Model` to plan in: states are latents `[L]`, rewards minus squared latent distances to the goal's."""

    networks: E2CNetworks
    observations: RunningNorm
    goal: Float[Array, "L"]
    action_cost: Float[Array, ""]
    observation: Spec = eqx.field(static=True)
    action: Spec = eqx.field(static=True)

    def encode(self, observation: Observation) -> Float[Array, "L"]:
        return self.networks.encode(flatten_observation(self.observation, self.observations(observation))).mean

    def transition(self, state: Float[Array, "L"], action: Action, key: PRNGKey) -> Float[Array, "L"]:
        del key
        return self.networks.about(state)(state, encode_action(self.action, action))

    def reward(self, state: Float[Array, "L"], action: Action, next_state: Float[Array, "L"]) -> Float[Array, ""]:
        del state
        price = self.action_cost * jnp.sum(encode_action(self.action, action) ** 2)
        return -jnp.sum((next_state - self.goal) ** 2) - price

    def terminal(self, state: Float[Array, "L"]) -> Bool[Array, ""]:
        return jnp.zeros((), bool)


class E2CState(eqx.Module):
    """The networks, what standardises, the goal's observation and its reward, the optimiser, and the number of gradient steps done."""

    networks: E2CNetworks
    observations: RunningNorm
    goal: Observation
    goal_reward: Float[Array, ""]
    optimiser: optax.OptState
    updates: Int[Array, ""]
    spec: EnvSpec = eqx.field(static=True)


class E2C(ModelLearner):
    """Learn a latent state with locally linear dynamics from transitions, and act by regulators towards the goal's latent. Boxes alone.

    An observation must tell the state, and the reward must be greatest at the goal.
    """

    latent_size: int = setting(2, "L: numbers in the latent state", at_least=1)
    encoder_sizes: tuple[int, ...] = setting((128, 128), "hidden layers of the encoder, and of the decoder in reverse")
    sizes: tuple[int, ...] = setting((64, 64), "hidden layers of the network of A, B and o")
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    observation_scale: Number = number(0.3, "deviation of the observation", above=0)
    consistency: Number = number(5.0, "lambda: weight of the divergence between predicted and encoded", at_least=0)
    action_cost: Number = number(0.01, "price of a squared action, in half-widths of the box", at_least=0)
    gamma: Number = number(1.0, "discount of a plan's costs", at_least=0, at_most=1)
    noise: Number = number(0.3, "exploration: deviation of noise on actions, in half-widths of the box", at_least=0)
    planner: Planner = part(ILQR(iterations=10), "how the actions are found")
    horizon: int = setting(20, "H: actions in a plan", at_least=1)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)

    @property
    def batch(self) -> Literal["transitions"]:
        return "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("box",)

    def init(self, spec: EnvSpec, key: PRNGKey) -> E2CState:
        seen, actions = flat_size(spec.observation), spec.action.size
        size, keys = self.latent_size, jax.random.split(key, 3)
        networks = E2CNetworks(
            Dense.of(seen, self.encoder_sizes, 2 * size, keys[0]),
            Dense.of(size, self.encoder_sizes[::-1], seen, keys[1], 0.1),
            Dense.of(size, self.sizes, size * (3 + actions), keys[2], 0.1),
        )
        return E2CState(
            networks,
            RunningNorm.of(spec.observation),
            spec.observation.zeros(),
            jnp.full((), jnp.finfo(jnp.float32).min),
            Optimiser(0.0, 1.0).init(networks),
            jnp.zeros((), jnp.int32),
            spec,
        )

    def model(self, state: E2CState) -> E2CModel:
        """What has been learned, as a model to plan in."""
        price = jnp.asarray(self.at(state.updates).action_cost, jnp.float32)
        size = jnp.zeros(self.latent_size)
        model = E2CModel(state.networks, state.observations, size, price, state.spec.observation, state.spec.action)
        return eqx.tree_at(lambda m: m.goal, model, model.encode(state.goal))

    def policy(self, state: E2CState, explore: bool) -> Policy:
        now = self.at(state.updates)
        return planning(now, self.model(state), state.spec.action, explore, state.updates == 0, now.noise)

    def update(self, state: E2CState, batch: Batch, key: PRNGKey) -> tuple[E2CState, dict[str, Array], Any]:
        now, t, spec = self.at(state.updates), batch.transitions, state.spec
        observations = state.observations.update(t.observation)
        vector = lambda o: flatten_observation(spec.observation, observations(o))  # noqa: E731
        before, after = jax.vmap(vector)(t.observation), jax.vmap(vector)(t.next_observation)
        actions = jax.vmap(lambda a: encode_action(spec.action, a))(t.action)
        best = jnp.argmax(t.reward)
        nearer = t.reward[best] > state.goal_reward
        goal = jax.tree.map(lambda new, old: jnp.where(nearer, new[best], old), t.next_observation, state.goal)
        keys = jax.random.split(key, len(actions))
        weights = batch.weights / jnp.maximum(batch.weights.sum(), 1e-8)

        def loss(networks: E2CNetworks) -> tuple[Float[Array, ""], E2CTerms]:
            each = jax.vmap(lambda *now: e2c_terms(networks, *now))(before, actions, after, keys)
            terms = jax.tree.map(lambda x: (weights * x).sum(), each)
            total = scaled(terms.observation + terms.next_observation, now.observation_scale) + terms.prior_kl
            return total + jnp.asarray(now.consistency, jnp.float32) * terms.consistency_kl, terms

        networks, optimiser, value, terms = now.descended(loss, state.networks, state.optimiser)
        metrics = {
            "model_loss": value,
            "prior_kl": terms.prior_kl,
            "consistency_kl": terms.consistency_kl,
            "observation_error": terms.observation / before.shape[-1],
            "next_observation_error": terms.next_observation / before.shape[-1],
        }
        reached = jnp.maximum(state.goal_reward, t.reward[best])
        return E2CState(networks, observations, goal, reached, optimiser, state.updates + 1, spec), metrics, ()
