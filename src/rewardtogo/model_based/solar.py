r"""SOLAR: latent states whose dynamics are linear and cost quadratic, and controllers improved near the data (Zhang et al. 2019).

A network reads Gaussian potentials $\psi(s_t; o_t)$ off pictures; the prior of the states is a chain with unknown linear dynamics, so that
their posterior is a smoother's (`structured`); another network draws what a state looks like, and costs are quadratic in state and action.
What is maximised over networks and cost is the bound

$$E_q\Big[\sum_t \log p(o_t \mid s_t) + \log p(c_t \mid s_t, a_t)\Big] - KL(q(s) \Vert p(s \mid W, \Sigma))
- KL(q(W, \Sigma) \Vert p(W, \Sigma)),$$

with natural gradients for $q(W, \Sigma)$. It makes latents in which the linear-quadratic regulator is at home. Then, in turns:

    run the controllers;  learn the model a little further;  fit dynamics of each time step to the last episodes, the global ones as prior;
    improve the controllers by a regulator, within a KL divergence of what was run

A controller is $u_t = K_t \hat s_t + k_t + S_t \epsilon$ for each step of the episode, $\hat s_t$ filtered. Its first data are random.

Deviations from the paper: costs are a sum of squares with an offset, so never concave; dynamics have an offset; pictures are Gaussian
with a fixed deviation; what was run is expressed in the new latents by regression of its actions, after the model was learned further.

Source: notes 8.3.4, reference 12.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..core import (
    Action,
    Carry,
    EnvSpec,
    Number,
    Observation,
    Policy,
    PRNGKey,
    Rollout,
    Spec,
    number,
    part,
    require_action,
    setting,
)
from ..nn import MLP, Linear, Network, Optimiser, RunningNorm, as_network, flat_size, flatten_observation
from ..nn.network import Torso
from ..ops.bayesian import RegressionMoments
from ..ops.distributions import DiagGaussian
from ..ops.kalman import kalman_filter, kalman_gain
from ..planning.kl_constrained import adapted_step, expected_cost, kl_constrained_lqr, spread_of
from ..planning.linear_quadratic import LinearController, LQProblem
from .fit import standards
from .latent import Dense
from .planned import ModelLearner, encode_action, scaled, standardised_rewards
from .structured import (
    ExpectedDynamics,
    Laws,
    believed,
    chain_kl,
    local_laws,
    smoothed_states,
    transition_moments,
    weighted_sum,
)

LEAST_LOG_STD, MOST_LOG_STD = -4.0, 2.0
"""Of the potentials."""


class QuadraticCost(eqx.Module):
    """c(z) = |root z - target|^2 / 2 + offset of z = (s, a): any quadratic that has a least value."""

    root: Float[Array, "Z Z"]
    target: Float[Array, "Z"]
    offset: Float[Array, ""]

    def __call__(self, z: Float[Array, "Z"]) -> Float[Array, ""]:
        return 0.5 * jnp.sum((self.root @ z - self.target) ** 2) + self.offset

    @property
    def C(self) -> Float[Array, "Z Z"]:
        """The matrix of z' C z / 2 + c' z + a constant."""
        return self.root.T @ self.root

    @property
    def c(self) -> Float[Array, "Z"]:
        """The vector of it."""
        return -self.root.T @ self.target

    @property
    def constant(self) -> Float[Array, ""]:
        """The constant of it."""
        return 0.5 * jnp.sum(self.target**2) + self.offset


class SOLARNetworks(eqx.Module):
    """The recognition network and its potentials, the decoder, and the cost."""

    encoder: Torso
    potential: Linear
    decoder: Dense
    cost: QuadraticCost

    def __call__(self, observation: Observation) -> DiagGaussian:
        """psi(s; o) as a Gaussian of s."""
        _, features = self.encoder(self.encoder.init(), observation)
        mean, log_std = jnp.split(self.potential(features), 2)
        middle, half = 0.5 * (MOST_LOG_STD + LEAST_LOG_STD), 0.5 * (MOST_LOG_STD - LEAST_LOG_STD)
        return DiagGaussian(mean, middle + half * jnp.tanh((log_std - 1.0 - middle) / half))


class SOLARTerms(eqx.Module):
    """The terms of the bound as means over steps: squared errors (observations' summed over entries), and the states' divergence."""

    observation: Float[Array, ""]
    cost: Float[Array, ""]
    state_kl: Float[Array, ""]


class Memory(eqx.Module):
    """The last N episodes: observations `[N, H + 1]`, actions as vectors, rewards, and which were whole; how many were written."""

    observations: PyTree[Array]
    actions: Float[Array, "N H A"]
    rewards: Float[Array, "N H"]
    whole: Bool[Array, "N"]
    written: Int[Array, ""]

    def add(
        self,
        observations: PyTree[Array],
        actions: Float[Array, "B H A"],
        rewards: Float[Array, "B H"],
        whole: Bool[Array, "B"],
    ) -> "Memory":
        """With B more, in place of the oldest."""
        rows = (self.written + jnp.arange(len(rewards))) % len(self.rewards)
        put = lambda old, new: old.at[rows].set(new)  # noqa: E731
        return Memory(
            jax.tree.map(put, self.observations, observations),
            put(self.actions, actions),
            put(self.rewards, rewards),
            put(self.whole, whole),
            self.written + len(rewards),
        )


class SOLARPolicy(Policy):
    """Filters the latent state and acts by the gains of the step, with noise where there is any.

    Its memory: time, and mean and covariance of the state expected before a look.
    """

    networks: SOLARNetworks
    observations: RunningNorm
    weights: Float[Array, "H X Z"]
    noise: Float[Array, "H X X"]
    controller: LinearController
    action: Spec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        size = self.noise.shape[-1]
        return jnp.zeros((), jnp.int32), jnp.zeros(size), jnp.eye(size)

    def estimate(self, carry: Carry, observation: Observation) -> tuple[Float[Array, "X"], Float[Array, "X X"]]:
        """Mean and covariance of the state after a look."""
        _, mean, covariance = carry
        potential = self.networks(self.observations(observation))
        gain, after, _ = kalman_gain(covariance, jnp.eye(len(mean)), jnp.diag(potential.std**2))
        return mean + gain @ (potential.mean - mean), after

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        time = carry[0]
        t = jnp.minimum(time, len(self.noise) - 1)
        mean, covariance = self.estimate(carry, observation)
        _, u, _ = self.controller(time, mean, key)
        action = unscaled(self.action, u)
        done = jnp.concatenate([mean, encode_action(self.action, action), jnp.ones(1)])
        A = self.weights[t][:, : len(mean)]
        return (time + 1, self.weights[t] @ done, A @ covariance @ A.T + self.noise[t]), action, {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        quiet = eqx.tree_at(lambda p: p.controller, self, LinearController(self.controller.K, self.controller.k))
        return {"mean": quiet(carry, observation, jax.random.key(0))[1]}


def unscaled(spec: Spec, u: Float[Array, "A"]) -> Action:
    """The action that `encode_action` makes u of, whether in the box or not."""
    if not spec.is_bounded:
        return u.reshape(spec.shape)
    low, high = (jnp.asarray(bound, jnp.float32) for bound in spec.bounds())
    return low + 0.5 * (u.reshape(spec.shape) + 1.0) * (high - low)


class SOLARState(eqx.Module):
    """The model (networks, the global law, what standardises), the local laws, the controllers, and what the next step's length is
    made of: its multiplier, what the last update promised to save, and what the controllers before it cost.
    """

    networks: SOLARNetworks
    dynamics: Laws
    observations: RunningNorm
    rewards: RunningNorm
    local: Laws
    controller: LinearController
    memory: Memory
    multiplier: Float[Array, ""]
    promised: Float[Array, ""]
    cost: Float[Array, ""]
    optimiser: optax.OptState
    updates: Int[Array, ""]
    spec: EnvSpec = eqx.field(static=True)


class SOLAR(ModelLearner):
    """Learn a latent linear-quadratic model from whole episodes, and improve controllers of each time step in it. Boxes alone.

    Episodes are all `horizon` steps long, and a rollout is one of them: `--loop.unroll` is the horizon. Others are not learned from.
    """

    latent_size: int = setting(4, "X: numbers in the latent state", at_least=1)
    network: Network = part(MLP(64, activation="relu"), "recipe of the recognition network", converter=as_network)
    decoder_sizes: tuple[int, ...] = setting((128, 256), "hidden layers of the decoder")
    horizon: int = setting(15, "H: steps in an episode, and in a rollout", at_least=2)
    warm_up: int = setting(4, "iterations with random actions, before controllers are improved", at_least=1)
    pretrain: int = setting(600, "gradient steps in each of them", at_least=1)
    finetune: int = setting(200, "gradient steps in each iteration after them", at_least=0)
    batch_size: int = setting(8, "episodes in a gradient step", at_least=1)
    episodes: int = setting(512, "episodes that are remembered", at_least=1)
    learning_rate: Number = number(3e-3, "Adam's step size", above=0)
    natural_rate: Number = number(
        0.05, "share of the global dynamics that each gradient step replaces", above=0, at_most=1
    )
    observation_scale: Number = number(0.2, "deviation of the observation", above=0)
    cost_scale: Number = number(0.1, "deviation of the cost, standardised", above=0)
    prior_samples: Number = number(10.0, "episodes that the global model counts for in the local ones", above=0)
    rounds: int = setting(2, "turns of local inference", at_least=1)
    kl_step: Number = number(0.5, "KL divergence of an update from what was run, nats for each step", above=0)
    noise: Number = number(0.1, "deviation of the first actions, in half-widths of the box", above=0)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)

    def __check_init__(self) -> None:
        if self.network.has_memory:
            raise ValueError(
                "SOLAR's recognition network reads one observation at a time: give it one without a memory"
            )

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("box",)

    def prior(self, actions: int) -> Laws:
        """p(W, Sigma): about standing still."""
        size = self.latent_size
        mean = jnp.eye(size, size + actions + 1)
        return Laws.of(mean, jnp.eye(size + actions + 1), 0.1 * jnp.eye(size), size + 2.0)

    def init(self, spec: EnvSpec, key: PRNGKey) -> SOLARState:
        require_action("SOLAR", spec, self.action_kinds)
        actions, size, horizon = spec.action.size, self.latent_size, self.horizon
        keys = jax.random.split(key, 4)
        encoder = self.network.build(spec.observation, keys[0])
        networks = SOLARNetworks(
            encoder,
            Linear.of(encoder.features, 2 * size, keys[1], 1.0),
            Dense.of(size, self.decoder_sizes, flat_size(spec.observation), keys[2], 0.1),
            QuadraticCost(0.5 * jnp.eye(size + actions), jnp.zeros(size + actions), jnp.zeros(())),
        )
        prior = self.prior(actions)
        blank = lambda x: jnp.zeros((self.episodes, *x.shape), x.dtype)  # noqa: E731
        seen = jax.tree.map(lambda x: jnp.zeros((horizon + 1, *x.shape), x.dtype), spec.observation.zeros())
        memory = Memory(
            jax.tree.map(blank, seen),
            blank(jnp.zeros((horizon, actions))),
            blank(jnp.zeros(horizon)),
            jnp.zeros(self.episodes, bool),
            jnp.zeros((), jnp.int32),
        )
        first = jnp.asarray(self.at(0).noise, jnp.float32)
        controller = LinearController(
            jnp.zeros((horizon, actions, size)),
            jnp.zeros((horizon, actions)),
            jnp.broadcast_to(first * jnp.eye(actions), (horizon, actions, actions)),
        )
        zero = jnp.zeros(())
        return SOLARState(
            networks, prior, RunningNorm.of(spec.observation), standards(1),
            jax.tree.map(lambda a: jnp.broadcast_to(a, (horizon, *a.shape)), prior), controller, memory,
            jnp.ones(()), zero, zero, Optimiser(0.0, 1.0).init(networks), jnp.zeros((), jnp.int32), spec,
        )  # fmt: skip

    def policy(self, state: SOLARState, explore: bool) -> SOLARPolicy:
        controller = state.controller
        if not explore:
            controller = LinearController(controller.K, controller.k, jnp.zeros_like(spread_of(controller)))
        dynamics = ExpectedDynamics.of(state.local, self.horizon)
        return SOLARPolicy(
            state.networks, state.observations, dynamics.weights, dynamics.noise, controller, state.spec.action
        )

    def update(self, state: SOLARState, batch: Rollout, key: PRNGKey) -> tuple[SOLARState, dict[str, Array], tuple[()]]:
        now, t, spec = self.at(state.updates), batch.transitions, state.spec
        steps, count = t.reward.shape
        if steps != self.horizon:
            raise ValueError(
                f"SOLAR's horizon is {self.horizon} steps and rollouts have {steps}: give --learner.horizon and --loop.unroll the same"
            )
        if count > self.episodes:
            raise ValueError(f"SOLAR remembers {self.episodes} episodes and is given {count} at once: remember more")
        swap = lambda x: jnp.swapaxes(x, 0, 1)  # noqa: E731
        seen = jax.tree.map(lambda o, last: swap(jnp.concatenate([o, last[-1:]])), t.observation, t.next_observation)
        actions, rewards = swap(jax.vmap(jax.vmap(lambda a: encode_action(spec.action, a)))(t.action)), swap(t.reward)
        whole = (batch.carry[0] == 0) & ~t.done[:-1].any(0)
        memory = state.memory.add(seen, actions, rewards, whole)
        observations = state.observations.update(t.observation)
        standard = state.rewards.update(t.reward.reshape(-1, 1))
        prior, learning = self.prior(spec.action.size), state.updates >= self.warm_up

        def costs_of(rewards: Array) -> Array:
            return -standardised_rewards(standard, rewards)

        def potentials_of(networks: SOLARNetworks, seen: PyTree[Array]) -> DiagGaussian:
            return jax.vmap(jax.vmap(lambda o: networks(observations(o))))(seen)

        def descend(i: Array, loop: tuple[Any, ...]) -> tuple[Any, ...]:
            networks, dynamics, optimiser, _ = loop
            row_key, state_key = jax.random.split(jax.random.fold_in(key, i))
            rows = jax.random.randint(row_key, (self.batch_size,), 0, jnp.minimum(memory.written, self.episodes))
            pick = lambda x: x[rows]  # noqa: E731
            looked, done, weights = jax.tree.map(pick, memory.observations), pick(memory.actions), pick(memory.whole)
            weights = weights.astype(jnp.float32)
            wanted = jax.vmap(jax.vmap(lambda o: flatten_observation(spec.observation, observations(o))))(looked)
            expected = ExpectedDynamics.of(dynamics, self.horizon)

            def loss(networks: SOLARNetworks) -> tuple[Array, tuple[SOLARTerms, RegressionMoments]]:
                potentials = potentials_of(networks, looked)
                terms, moments = jax.vmap(lambda *each: sequence_terms(networks, expected, *each))(
                    potentials, wanted, done, costs_of(pick(memory.rewards)), jax.random.split(state_key, len(rows))
                )
                mean = lambda x: (weights * x).sum() / jnp.maximum(weights.sum(), 1.0)  # noqa: E731
                terms = jax.tree.map(mean, terms)
                total = scaled(terms.observation, now.observation_scale) + scaled(terms.cost, now.cost_scale)
                return total + terms.state_kl, (terms, weighted_sum(moments, weights))

            networks, optimiser, value, (terms, moments) = now.descended(loss, networks, optimiser)
            # The batch stands for all that is remembered.
            share = memory.whole.sum() / jnp.maximum(weights.sum(), 1.0)
            wanted_law = prior.observe(jax.tree.map(lambda m: m.sum(0), moments).scaled(share))
            rate = jnp.asarray(now.natural_rate, jnp.float32)
            mixed = jax.tree.map(lambda a, b: (1.0 - rate) * a + rate * b, dynamics.seen, wanted_law.seen)
            return networks, Laws(mixed), optimiser, (value, terms)

        zero = jnp.zeros(())
        loop = (state.networks, state.dynamics, state.optimiser, (zero, SOLARTerms(zero, zero, zero)))
        descents = jnp.where(learning, self.finetune, self.pretrain)
        networks, dynamics, optimiser, (value, terms) = jax.lax.fori_loop(0, descents, descend, loop)

        potentials, weights = potentials_of(networks, seen), whole.astype(jnp.float32)
        base = believed(dynamics, jnp.asarray(now.prior_samples, jnp.float32))
        local, states = local_laws(base, dynamics, potentials, actions, weights, self.rounds)
        expected = ExpectedDynamics.of(local, self.horizon)
        mean, covariance = gathered(states.mean[:, 0], states.covariance[:, 0], weights)
        problem = LQProblem(
            expected.weights[..., :-1],
            networks.cost.C,
            self.horizon,
            expected.weights[..., -1],
            networks.cost.c,
            noise=expected.noise,
        )
        run = state.controller
        if self.finetune:
            run = self.expressed(expected, potentials, actions, weights, run)
        limit = jnp.asarray(now.kl_step, jnp.float32) * self.horizon
        paid = expected_cost(problem, run, mean, covariance)
        adapted = adapted_step(state.multiplier, state.promised, state.cost - paid)
        multiplier = jnp.where(state.updates > self.warm_up, adapted, state.multiplier)
        solution = kl_constrained_lqr(problem, run, mean, covariance, limit * multiplier)
        controller = jax.tree.map(lambda new, old: jnp.where(learning, new, old), solution.value, state.controller)
        kept = lambda new: jnp.where(learning, new, 0.0)  # noqa: E731
        metrics = {
            "model_loss": value,
            "observation_error": terms.observation / flat_size(spec.observation),
            "cost_error": terms.cost,
            "state_kl": terms.state_kl,
            "expected_cost": (paid + self.horizon * networks.cost.constant) * standard.sd()[0]
            - self.horizon * standard.mean[""][0],
            "kl": kept(solution.stats["kl"]),
            "whole": weights.mean(),
        }
        state = SOLARState(
            networks, dynamics, observations, standard, local, controller, memory, multiplier,
            kept(paid - solution.stats["cost"]), paid,
            optimiser, state.updates + 1, spec,
        )  # fmt: skip
        return state, metrics, ()

    def expressed(
        self,
        dynamics: ExpectedDynamics,
        potentials: DiagGaussian,
        actions: Float[Array, "B H A"],
        weights: Float[Array, "B"],
        run: LinearController,
    ) -> LinearController:
        """The controllers that were run, on the states that the model filters now: a regression of the actions of each time.

        What was run, on the states of then, is its prior, and counts for one sample.
        """
        size, horizon = self.latent_size, self.horizon
        look = lambda p, a: kalman_filter(dynamics.system(p), p.mean, a).mean[:horizon]  # noqa: E731
        states = jax.vmap(look)(potentials, actions)
        x = jnp.concatenate([states, jnp.ones((*states.shape[:2], 1))], -1)
        # About what was run: where it has little noise, sums of squares of the actions themselves would lose it in rounding.
        around = actions - jnp.einsum("tux,btx->btu", run.K, states) - run.k[None]

        def moments(x: Array, u: Array) -> RegressionMoments:
            weighted = weights[:, None] * x
            return RegressionMoments(weighted.T @ x, u.T @ weighted, (weights[:, None] * u).T @ u, weights.sum())

        each = jax.vmap(moments, in_axes=1)(x, around)
        count = jnp.maximum(each.count.sum(), 1.0)
        sample = each.xx.sum(0) / count + 1e-4 * jnp.eye(size + 1)
        freedom = actions.shape[-1] + 2.0

        def regressed(S: Array, moments: RegressionMoments) -> tuple[Array, Array]:
            prior = Laws.of(jnp.zeros((len(S), size + 1)), sample, freedom * S @ S.T, freedom)
            law = prior.observe(moments)
            return law.mean, jnp.linalg.cholesky(law.noise)

        change, spread = jax.vmap(regressed)(spread_of(run), each)
        return LinearController(run.K + change[..., :size], run.k + change[..., size], spread)


def gathered(
    means: Float[Array, "B X"], covariances: Float[Array, "B X X"], weights: Float[Array, "B"]
) -> tuple[Float[Array, "X"], Float[Array, "X X"]]:
    """Mean and covariance of a mixture of Gaussians."""
    share = weights / jnp.maximum(weights.sum(), 1.0)
    mean = share @ means
    gap = means - mean[None]
    return mean, jnp.tensordot(share, covariances, 1) + (share[:, None] * gap).T @ gap


def sequence_terms(
    networks: SOLARNetworks,
    dynamics: ExpectedDynamics,
    potentials: DiagGaussian,
    observations: Float[Array, "P O"],
    actions: Float[Array, "H A"],
    costs: Float[Array, "H"],
    key: PRNGKey,
) -> tuple[SOLARTerms, RegressionMoments]:
    """The terms of one episode, with one sample of each state, and the moments of its transitions."""
    posterior, normaliser = smoothed_states(dynamics, potentials, actions)
    roots = jnp.linalg.cholesky(posterior.covariance)
    noise = jax.random.normal(key, posterior.mean.shape)
    states = posterior.mean + jnp.einsum("tij,tj->ti", roots, noise)
    drawn = jax.vmap(networks.decoder)(states)
    priced = jax.vmap(networks.cost)(jnp.concatenate([states[:-1], actions], 1))
    terms = SOLARTerms(
        observation=jnp.sum((drawn - observations) ** 2) / len(observations),
        cost=jnp.mean((priced - costs) ** 2),
        state_kl=chain_kl(posterior, potentials, normaliser) / len(observations),
    )
    return terms, jax.lax.stop_gradient(transition_moments(posterior, actions))
