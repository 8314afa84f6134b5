r"""Learned dynamics that know what they do not know: an ensemble of probabilistic networks (notes 8.3.3; Chua et al. 2018).

Every member e says of the change of the state and of the reward, both standardised,

$$p_e(y \mid s, a) = N(\mu_e(s, a), \operatorname{diag} \sigma_e^2(s, a)), \qquad y = (s' - s, r),$$

and how likely the episode ends. Their mixture has the variance

$$\operatorname{Var} y = \underbrace{\tfrac1E \sum_e \sigma_e^2}_{\text{aleatoric}} + \underbrace{\operatorname{Var}_e
\mu_e}_{\text{epistemic}}$$

(erratum E8.14: variances are averaged, not samples). The members differ by their first weights and by their data: member e sees a sample
as often as a Poisson variable of mean 1 says, which is the bootstrap in the limit of much data, and here depends on nothing but the
place of the sample in the replay, so that nothing has to be stored.

Planning (item 8.61): particles carry the state, each by one member for the whole rollout (TS-infinity) or by another at each step (TS1),
and the
reward is the mean of theirs: J = 1/N sum_i sum_t r(s_{t,i}, a_t) with shared actions.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..core import Action, Model, Observation, PRNGKey, Spec
from ..nn import RunningNorm, flatten_observation
from ..nn.network import Linear

LEAST_LOG_VARIANCE, MOST_LOG_VARIANCE = -10.0, 0.5
"""Bounds of the logarithm of a member's variance, of standardised quantities; approached smoothly."""
POISSON = (0.36787944, 0.73575888, 0.91969860, 0.98101184, 0.99634015, 0.99940582)
"""Distribution function of a Poisson variable of mean 1."""


class Prediction(eqx.Module):
    """What the members say of standardised targets: mean and log variance `[E, N, D]`, and the logit of an end `[E, N]`."""

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
    prediction: Prediction, targets: Float[Array, "N D"], probabilistic: bool = True
) -> Float[Array, "E N"]:
    """1/2 [(y - mu)^2 / sigma^2 + log sigma^2] summed over the targets (item 8.53); without `probabilistic` half the squared error."""
    error = (targets[None] - prediction.mean) ** 2
    if not probabilistic:
        return 0.5 * error.sum(-1)
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


class Belief(eqx.Module):
    """Where a rollout through the ensemble stands: particles `[E, K, O]`, the reward that led here, and the chance that it goes on."""

    particles: Float[Array, "E K O"]
    reward: Float[Array, ""]
    alive: Float[Array, "E K"]


class LearnedModel(Model):
    """An ensemble as a `Model` to plan in.

    - `particles`: K for each member.
    - `propagation`: `"tsinf"` keeps a particle with its member for the whole rollout, `"ts1"` shuffles them over the members at each step
      (item 8.62), `"mean"` follows the members' means without noise.
    - `risk`: kappa: the reward is the mean over members less kappa times their standard deviation; 0 plans on what is expected, more is
      pessimistic and less than 0 optimistic (item 8.51).
    """

    ensemble: Ensemble
    inputs: RunningNorm
    targets: RunningNorm
    risk: Float[Array, ""]
    observation: Spec = eqx.field(static=True)
    action: Spec = eqx.field(static=True)
    particles: int = eqx.field(static=True, default=1)
    propagation: Literal["tsinf", "ts1", "mean"] = eqx.field(static=True, default="tsinf")

    @property
    def members(self) -> int:
        """E."""
        return self.ensemble.layers[0].bias.shape[0]

    def encode(self, observation: Observation) -> Belief:
        flat = flatten_observation(self.observation, observation)
        shape = (self.members, self.particles)
        return Belief(jnp.broadcast_to(flat, (*shape, flat.size)), jnp.zeros(()), jnp.ones(shape))

    def predict(self, states: Float[Array, "E N O"], actions: Float[Array, "E N A"]) -> Prediction:
        """The members' words on states and encoded actions of their own."""
        return self.ensemble(jax.vmap(jax.vmap(self.inputs))(jnp.concatenate([states, actions], -1)))

    def transition(self, state: Belief, action: Action, key: PRNGKey) -> Belief:
        noise_key, order_key = jax.random.split(key)
        particles, alive = state.particles, state.alive
        encoded = encode_action(self.action, action)
        said = self.predict(particles, jnp.broadcast_to(encoded, (*alive.shape, encoded.size)))
        y = said.mean
        if self.propagation != "mean":
            y = y + jnp.exp(0.5 * said.log_variance) * jax.random.normal(noise_key, y.shape)
        y = self.targets.mean[""][None, None] + self.targets.sd()[None, None] * y
        rewards = alive * y[..., -1]
        by_member = rewards.mean(1)
        reward = rewards.mean() - self.risk * by_member.std()
        particles, alive = particles + y[..., :-1], alive * jax.nn.sigmoid(-said.end)
        if self.propagation == "ts1":
            order = jax.random.permutation(order_key, alive.size)
            shuffle = lambda x: x.reshape(alive.size, *x.shape[2:])[order].reshape(x.shape)  # noqa: E731
            particles, alive = shuffle(particles), shuffle(alive)
        return Belief(particles, reward, alive)

    def reward(self, state: Belief, action: Action, next_state: Belief) -> Float[Array, ""]:
        del state, action
        return next_state.reward

    def terminal(self, state: Belief) -> Bool[Array, ""]:
        # Ends are weighed, particle by particle.
        return state.alive.max() < 1e-3


def encode_action(spec: Spec, action: Action) -> Float[Array, "A"]:
    """An action as a vector: a box clipped and in units of itself where it is bounded, choices as one-hot vectors."""
    if spec.kind == "box":
        clipped = spec.clip(action)
        if not spec.is_bounded:
            return clipped.ravel()
        low, high = (jnp.asarray(bound, jnp.float32) for bound in spec.bounds())
        return ((clipped - low) / (high - low) * 2.0 - 1.0).ravel()
    if spec.kind == "multi_binary":
        return action.astype(jnp.float32).ravel()
    counts, choices = spec.counts, jnp.atleast_1d(action.ravel())
    return jnp.concatenate([jax.nn.one_hot(choices[i], n) for i, n in enumerate(counts)])
