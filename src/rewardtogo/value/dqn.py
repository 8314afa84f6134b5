r"""DQN and its family: Q-learning with a replay and a target network (chapter 6, Algorithms 11 to 13; Mnih et al. 2015).

Minimises the Huber loss of Q(s, a) - y over batches from the replay, with

$$y = r + \gamma\, (1 - \text{terminated}) \max_{a'} Q_\text{target}(s', a'), \qquad
y^\text{double} = r + \gamma\, (1 - \text{terminated})\, Q_\text{target}(s', \arg\max_{a'} Q(s', a'))$$

(van Hasselt et al. 2016), and acts by epsilon-greedy choice. Every `target_period` updates the target moves, phi' <- (1 - tau) phi' +
tau phi: a hard copy where tau is 1, Polyak averaging where `target_period` is 1 and tau small. (The notes' tau, 0.999, is what is
*kept*: erratum E6.1.)

The family is made of values that combine:

| | |
|---|---|
| `double` | the online network chooses the next action |
| `dueling`, `noisy`, `head_sizes` | the head: two streams, random weights, hidden layers (`q_network`) |
| `outputs` | `Expectation`, `C51` or `Quantiles` of the return (`outputs`) |
| `n_step`, `correction` | several rewards in a target, and what makes up for older policies' actions (`targets`) |
| `traces`, `trace_decay` | Retrace, tree backup or importance sampling over whole sequences |
| `network` | any; one with a memory learns from sequences, each replayed from the memory stored when acting, after `burn_in` steps (R2D2) |

Deviations from the paper: Adam instead of RMSProp; the loss is Huber's (the paper clips the error's gradient, which is the same);
updates are means over a batch, not sums (erratum E6.9); observations are not preprocessed here.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ..core import Batch, EnvSpec, Learner, Number, PRNGKey, Transition, number, part, require_action, setting
from ..data.n_step import IMPORTANCE, n_step_windows
from ..nn import MLP, RULES, Network, Optimiser, RunningNorm, as_network, global_norm
from ..nn.optimise import towards
from ..ops.axes import over
from ..ops.retrace import TRACES, Trace
from ..ops.schedules import Linear as LinearSchedule
from .outputs import Expectation, Outputs
from .q_network import GreedyPolicy, QNetwork, expected
from .targets import CORRECTIONS, Correction, bootstrapped, corrections, look, outputs_at, traced


class DQNState(eqx.Module):
    """Online and target network, optimiser, what observations look like, and the number of updates done."""

    network: QNetwork
    target: QNetwork
    optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class DQN(Learner):
    """Deep Q-learning. Discrete actions, with masks; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64, activation="relu"), "recipe of the Q network", converter=as_network)
    outputs: Outputs = part(Expectation(), "what the network says of a return: expectation, c51 or quantiles")
    head_sizes: tuple[int, ...] = setting((), "hidden layers of the head, of each stream where it is dueling")
    dueling: bool = setting(False, "a head of two streams: value of the state, advantage of each action")
    noisy: bool = setting(False, "random weights in the head, with a learned spread, to explore by")
    learning_rate: Number = number(1e-3, "the optimiser's step size", above=0)
    optimiser: str = setting("adam", "rule of the optimiser", choices=RULES)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    epsilon: Number = number(
        LinearSchedule(1.0, 0.05, fraction=0.2), "probability of a random action while learning", at_least=0, at_most=1
    )
    target_rate: Number = number(
        1.0, "tau: how far the target moves towards the network; 1 copies it", above=0, at_most=1
    )
    target_period: int = setting(250, "updates between two moves of the target", at_least=1)
    double: bool = setting(False, "let the online network choose the action that the target network values")
    n_step: int = setting(1, "rewards in a target; more come from sequences of at least as many steps", at_least=1)
    correction: Correction = setting(
        "none", "what n-step targets do about later actions that were not greedy", choices=CORRECTIONS
    )
    max_importance: Number = number(10.0, "weights of the importance correction are cut here", above=0)
    traces: Trace | Literal["none"] = setting(
        "none", "targets from whole sequences, by these coefficients", choices=("none", *TRACES)
    )
    trace_decay: Number = number(0.9, "lambda of the traces: 0 looks one step ahead", at_least=0, at_most=1)
    target_epsilon: Number = number(0.0, "randomness of the policy that traces value", at_least=0, at_most=1)
    burn_in: int = setting(0, "steps of a sequence that only bring a memory up to date", at_least=0)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)
    huber: Number = number(1.0, "errors beyond this count linearly", above=0)
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    @property
    def batch(self) -> Literal["transitions", "sequences"]:
        several = self.network.has_memory or self.n_step > 1 or self.traces != "none"
        return "sequences" if several else "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete",)

    @property
    def _keeps_probabilities(self) -> bool:
        return self.correction == "importance" or self.traces in ("retrace", "importance")

    def __check_init__(self) -> None:
        if any(size < 1 for size in self.head_sizes):
            raise ValueError(f"DQN.head_sizes must be whole numbers of at least 1, not {self.head_sizes}")
        if self.traces != "none" and self.n_step > 1:
            raise ValueError(
                f"traces={self.traces!r} uses whole sequences, and n_step={self.n_step} pieces of them: use one or the other"
            )
        if self.traces != "none" and not isinstance(self.outputs, Expectation):
            raise ValueError(
                f"traces add up expected returns, and {type(self.outputs).__name__} has whole distributions: "
                "use outputs=Expectation(), or n_step for targets of several steps"
            )
        if self.correction != "none" and self.n_step == 1:
            raise ValueError(
                f"correction={self.correction!r} is about actions after the first, and n_step=1 has none: give a larger n_step"
            )
        if self._keeps_probabilities and self.noisy:
            raise ValueError(
                "with noisy weights nobody knows the probability of an action, which importance ratios need: "
                "use correction='adaptive' or traces='tree_backup', which need none, or noisy=False"
            )
        if self.burn_in and not self.network.has_memory:
            raise ValueError(
                f"burn_in={self.burn_in} brings a memory up to date, and this network has none: use a GRU or an LSTM"
            )

    def init(self, spec: EnvSpec, key: PRNGKey) -> DQNState:
        require_action("DQN", spec, self.action_kinds)
        network = QNetwork.of(self.network, spec, key, self.outputs.size, self.head_sizes, self.dueling, self.noisy)
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        optimiser = self._rule().init(network)
        return DQNState(network, network, optimiser, norm, jnp.zeros((), jnp.int32))

    def policy(self, state: DQNState, explore: bool) -> GreedyPolicy:
        epsilon = jnp.asarray(self.at(state.updates).epsilon if explore else 0.0, jnp.float32)
        # A policy is saved as arrays.
        outputs = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), self.outputs.at(state.updates))
        return GreedyPolicy(
            state.network, outputs, state.norm, epsilon, explore and self.noisy, explore and self._keeps_probabilities
        )

    def update(
        self, state: DQNState, batch: Batch, key: PRNGKey
    ) -> tuple[DQNState, dict[str, Array], Float[Array, "*T N"]]:
        now, t = self.at(state.updates), batch.transitions
        norm = None if state.norm is None else state.norm.update(t.observation)
        t = t if norm is None else _standardised(norm, t)
        online_key, target_key = jax.random.split(key) if self.noisy else (key, key)
        target = state.target.drawn(target_key)

        def loss(network: QNetwork) -> tuple[Array, tuple[Array, Array]]:
            steps = now._steps(network.drawn(online_key), target, t)
            chosen = outputs_at(steps.observation.online, steps.action)
            y = jax.lax.stop_gradient(now._targets(steps))
            each = over(y.ndim - 1, lambda out, y: now.outputs.loss(out, y, now.huber))(chosen, y)
            error = over(y.ndim - 1, now.outputs.error)(chosen, y)
            weight = jnp.minimum(steps.extras[IMPORTANCE], now.max_importance) if IMPORTANCE in steps.extras else 1.0
            each = weight * each
            each = each if each.ndim == 1 else each.mean(0)
            return (batch.weights * each).mean(), (now.outputs.mean(chosen), error)

        (value, (chosen, error)), gradient = jax.value_and_grad(loss, has_aux=True)(state.network)
        network, optimiser = now._rule().step(state.network, gradient, state.optimiser)
        updates = state.updates + 1
        metrics = {
            "q_loss": value,
            "q_mean": chosen.mean(),
            "td_error": jnp.abs(error).mean(),
            "grad_norm": global_norm(gradient),
            "epsilon": now.epsilon,
        }
        tau = jnp.where(updates % self.target_period == 0, now.target_rate, 0.0)
        state = DQNState(network, towards(state.target, network, tau), optimiser, norm, updates)
        return state, metrics, jnp.abs(error)

    def _steps(self, network: QNetwork, target: QNetwork, t: Transition) -> Transition:
        """The steps that the batch has targets for, with what both networks see: `Seen` where observations are."""
        if self.n_step == 1 or self.network.has_memory:
            t = look(network, target, t, self.burn_in)
        if self.n_step == 1:
            return t
        if self.network.has_memory:
            here, online = t.observation.observation, t.observation.online
            return self._windows(t, online, here)
        # Without a memory only the two ends of a window need to be looked at, and all of it if its actions are judged.
        online = None if self.correction == "none" else network.along(t)[0]
        return look(network, target, self._windows(t, online, t.observation))

    def _windows(self, t: Transition, online: Array | None, observation: Array) -> Transition:
        q = None if online is None else jax.lax.stop_gradient(expected(self.outputs, online, observation))
        stop, ratio = (None, None) if q is None else corrections(self.correction, q, observation, t)
        return n_step_windows(t, self.n_step, self.gamma, stop, ratio)

    def _targets(self, steps: Transition) -> Float[Array, "*N M"]:
        if self.traces == "none":
            return bootstrapped(self.outputs, steps, self.gamma, self.double)
        return traced(self.outputs, steps, self.gamma, self.double, self.traces, self.trace_decay, self.target_epsilon)

    def _rule(self) -> Optimiser:
        return Optimiser(self.learning_rate, self.max_grad_norm, rule=self.optimiser)


def _standardised(norm: RunningNorm, t: Transition) -> Transition:
    standard = over(t.reward.ndim, norm)
    ends = (standard(t.observation), standard(t.next_observation))
    return eqx.tree_at(lambda t: (t.observation, t.next_observation), t, ends)
