r"""PlaNet: a latent model with a memory, learned by a variational bound, and planning in it (Hafner et al. 2019; notes 8.3.4).

The state is a pair: a deterministic memory $h_t$ and a random $s_t$,

$$h_t = f(h_{t-1}, s_{t-1}, a_{t-1}), \quad s_t \sim p(s_t \mid h_t), \quad o_t \sim p(o_t \mid h_t, s_t), \quad
r_{t-1} \sim p(r \mid h_t, s_t),$$

and the encoder is a filter, $q(s_t \mid h_t, o_t)$ with $h_t$ made of everything before: one picture need not tell the state (item 8.67).
What is maximised is the bound of the notes with the encoder's entropy, in its KL form (erratum E8.17), and with the reward,

$$\sum_t E_q\big[\log p(o_t \mid h_t, s_t) + \log p(r_{t-1} \mid h_t, s_t)\big] -
\max\big(D_{KL}(q(s_t \mid h_t, o_t) \,\Vert\, p(s_t \mid h_t)),\ \text{free nats}\big).$$

The bound cannot grow by shrinking the latents, and the free nats keep the encoder from saying nothing at all. Acting filters, and the
cross-entropy method plans in the model from the filtered state at every step.

Deviations from the paper: dense networks on the flattened picture; imagined states follow the prior's mean unless `sampled`; no
overshooting; the reward is standardised; the end of an episode is predicted too. Sequences begin with an empty memory, as there.
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
    Carry,
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
from ..ops.distributions import DiagGaussian
from ..planning.mpc import CrossEntropy, Planner, shifted
from ..planning.problem import ModelProblem
from .fit import standards
from .latent import Dense
from .planned import (
    Imagining,
    ModelLearner,
    encode_action,
    encoded_size,
    explored,
    gaussian,
    scaled,
    standardised_rewards,
)

LEAST_STD = 0.1
"""Of the random state, as in PlaNet."""


class Cell(eqx.Module):
    """A gated recurrent unit (Cho et al. 2014)."""

    inputs: Linear
    memory: Linear

    @staticmethod
    def of(inputs: int, size: int, key: PRNGKey) -> "Cell":
        """Fresh weights."""
        first, second = jax.random.split(key)
        return Cell(Linear.of(inputs, 3 * size, first, 1.0), Linear.of(size, 3 * size, second, 1.0))

    def __call__(self, hidden: Float[Array, "M"], x: Float[Array, "I"]) -> Float[Array, "M"]:
        (gate, reset, content), (gate_past, reset_past, past) = (
            jnp.split(self.inputs(x), 3),
            jnp.split(self.memory(hidden), 3),
        )
        update = jax.nn.sigmoid(gate + gate_past)
        candidate = jnp.tanh(content + jax.nn.sigmoid(reset + reset_past) * past)
        return update * hidden + (1.0 - update) * candidate


class StateSpace(eqx.Module):
    """The recurrent state-space model: cell f, prior, posterior (the encoder), decoder, and reward with the logit of an end."""

    cell: Cell
    prior: Dense
    encoder: Dense
    posterior: Dense
    decoder: Dense
    outcome: Dense

    def step(
        self, memory: Float[Array, "M"], state: Float[Array, "S"], action: Float[Array, "A"]
    ) -> tuple[Float[Array, "M"], DiagGaussian]:
        """h_t, and p(s_t | h_t)."""
        memory = self.cell(memory, jnp.concatenate([state, action]))
        return memory, gaussian(self.prior(memory), LEAST_STD)

    def filtered(self, memory: Float[Array, "M"], code: Float[Array, "E"]) -> DiagGaussian:
        """q(s_t | h_t, o_t), of what `encoder` made of o_t."""
        return gaussian(self.posterior(jnp.concatenate([memory, code])), LEAST_STD)

    def shown(self, memory: Float[Array, "M"], state: Float[Array, "S"]) -> tuple[Float[Array, "O"], Float[Array, "2"]]:
        """Mean of the observation; standardised reward that led here, and the logit of an end."""
        both = jnp.concatenate([memory, state])
        return self.decoder(both), self.outcome(both)


class Bound(eqx.Module):
    """The terms of the bound, each a mean over steps: squared errors of observations (summed over entries) and rewards, KL, end."""

    observation: Float[Array, ""]
    reward: Float[Array, ""]
    kl: Float[Array, ""]
    limited_kl: Float[Array, ""]
    end: Float[Array, ""]


def sequence_bound(
    model: StateSpace,
    before: Float[Array, "T N O"],
    after: Float[Array, "T N O"],
    actions: Float[Array, "T N A"],
    rewards: Float[Array, "T N"],
    ended: Float[Array, "T N"],
    done: Bool[Array, "T N"],
    weights: Float[Array, "N"],
    free_nats: Float[Array, ""],
    key: PRNGKey,
) -> Bound:
    """The terms on sequences of transitions: `before` and `after` each action, before any reset; memories begin anew after `done`."""
    first_key, later_key = jax.random.split(key)
    memory_size = model.cell.memory.weight.shape[1]
    steps, count = rewards.shape
    empty = jnp.zeros(memory_size)
    codes_before, codes_after = (jax.vmap(jax.vmap(model.encoder))(x) for x in (before, after))
    start_law = gaussian(model.prior(empty), LEAST_STD)

    def beginning(code: Array, k: PRNGKey) -> tuple[Array, Array]:
        law = model.filtered(empty, code)
        return law.sample(k), law.kl(start_law)

    starts, start_kl = jax.vmap(jax.vmap(beginning))(codes_before, jax.random.split(first_key, (steps, count)))
    begins = jnp.concatenate([jnp.ones((1, count), bool), done[:-1]])

    def one(
        memory: Array, state: Array, start: Array, begin: Array, action: Array, code: Array, k: PRNGKey
    ) -> tuple[Array, Array, Array]:
        memory, state = jnp.where(begin, empty, memory), jnp.where(begin, start, state)
        memory, prior = model.step(memory, state, action)
        law = model.filtered(memory, code)
        return memory, law.sample(k), law.kl(prior)

    def scan(carry: tuple[Array, Array], now: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        memory, state, kl = jax.vmap(one)(*carry, *now)
        return (memory, state), (memory, state, kl)

    fresh = (jnp.zeros((count, memory_size)), starts[0])
    inputs = (starts, begins, actions, codes_after, jax.random.split(later_key, (steps, count)))
    _, (memories, states, kl) = jax.lax.scan(scan, fresh, inputs)
    seen, outcomes = jax.vmap(jax.vmap(model.shown))(memories, states)
    seen_first = jax.vmap(jax.vmap(lambda s: model.shown(empty, s)[0]))(starts)
    square = lambda a, b: ((a - b) ** 2).sum(-1)  # noqa: E731
    opening, counted = begins * weights[None], jnp.broadcast_to(weights[None], (steps, count))
    total = opening.sum() + counted.sum()
    both = lambda first, later: ((opening * first).sum() + (counted * later).sum()) / jnp.maximum(total, 1.0)  # noqa: E731
    mean = lambda value: (counted * value).sum() / jnp.maximum(counted.sum(), 1.0)  # noqa: E731
    return Bound(
        observation=both(square(seen_first, before), square(seen, after)),
        reward=mean((outcomes[..., 0] - rewards) ** 2),
        kl=both(start_kl, kl),
        limited_kl=both(jnp.maximum(start_kl, free_nats), jnp.maximum(kl, free_nats)),
        end=mean(optax.sigmoid_binary_cross_entropy(outcomes[..., 1], ended)),
    )


class Dream(eqx.Module):
    """Where a rollout in the model stands: memory and random state, the reward that led here, and the chance that it goes on."""

    memory: Float[Array, "M"]
    state: Float[Array, "S"]
    reward: Float[Array, ""]
    alive: Float[Array, ""]


class StateSpaceModel(Imagining):
    """The recurrent state-space model as a `Model` to plan in."""

    networks: StateSpace
    observations: RunningNorm
    rewards: RunningNorm
    observation: Spec = eqx.field(static=True)
    action: Spec = eqx.field(static=True)
    sampled: bool = eqx.field(static=True, default=False)

    def vector(self, observation: Observation) -> Float[Array, "O"]:
        """Pictures in [0, 1], other numbers standardised."""
        return flatten_observation(self.observation, self.observations(observation))

    def look(self, memory: Float[Array, "M"], observation: Observation) -> Dream:
        """The filtered state: the mean of q(s_t | h_t, o_t)."""
        law = self.networks.filtered(memory, self.networks.encoder(self.vector(observation)))
        return Dream(memory, law.mode(), jnp.zeros(()), jnp.ones(()))

    def encode(self, observation: Observation) -> Dream:
        return self.look(jnp.zeros(self.networks.cell.memory.weight.shape[1]), observation)

    def transition(self, state: Dream, action: Action, key: PRNGKey) -> Dream:
        memory, law = self.networks.step(state.memory, state.state, encode_action(self.action, action))
        following = law.sample(key) if self.sampled else law.mode()
        outcome = self.networks.outcome(jnp.concatenate([memory, following]))
        reward = self.rewards.mean[""][0] + self.rewards.sd()[0] * outcome[0]
        return Dream(memory, following, state.alive * reward, state.alive * jax.nn.sigmoid(-outcome[1]))


class Remembered(eqx.Module):
    """What `PlaNetPolicy` keeps: h and s of the last step, what was done then, the rest of the plan, and whether this is the first step."""

    memory: Float[Array, "M"]
    state: Float[Array, "S"]
    action: Float[Array, "A"]
    plan: Action
    fresh: Bool[Array, ""]


class PlaNetPolicy(Policy):
    """Filters, plans from the filtered state, adds noise; acts at random while there is nothing to plan with."""

    model: StateSpaceModel
    planner: Planner
    gamma: Float[Array, ""]
    random: Bool[Array, ""]
    noise: Float[Array, ""]
    horizon: int = eqx.field(static=True)

    @property
    def _problem(self) -> ModelProblem:
        return ModelProblem(self.model, self.horizon, self.model.action, self.gamma)

    def init(self, key: PRNGKey) -> Carry:
        del key
        spec, networks = self.model.action, self.model.networks
        zeros = spec.clip(spec.zeros())
        size = networks.decoder.layers[0].weight.shape[1] - networks.cell.memory.weight.shape[1]
        return Remembered(
            jnp.zeros(networks.cell.memory.weight.shape[1]),
            jnp.zeros(size),
            jnp.zeros_like(encode_action(spec, zeros)),
            jnp.broadcast_to(zeros, (self.horizon, *zeros.shape)),
            jnp.ones((), bool),
        )

    def filter(self, carry: Remembered, observation: Observation) -> Dream:
        """The state after a look."""
        moved, _ = self.model.networks.step(carry.memory, carry.state, carry.action)
        return self.model.look(jnp.where(carry.fresh, carry.memory, moved), observation)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        plan_key, random_key, noise_key = jax.random.split(key, 3)
        now, spec = self.filter(carry, observation), self.model.action
        guess = shifted(carry.plan, jnp.where(carry.fresh, 0, 1))
        search = lambda: self.planner(self._problem, now, guess, plan_key).value.actions  # noqa: E731
        plan = jax.lax.cond(self.random, lambda: guess, search)
        action = explored(spec, plan[0], self.random, self.noise, random_key, noise_key)
        kept = Remembered(now.memory, now.state, encode_action(spec, action), plan, jnp.zeros((), bool))
        return kept, action, {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        solution = self.planner(self._problem, self.filter(carry, observation), carry.plan, jax.random.key(0))
        return {"value": -solution.value.cost, "mean": solution.value.actions[0]}


class PlaNetState(eqx.Module):
    """The networks, what standardises, the optimiser, and the number of gradient steps done."""

    networks: StateSpace
    observations: RunningNorm
    rewards: RunningNorm
    optimiser: optax.OptState
    updates: Int[Array, ""]
    spec: EnvSpec = eqx.field(static=True)


class PlaNet(ModelLearner):
    """Learn a recurrent state-space model from sequences, and act by planning in it from a filtered state. Any actions but binary ones."""

    memory_size: int = setting(64, "numbers in the deterministic memory h", at_least=1)
    state_size: int = setting(8, "numbers in the random state s", at_least=1)
    encoder_sizes: tuple[int, ...] = setting((128, 64), "layers of the encoder, and of the decoder in reverse")
    sizes: tuple[int, ...] = setting((64,), "hidden layers of prior, posterior and rewards")
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    observation_scale: Number = number(0.2, "sigma_o: deviation of the observation", above=0)
    reward_scale: Number = number(0.2, "sigma_r: deviation of the reward, standardised", above=0)
    free_nats: Number = number(1.0, "KL divergence of a step that costs no more than a smaller one", at_least=0)
    gamma: Number = number(1.0, "discount of a plan's rewards", at_least=0, at_most=1)
    noise: Number = number(
        0.1, "exploration: deviation of noise on actions, in half-widths of the box; discrete: chance of a random one",
        at_least=0,
    )  # fmt: skip
    planner: Planner = part(CrossEntropy(samples=80, elites=8, iterations=3), "how the actions are found")
    horizon: int = setting(15, "H: actions in a plan", at_least=1)
    sampled: bool = setting(False, "imagined states are drawn from the prior, as in the paper, in place of its mean")
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)

    def __check_init__(self) -> None:
        if not self.encoder_sizes:
            raise ValueError(
                "PlaNet.encoder_sizes needs at least one layer, whose width is that of the code of an observation"
            )

    @property
    def batch(self) -> Literal["sequences"]:
        return "sequences"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete", "multi_discrete", "box")

    def init(self, spec: EnvSpec, key: PRNGKey) -> PlaNetState:
        seen, actions = flat_size(spec.observation), encoded_size(spec.action)
        h, s, code, keys = self.memory_size, self.state_size, self.encoder_sizes[-1], jax.random.split(key, 6)
        networks = StateSpace(
            Cell.of(s + actions, h, keys[0]),
            Dense.of(h, self.sizes, 2 * s, keys[1]),
            Dense.of(seen, self.encoder_sizes[:-1], code, keys[2]),
            Dense.of(h + code, self.sizes, 2 * s, keys[3]),
            Dense.of(h + s, self.encoder_sizes[::-1], seen, keys[4], 0.1),
            Dense.of(h + s, self.sizes, 2, keys[5], 0.1),
        )
        return PlaNetState(
            networks,
            RunningNorm.of(spec.observation),
            standards(1),
            Optimiser(0.0, 1.0).init(networks),
            jnp.zeros((), jnp.int32),
            spec,
        )

    def model(self, state: PlaNetState) -> StateSpaceModel:
        """What has been learned, as a model to plan in."""
        return StateSpaceModel(
            state.networks, state.observations, state.rewards, state.spec.observation, state.spec.action, self.sampled
        )

    def policy(self, state: PlaNetState, explore: bool) -> Policy:
        now, real = self.at(state.updates), lambda x: jnp.asarray(x, jnp.float32)
        random = (state.updates == 0) if explore else jnp.zeros((), bool)
        noise = real(now.noise) if explore else jnp.zeros(())
        return PlaNetPolicy(self.model(state), now.planner, real(now.gamma), random, noise, self.horizon)

    def update(self, state: PlaNetState, batch: Batch, key: PRNGKey) -> tuple[PlaNetState, dict[str, Array], Any]:
        now, t, spec = self.at(state.updates), batch.transitions, state.spec
        observations = state.observations.update(t.observation)
        rewards = state.rewards.update(t.reward.reshape(-1, 1))
        model = eqx.tree_at(lambda m: m.observations, self.model(state), observations)
        before, after = (jax.vmap(jax.vmap(model.vector))(x) for x in (t.observation, t.next_observation))
        actions = jax.vmap(jax.vmap(lambda a: encode_action(spec.action, a)))(t.action)
        wanted = standardised_rewards(rewards, t.reward)
        ended, done = t.terminated.astype(jnp.float32), t.terminated | t.truncated
        free = jnp.asarray(now.free_nats, jnp.float32)

        def loss(networks: StateSpace) -> tuple[Float[Array, ""], Bound]:
            terms = sequence_bound(networks, before, after, actions, wanted, ended, done, batch.weights, free, key)
            total = scaled(terms.observation, now.observation_scale) + scaled(terms.reward, now.reward_scale)
            return total + terms.limited_kl + terms.end, terms

        networks, optimiser, value, terms = now.descended(loss, state.networks, state.optimiser)
        metrics = {
            "model_loss": value,
            "kl": terms.kl,
            "reward_error": terms.reward,
            "observation_error": terms.observation / before.shape[-1],
        }
        return PlaNetState(networks, observations, rewards, optimiser, state.updates + 1, spec), metrics, ()
