r"""Model-based reinforcement learning with latent states (notes 8.3.4, Algorithm 22): plan in what a network makes of the observations.

    collect at random;  repeat { fit g, f, r, d to all data;  for N steps { s = g(o);  plan from s;  act;  append (o, a, r, o') } }

Four models are learned together: the encoder $s_t = g_\psi(o_t)$, the dynamics $p(s_{t+1} \mid s_t, a_t) = N(s_t + f(s_t, a_t),
\sigma_s^2)$, the reward $p(r_t \mid s_t, a_t) = N(r(s_t, a_t), \sigma_r^2)$ and the observation $p(o_t \mid s_t) = N(d(s_t),
\sigma_o^2)$. What is maximised is

$$\sum_t \log p\big(g(o_{t+1}) \mid g(o_t), a_t\big) + \log p\big(o_t \mid g(o_t)\big) + \log p\big(r_t \mid g(o_t), a_t\big),$$

whose last term the notes leave out, although they list the model. As printed, with variances that are learned, it has no maximum:
an encoder that shrinks by k gains -log k for each latent number and step while the decoder undoes it (erratum E8.17). Here the
variances are fixed and the latents are standardised, each to mean 0 and variance 1 over the batch (as in batch normalisation;
running values when acting), so that shrinking changes nothing.

The observation must tell the state, as the last two pictures of a pendulum do and one does not (erratum E8.18; item 8.72): the
encoder is $q(s_t \mid o_t)$, deterministic.

Deviations: the dynamics are followed for several steps from the first encoding of a sequence, $\hat s_{t+1} = \hat s_t + f(\hat
s_t, a_t)$, and compared with each $g(o_{t+1})$, because plans are long; `--loop.length 1` is the printed objective. Observations
are decoded from the followed states as well. The end of an episode is predicted beside the reward.

Source: notes 8.3.4, Algorithm 22, with errata E8.12 (nesting of the loops), E8.17 and E8.18.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ..core import (
    Action,
    Batch,
    EnvSpec,
    Number,
    Observation,
    Policy,
    PRNGKey,
    Spec,
    number,
    part,
    setting,
)
from ..nn import Linear, Optimiser, RunningNorm, flat_size, flatten_observation
from ..planning.mpc import CrossEntropy, Planner
from .fit import standards
from .planned import Imagining, ModelLearner, encode_action, encoded_size, planning, scaled, standardised_rewards

DECAY = 0.99
"""Of the running mean and variance of the latents."""


class Dense(eqx.Module):
    """Dense layers with SiLU between them."""

    layers: tuple[Linear, ...]

    @staticmethod
    def of(inputs: int, sizes: tuple[int, ...], outputs: int, key: PRNGKey, gain: float = 1.0) -> "Dense":
        """Fresh layers."""
        widths = (inputs, *sizes, outputs)
        gains = [2.0**0.5] * len(sizes) + [gain]
        keys = jax.random.split(key, len(gains))
        return Dense(tuple(Linear.of(widths[i], widths[i + 1], keys[i], gains[i]) for i in range(len(gains))))

    def __call__(self, x: Float[Array, "I"]) -> Float[Array, "D"]:
        for layer in self.layers[:-1]:
            x = jax.nn.silu(layer(x))
        return self.layers[-1](x)


class LatentNetworks(eqx.Module):
    """The four models: encoder g, change of the latent state f, reward and logit of an end, and decoder d."""

    encoder: Dense
    change: Dense
    outcome: Dense
    decoder: Dense


class Latents(eqx.Module):
    """Running mean and variance of what the encoder gives, before it is standardised, and how many batches they have seen."""

    mean: Float[Array, "L"]
    variance: Float[Array, "L"]
    count: Int[Array, ""]

    def update(self, raw: Float[Array, "N L"]) -> "Latents":
        """With another batch."""
        keep = jnp.where(self.count == 0, 0.0, DECAY)
        blend = lambda old, new: keep * old + (1.0 - keep) * new  # noqa: E731
        return Latents(blend(self.mean, raw.mean(0)), blend(self.variance, raw.var(0)), self.count + 1)


def standardised(raw: Float[Array, "... L"], mean: Float[Array, "L"], variance: Float[Array, "L"]) -> Array:
    """In units of the deviation."""
    lift = lambda x: x.reshape((1,) * (raw.ndim - 1) + x.shape)  # noqa: E731
    return (raw - lift(mean)) / jnp.sqrt(lift(variance) + 1e-10)


class Imagined(eqx.Module):
    """Where a rollout in latent space stands: the state `[L]`, the reward that led here, and the chance that it goes on."""

    latent: Float[Array, "L"]
    reward: Float[Array, ""]
    alive: Float[Array, ""]


class LatentModel(Imagining):
    """Encoder, dynamics and rewards as a `Model` to plan in. Transitions are the means."""

    networks: LatentNetworks
    latents: Latents
    observations: RunningNorm
    rewards: RunningNorm
    observation: Spec = eqx.field(static=True)
    action: Spec = eqx.field(static=True)

    def vector(self, observation: Observation) -> Float[Array, "O"]:
        """What the encoder reads and the decoder writes: pictures in [0, 1], other numbers standardised."""
        return flatten_observation(self.observation, self.observations(observation))

    def encode(self, observation: Observation) -> Imagined:
        raw = self.networks.encoder(self.vector(observation))
        latent = standardised(raw, self.latents.mean, self.latents.variance)
        return Imagined(latent, jnp.zeros(()), jnp.ones(()))

    def decode(self, state: Imagined) -> Float[Array, "O"]:
        """The mean of p(o | s), as `vector` has it."""
        return self.networks.decoder(state.latent)

    def transition(self, state: Imagined, action: Action, key: PRNGKey) -> Imagined:
        del key
        following, outcome = followed(self.networks, state.latent, encode_action(self.action, action))
        reward = self.rewards.mean[""][0] + self.rewards.sd()[0] * outcome[0]
        return Imagined(following, state.alive * reward, state.alive * jax.nn.sigmoid(-outcome[1]))


def followed(
    networks: LatentNetworks, latent: Float[Array, "L"], action: Float[Array, "A"]
) -> tuple[Float[Array, "L"], Float[Array, "2"]]:
    """Mean of p(s' | s, a); mean of p(r | s, a), standardised, and the logit of an end."""
    both = jnp.concatenate([latent, action])
    return latent + networks.change(both), networks.outcome(both)


class Terms(eqx.Module):
    """Mean squared errors, each over steps and summed over entries: of followed latents, rewards, observations; and the end's entropy."""

    latent: Float[Array, ""]
    reward: Float[Array, ""]
    observation: Float[Array, ""]
    end: Float[Array, ""]


def sequence_terms(
    networks: LatentNetworks,
    vectors: Float[Array, "P N O"],
    actions: Float[Array, "T N A"],
    rewards: Float[Array, "T N"],
    ended: Float[Array, "T N"],
    cut: Float[Array, "T N"],
    weights: Float[Array, "N"],
    standardise: bool = True,
) -> tuple[Terms, Float[Array, "P N L"]]:
    """The terms of the objective on sequences: P = T + 1 observations, T actions between them; and the encoder's raw output.

    - `cut`: 1 where the step's next observation is of another episode. Nothing after it counts.
    - `weights`: of the sequences.
    - `standardise`: the latents, over the batch. Without, this is the objective as it is printed, which shrinking the latents improves.
    """
    # Standardising takes the last bias off again: its gradient is rounding alone, which Adam would make steps of.
    still = eqx.tree_at(lambda e: e.layers[-1].bias, networks.encoder, replace_fn=jax.lax.stop_gradient)
    raw = jax.vmap(jax.vmap(still))(vectors)
    flat = raw.reshape(-1, raw.shape[-1])
    latents = standardised(raw, flat.mean(0), flat.var(0)) if standardise else raw
    over = jnp.cumsum(jnp.concatenate([jnp.zeros_like(cut[:1]), cut]), 0)
    counted = (over == 0) * weights[None]
    before, after = counted[:-1], counted[1:]

    def step(latent: Array, action: Array) -> tuple[Array, tuple[Array, Array]]:
        following, outcome = jax.vmap(lambda s, a: followed(networks, s, a))(latent, action)
        return following, (following, outcome)

    _, (reached, outcomes) = jax.lax.scan(step, latents[0], actions)
    decode = jax.vmap(jax.vmap(networks.decoder))
    mean = lambda value, weight: (value * weight).sum() / jnp.maximum(weight.sum(), 1.0)  # noqa: E731
    square = lambda a, b: ((a - b) ** 2).sum(-1)  # noqa: E731
    observation = mean(square(decode(latents), vectors), counted) + mean(square(decode(reached), vectors[1:]), after)
    terms = Terms(
        latent=mean(square(reached, latents[1:]), after),
        reward=mean((outcomes[..., 0] - rewards) ** 2, before),
        observation=0.5 * observation,
        end=mean(optax.sigmoid_binary_cross_entropy(outcomes[..., 1], ended), before),
    )
    return terms, raw


class LatentState(eqx.Module):
    """The networks, what standardises, the optimiser, and the number of gradient steps done."""

    networks: LatentNetworks
    latents: Latents
    observations: RunningNorm
    rewards: RunningNorm
    optimiser: optax.OptState
    updates: Int[Array, ""]
    spec: EnvSpec = eqx.field(static=True)


class LatentMBRL(ModelLearner):
    """Learn a latent state, its dynamics and rewards from sequences of observations, and act by planning from g(o).

    Any actions but binary ones. An observation must tell the state: stack pictures.
    """

    latent_size: int = setting(8, "L: numbers in the latent state", at_least=1)
    encoder_sizes: tuple[int, ...] = setting((128, 128), "hidden layers of the encoder, and of the decoder in reverse")
    sizes: tuple[int, ...] = setting((128, 128), "hidden layers of the dynamics and of the rewards")
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    latent_scale: Number = number(0.3, "sigma_s: deviation of the dynamics, of standardised latents", above=0)
    observation_scale: Number = number(1.0, "sigma_o: deviation of the observation", above=0)
    reward_scale: Number = number(0.3, "sigma_r: deviation of the reward, standardised", above=0)
    gamma: Number = number(1.0, "discount of a plan's rewards", at_least=0, at_most=1)
    noise: Number = number(
        0.1, "exploration: deviation of noise on actions, in half-widths of the box; discrete: chance of a random one",
        at_least=0,
    )  # fmt: skip
    planner: Planner = part(CrossEntropy(samples=80, elites=8, iterations=3), "how the actions are found")
    horizon: int = setting(15, "H: actions in a plan", at_least=1)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)

    @property
    def batch(self) -> Literal["sequences"]:
        return "sequences"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete", "multi_discrete", "box")

    def init(self, spec: EnvSpec, key: PRNGKey) -> LatentState:
        seen, actions = flat_size(spec.observation), encoded_size(spec.action)
        size, keys = self.latent_size, jax.random.split(key, 4)
        networks = LatentNetworks(
            Dense.of(seen, self.encoder_sizes, size, keys[0]),
            Dense.of(size + actions, self.sizes, size, keys[1], 0.1),
            Dense.of(size + actions, self.sizes, 2, keys[2], 0.1),
            Dense.of(size, self.encoder_sizes[::-1], seen, keys[3], 0.1),
        )
        return LatentState(
            networks,
            Latents(jnp.zeros(size), jnp.ones(size), jnp.zeros((), jnp.int32)),
            RunningNorm.of(spec.observation),
            standards(1),
            Optimiser(0.0, 1.0).init(networks),
            jnp.zeros((), jnp.int32),
            spec,
        )

    def model(self, state: LatentState) -> LatentModel:
        """What has been learned, as a model to plan in."""
        return LatentModel(
            state.networks, state.latents, state.observations, state.rewards, state.spec.observation, state.spec.action
        )

    def policy(self, state: LatentState, explore: bool) -> Policy:
        now = self.at(state.updates)
        return planning(now, self.model(state), state.spec.action, explore, state.updates == 0, now.noise)

    def update(self, state: LatentState, batch: Batch, key: PRNGKey) -> tuple[LatentState, dict[str, Array], Any]:
        del key
        now, t, spec = self.at(state.updates), batch.transitions, state.spec
        observations = state.observations.update(t.observation)
        rewards = state.rewards.update(t.reward.reshape(-1, 1))
        model = self.model(state)
        model = eqx.tree_at(lambda m: m.observations, model, observations)
        last = jax.tree.map(lambda x: x[-1:], t.next_observation)
        seen = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), t.observation, last)
        vectors = jax.vmap(jax.vmap(model.vector))(seen)
        actions = jax.vmap(jax.vmap(lambda a: encode_action(spec.action, a)))(t.action)
        wanted = standardised_rewards(rewards, t.reward)
        ended = t.terminated.astype(jnp.float32)
        # The last step's next observation is its own, whatever ended there; but an end has no state to be compared with.
        cut = (t.terminated | t.truncated).astype(jnp.float32).at[-1].set(ended[-1])

        def loss(networks: LatentNetworks) -> tuple[Float[Array, ""], tuple[Terms, Array]]:
            terms, raw = sequence_terms(networks, vectors, actions, wanted, ended, cut, batch.weights)
            total = scaled(terms.latent, now.latent_scale) + scaled(terms.observation, now.observation_scale)
            return total + scaled(terms.reward, now.reward_scale) + terms.end, (terms, raw)

        networks, optimiser, value, (terms, raw) = now.descended(loss, state.networks, state.optimiser)
        latents = state.latents.update(raw.reshape(-1, raw.shape[-1]))
        spread = standardised(raw, latents.mean, latents.variance).reshape(-1, raw.shape[-1]).std(0)
        metrics = {
            "model_loss": value,
            "latent_error": terms.latent / self.latent_size,
            "reward_error": terms.reward,
            "observation_error": terms.observation / vectors.shape[-1],
            "latent_std": spread.min(),
        }
        state = LatentState(networks, latents, observations, rewards, optimiser, state.updates + 1, spec)
        return state, metrics, ()
