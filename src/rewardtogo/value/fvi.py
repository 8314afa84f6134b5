r"""Fitted value iteration with a network, in an environment whose dynamics are known (chapter 5, Algorithm 8).

$$y_i = \max_a \mathbb{E}_{s'} \Big[ r(s_i, a, s') + \gamma\, (1 - \text{terminated})\, V_{\phi'}(s') \Big], \qquad
\phi \leftarrow \arg\min_\phi \tfrac12 \sum_i \big( V_\phi(s_i) - y_i \big)^2,$$

then $\phi' \leftarrow \phi$, and again. Every action is tried in every state, which takes a simulator that can be set to what was observed
(`core.Observed`); actions and rewards of the data are not looked at, only where it went. The policy is that of the right side, $\arg\max_a$
one step ahead, for $V$ alone does not say what to do.

The maximum is outside of the expectation, over an $a$ that the notes write $a_i$ (erratum E5.5). The notes do not say where the states
come from nor how long a regression lasts (erratum E5.12): here they are those of a replay that the policy fills, and a regression is
`target_period` gradient steps. With linear features and exact regressions it is `fitted_value_iteration` (`fitted.py`).

Deviation: the sum over samples is a mean (erratum E5.4), so that the step size does not depend on the size of a batch.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ..core import (
    Action,
    Batch,
    Carry,
    Dynamics,
    EnvSpec,
    Learner,
    Number,
    Observation,
    Observed,
    Policy,
    PRNGKey,
    from_space,
    number,
    part,
    require_action,
    setting,
)
from ..nn import MLP, Linear, Network, Optimiser, RunningNorm, Torso, as_network, global_norm
from ..nn.optimise import towards
from ..ops.schedules import Linear as LinearSchedule


class ValueNetwork(eqx.Module):
    """V of an observation, from a torso without a memory."""

    torso: Torso
    head: Linear
    norm: RunningNorm | None

    def __call__(self, observation: Observation) -> Float[Array, ""]:
        seen = observation if self.norm is None else self.norm(observation)
        return self.head(self.torso((), seen)[1])[0]


class FVIState(eqx.Module):
    """The network, the one that targets are computed with, the optimiser, and the number of updates done."""

    network: ValueNetwork
    target: ValueNetwork
    optimiser: optax.OptState
    updates: Int[Array, ""]


class Lookahead(Policy):
    """argmax_a E[r + γ V(s')], or a uniformly random action with probability `epsilon`."""

    simulator: Observed
    value: ValueNetwork
    gamma: Float[Array, ""]
    epsilon: Float[Array, ""]
    actions: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        ahead_key, explore_key, action_key = jax.random.split(key, 3)
        best = jnp.argmax(self.q_values(observation, ahead_key)).astype(jnp.int32)
        anything = jax.random.randint(action_key, (), 0, self.actions, jnp.int32)
        return carry, jnp.where(jax.random.uniform(explore_key) < self.epsilon, anything, best), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return {"q_values": self.q_values(observation, jax.random.key(0)), "value": self.value(observation)}

    def q_values(self, observation: Observation, key: PRNGKey) -> Float[Array, "A"]:
        """One step ahead by each action, the mean over `samples` outcomes."""
        state = self.simulator.state_of(observation)

        def one(action: Array, key: PRNGKey) -> Float[Array, ""]:
            t = self.simulator.step(state, action, key)[1]
            return t.reward + self.gamma * (1.0 - t.terminated) * self.value(t.final_observation)

        keys = jax.random.split(key, self.samples)
        several = lambda action: jax.vmap(lambda k: one(action, k))(keys).mean()  # noqa: E731
        return jax.vmap(several)(jnp.arange(self.actions, dtype=jnp.int32))


class FVI(Learner):
    """Fitted value iteration. Discrete actions, an environment that can be simulated from what is observed, networks without a memory.

    `dynamics` is the recipe of a simulator (`rtg.envs.Simulator`), or an `Observed` environment without a time limit; in a run it is
    the run's own environment unless another is named. `init` raises `ValueError` where there is none, and where it is another
    environment's.
    """

    dynamics: Dynamics | Observed | None = part(None, "what every action is tried in; by default the run's environment")
    network: Network = part(MLP(64, 64, activation="relu"), "recipe of the value network", converter=as_network)
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    epsilon: Number = number(
        LinearSchedule(1.0, 0.05, fraction=0.2), "probability of a random action while learning", at_least=0, at_most=1
    )
    samples: int = setting(1, "outcomes tried of each action; 1 is enough where nothing is random", at_least=1)
    target_period: int = setting(100, "gradient steps of a regression", at_least=1)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    def __check_init__(self) -> None:
        if self.network.has_memory:
            raise ValueError("FVI values what a simulator shows, one state at a time: use a network without a memory")

    @property
    def batch(self) -> Literal["transitions"]:
        return "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete",)

    @property
    def simulator(self) -> Observed:
        """What every action is tried in."""
        if self.dynamics is None:
            raise ValueError("FVI tries every action in a simulator: say in which, FVI(dynamics=CartPole())")
        return self.dynamics.build() if isinstance(self.dynamics, Dynamics) else self.dynamics

    def init(self, spec: EnvSpec, key: PRNGKey) -> FVIState:
        require_action("FVI", spec, self.action_kinds)
        simulator = self.simulator
        own = EnvSpec(from_space(simulator.observation_space), from_space(simulator.action_space))
        if own != spec:
            raise ValueError(
                f"the simulator {type(simulator).__name__} is of another environment: it shows {_short(own)}, the run {_short(spec)}"
            )
        torso_key, head_key = jax.random.split(key)
        torso = self.network.build(spec.observation, torso_key)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        network = ValueNetwork(torso, Linear.of(torso.features, 1, head_key, gain=1.0), norm)
        return FVIState(network, network, self._rule().init(trained(network)), jnp.zeros((), jnp.int32))

    def policy(self, state: FVIState, explore: bool) -> Lookahead:
        now = self.at(state.updates)
        epsilon = jnp.asarray(now.epsilon if explore else 0.0, jnp.float32)
        return self._lookahead(state.network, jnp.asarray(now.gamma, jnp.float32), epsilon)

    def _lookahead(self, network: ValueNetwork, gamma: Array, epsilon: Array) -> Lookahead:
        simulator = self.simulator
        return Lookahead(simulator, network, gamma, epsilon, int(simulator.action_space.n), self.samples)  # type: ignore[attr-defined]

    def update(
        self, state: FVIState, batch: Batch, key: PRNGKey
    ) -> tuple[FVIState, dict[str, Array], Float[Array, "N"]]:
        now, seen = self.at(state.updates), batch.transitions.observation
        network = state.network
        if network.norm is not None:
            network = eqx.tree_at(lambda n: n.norm, network, network.norm.update(seen))
        ahead = self._lookahead(state.target, jnp.asarray(now.gamma, jnp.float32), jnp.zeros(()))
        keys = jax.random.split(key, len(batch.weights))
        y = jax.vmap(lambda o, k: ahead.q_values(o, k).max())(seen, keys)

        def loss(parts: tuple[Torso, Linear]) -> tuple[Array, tuple[Array, Array]]:
            values = jax.vmap(ValueNetwork(*parts, network.norm).__call__)(seen)
            error = values - y
            return 0.5 * (batch.weights * error**2).mean(), (values, error)

        (value, (values, error)), gradient = jax.value_and_grad(loss, has_aux=True)(trained(network))
        parts, optimiser = now._rule().step(trained(network), gradient, state.optimiser)
        network = ValueNetwork(*parts, network.norm)
        updates = state.updates + 1
        target = towards(state.target, network, jnp.where(updates % self.target_period == 0, 1.0, 0.0))
        metrics = {
            "v_loss": value,
            "v_mean": values.mean(),
            "td_error": jnp.abs(error).mean(),
            "grad_norm": global_norm(gradient),
            "epsilon": now.epsilon,
        }
        return FVIState(network, target, optimiser, updates), metrics, jnp.abs(error)

    def _rule(self) -> Optimiser:
        return Optimiser(self.learning_rate, self.max_grad_norm)


def trained(network: ValueNetwork) -> tuple[Torso, Linear]:
    """The parts that gradients reach."""
    return network.torso, network.head


def _short(spec: EnvSpec) -> str:
    """The shapes of a specification, in a few words."""
    actions = spec.action.counts[0] if spec.action.counts else spec.action.size
    return f"observations of shape {spec.observation.shape} and {actions} actions"
