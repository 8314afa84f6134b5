"""The policy gradient, in every form of chapters 3 and 4 (Algorithms 2 to 5; Williams 1992).

One step up the gradient estimate from each rollout,

    g = mean_t w_t grad log pi(a_t|s_t) (R_t - b_t),

with R, b and w chosen among the family of `ops.estimators`: full returns, reward-to-go, n steps or GAE; no baseline, the batch's mean,
leave-one-out, the time-dependent mean, the learned value, or the optimal ones; discount option 1 or 2. V is fitted to Monte-Carlo
returns (`mc`), to r + gamma V(s') (`td`) or to lambda-returns (`td_lambda`) by regression, before the actor's step (Algorithms 3 to 5) or
after it (the common order, erratum E4.7). With a `shared` torso (4.7) one step is taken on the sum of both losses.

`reinforce`, `vpg`, `batch_ac`, `online_ac`, `a2c` and `async_ac` are settings of this learner (`rtg list`).

Deviations from the notes: the sum over samples is a mean (decision D2). A return that is cut, by a time limit or by the end of the
rollout, goes on with V of the observation after it (erratum E1.5), unless `bootstrap` is off; inside an episode that ends there is no
bootstrapping for `full` and `reward_to_go`. A full return counts the rewards of an episode that lie in the rollout.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from ..core import (
    Action,
    Carry,
    EnvSpec,
    Learner,
    Number,
    Observation,
    Policy,
    PRNGKey,
    Rollout,
    number,
    part,
    require_action,
    setting,
)
from ..nn import (
    ACTION_KINDS,
    MLP,
    RULES,
    ActorCritic,
    ActorCriticPolicy,
    Network,
    Optimiser,
    RunningNorm,
    as_network,
    global_norm,
    require_fresh,
)
from ..ops.advantages import normalise
from ..ops.estimators import BASELINES, RETURNS, Baseline, Estimator, Returns, Steps
from ..ops.metrics import explained_variance
from ..ops.returns import lambda_returns


class PolicyGradientState(eqx.Module):
    """Networks, their two optimisers, what observations look like, and the number of updates done."""

    network: ActorCritic
    policy_optimiser: optax.OptState
    value_optimiser: optax.OptState
    norm: RunningNorm | None
    updates: Int[Array, ""]


class Timed(Policy):
    """A policy that also counts the steps of its episode, in its memory."""

    policy: ActorCriticPolicy

    def init(self, key: PRNGKey) -> Carry:
        return self.policy.init(key), jnp.zeros((), jnp.int32)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        inner, action, extras = self.policy(carry[0], observation, key)
        return (inner, carry[1] + 1), action, extras

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.policy.inspect(carry[0], observation)


class PolicyGradient(Learner):
    """Policy gradient and actor-critic. Any action space but dictionaries; any observation; networks with or without a memory."""

    network: Network = part(MLP(64, 64), "recipe of the actor's and of the critic's network", converter=as_network)
    returns: Returns = setting("reward_to_go", "rewards that are credited to an action", choices=RETURNS)
    baseline: Baseline = setting("value", "what is subtracted from them", choices=BASELINES)
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    gae_lambda: Number = number(
        0.95, "chance of looking one step further in `gae` and `td_lambda`", at_least=0, at_most=1
    )
    n_steps: int = setting(5, "rewards in a return, for `n_step`", at_least=1)
    discount_states: bool = setting(False, "weigh step t by gamma^t: discount option 2")
    bootstrap: bool = setting(True, "go on with V where a return is cut; without it a cut counts as an end")
    learning_rate: Number = number(3e-3, "step size for the policy (with a shared torso, for all)", above=0)
    optimiser: str = setting("adam", "rule of the steps", choices=RULES)
    value_target: Literal["mc", "td", "td_lambda"] = setting(
        "mc", "what V is fitted to, unless `returns` is `vtrace`, which says it", choices=("mc", "td", "td_lambda")
    )
    value_learning_rate: Number = number(3e-3, "step size for the value function", above=0)
    value_updates: int = setting(20, "gradient steps of the value regression on each rollout", at_least=1)
    value_first: bool = setting(False, "fit V before the advantages are taken from it")
    shared: bool = setting(False, "one torso for actor and critic")
    detached: bool = setting(False, "keep the value loss out of a shared torso")
    value_cost: Number = number(0.5, "weight of the value loss, with a shared torso", at_least=0)
    entropy_cost: Number = number(0.0, "weight of an entropy bonus", at_least=0)
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)
    normalise_advantages: bool = setting(True, "mean 0, sd 1 over the rollout")
    log_std: Number = number(0.0, "log standard deviation that a Gaussian policy begins with, in units of half the box")
    normalise_observations: bool = setting(False, "standardise observations by running statistics kept in the state")

    def __check_init__(self) -> None:
        optimal = self.baseline.startswith("optimal")
        if optimal and self.network.has_memory:
            raise ValueError(
                f"the {self.baseline} baseline needs the score of every single step, and with a memory a step's score reaches into "
                "others: choose another baseline, or a network without a memory"
            )
        if optimal and self.shared:
            raise ValueError(
                f"the {self.baseline} baseline has no loss that a shared torso could be trained with: leave `shared` off"
            )
        if self.shared and self.value_first:
            raise ValueError(
                "with a shared torso both losses make one step, so V cannot be fitted first: turn one of `shared`, `value_first` off"
            )

    @property
    def batch(self) -> Literal["rollout"]:
        return "rollout"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ACTION_KINDS

    @property
    def estimator(self) -> Estimator:
        """The member of the family that it estimates the gradient by."""
        return Estimator(self.returns, self.baseline, self.discount_states, self.gamma, self.gae_lambda, self.n_steps)

    @property
    def _needs_time(self) -> bool:
        return self.discount_states or self.baseline == "time_mean"

    def init(self, spec: EnvSpec, key: PRNGKey) -> PolicyGradientState:
        require_action("PolicyGradient", spec, self.action_kinds)
        network = ActorCritic.of(
            self.network, spec, key, shared=self.shared, detached=self.detached, log_std=self.at(0).log_std
        )
        norm = RunningNorm.of(spec.observation) if self.normalise_observations else None
        optimiser = self._optimiser(self.learning_rate).init(network)
        return PolicyGradientState(network, optimiser, optimiser, norm, jnp.zeros((), jnp.int32))

    def policy(self, state: PolicyGradientState, explore: bool) -> Policy:
        policy = ActorCriticPolicy(state.network, state.norm, explore, state.updates)
        return Timed(policy) if self._needs_time else policy

    def update(
        self, state: PolicyGradientState, batch: Rollout, key: PRNGKey
    ) -> tuple[PolicyGradientState, dict[str, Array], tuple[()]]:
        del key
        if self.returns != "vtrace":
            require_fresh(batch.transitions, state.updates, "PolicyGradient")
        now = self.at(state.updates)
        norm = (lambda x: x) if state.norm is None else state.norm
        t = batch.transitions
        elapsed = batch.carry[1] if self._needs_time else jnp.zeros(t.reward.shape[1], jnp.int32)
        rollout = Rollout(t, batch.carry[0] if self._needs_time else batch.carry)
        standard = eqx.tree_at(lambda r: r.transitions.observation, rollout, jax.vmap(jax.vmap(norm))(t.observation))
        # How much likelier the actions have become since they were chosen: not at all, unless the parameters that acted were old.
        log_ratio = evaluate(state.network, standard)[0] - t.extras["log_prob"] if self.returns == "vtrace" else None
        ratio = jnp.ones_like(t.reward) if log_ratio is None else jnp.exp(log_ratio)

        def look(network: ActorCritic) -> Steps:
            value, next_value = network.values(rollout, norm)
            next_value = next_value if self.bootstrap else jnp.where(_ends(t.done), 0.0, next_value)
            return Steps(t.reward, now.gamma * (1.0 - t.terminated), t.done, value, next_value, ratio, elapsed)

        steps = look(state.network)
        target, optimisers = now._targets(steps), (state.policy_optimiser, state.value_optimiser)
        if self.shared:
            network, optimisers, metrics = now._both(state.network, optimisers, standard, steps, target)
        elif self.value_first:
            network, value_state, value_loss = now._fit(state.network, optimisers[1], standard, target)
            network, policy_state, metrics = now._ascend(network, optimisers[0], standard, look(network))
            optimisers, metrics = (policy_state, value_state), metrics | {"value_loss": value_loss}
        else:
            network, policy_state, metrics = now._ascend(state.network, optimisers[0], standard, steps)
            network, value_state, value_loss = now._fit(network, optimisers[1], standard, target)
            optimisers, metrics = (policy_state, value_state), metrics | {"value_loss": value_loss}
        # Statistics change after the update, so that every part of it saw the same observations.
        statistics = None if state.norm is None else state.norm.update(t.observation)
        metrics |= {"explained_variance": explained_variance(steps.value, target)}
        if log_ratio is not None:
            metrics |= {"behaviour_kl": -log_ratio.mean(), "largest_ratio": ratio.max()}
        return PolicyGradientState(network, *optimisers, statistics, state.updates + 1), metrics, ()

    def _targets(self, s: Steps) -> Float[Array, "T B"]:
        """What V is fitted to."""
        if self.returns == "vtrace":
            return self.estimator.corrected(s)[0]
        lambda_ = {"mc": 1.0, "td": 0.0, "td_lambda": self.gae_lambda}[self.value_target]
        return jax.vmap(lambda r, d, v, c: lambda_returns(r, d, v, lambda_, c), 1, 1)(
            s.reward, s.discount, s.next_value, s.cut
        )

    def _ascend(
        self, network: ActorCritic, optimiser: optax.OptState, rollout: Rollout, steps: Steps
    ) -> tuple[ActorCritic, optax.OptState, dict[str, Array]]:
        """One step of the policy."""
        if self.baseline.startswith("optimal"):
            gradient, metrics = self._scored_gradient(network, rollout, steps)
        else:
            weights = self._weights(steps)
            loss = lambda n: self._policy_loss(evaluate(n, rollout), weights)  # noqa: E731
            gradient, metrics = jax.grad(loss, has_aux=True)(network)
        network, optimiser = self._optimiser(self.learning_rate).step(network, gradient, optimiser)
        return network, optimiser, metrics | {"grad_norm": global_norm(gradient)}

    def _fit(
        self, network: ActorCritic, optimiser: optax.OptState, rollout: Rollout, target: Float[Array, "T B"]
    ) -> tuple[ActorCritic, optax.OptState, Float[Array, ""]]:
        rule = self._optimiser(self.value_learning_rate)
        return regress(network, optimiser, rule, rollout, target, self.value_updates)

    def _both(
        self,
        network: ActorCritic,
        optimisers: tuple[optax.OptState, optax.OptState],
        rollout: Rollout,
        steps: Steps,
        target: Float[Array, "T B"],
    ) -> tuple[ActorCritic, tuple[optax.OptState, optax.OptState], dict[str, Array]]:
        """One step of a shared torso and its heads."""
        weights = self._weights(steps)

        def loss(network: ActorCritic) -> tuple[Array, dict[str, Array]]:
            found = evaluate(network, rollout)
            (policy_loss, metrics), value_loss = self._policy_loss(found, weights), _value_loss(found, target)
            return policy_loss + self.value_cost * value_loss, metrics | {"value_loss": value_loss}

        gradient, metrics = jax.grad(loss, has_aux=True)(network)
        network, optimiser = self._optimiser(self.learning_rate).step(network, gradient, optimisers[0])
        return network, (optimiser, optimisers[1]), metrics | {"grad_norm": global_norm(gradient)}

    def _weights(self, steps: Steps) -> Float[Array, "T B"]:
        weights = self.estimator.weights(steps)
        return normalise(weights) if self.normalise_advantages else weights

    def _policy_loss(
        self, found: tuple[Array, Array, Array], weights: Float[Array, "T B"]
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        log_prob, entropy, _ = found
        loss = -(log_prob * weights).mean()
        return loss - self.entropy_cost * entropy.mean(), {"policy_loss": loss, "entropy": entropy.mean()}

    def _scored_gradient(
        self, network: ActorCritic, rollout: Rollout, steps: Steps
    ) -> tuple[ActorCritic, dict[str, Array]]:
        """The gradient of the loss where the baseline is made of the scores: every step's is formed, `[T, B, P]`."""
        t = rollout.transitions
        flat, unravel = ravel_pytree(network)

        def log_prob(flat: Array, observation: Observation, action: Action) -> Float[Array, ""]:
            return unravel(flat).act(network.init()[0], observation)[1].log_prob(action)

        def entropy(network: ActorCritic) -> Float[Array, ""]:
            return evaluate(network, rollout)[1].mean()

        scores = jax.vmap(jax.vmap(jax.grad(log_prob), (None, 0, 0)), (None, 0, 0))(flat, t.observation, t.action)
        bonus, slope = jax.value_and_grad(entropy)(network)
        gradient = -self.estimator.gradient(steps, scores) - self.entropy_cost * ravel_pytree(slope)[0]
        return unravel(gradient), {"entropy": bonus}

    def _optimiser(self, rate: Number) -> Optimiser:
        return Optimiser(rate, self.max_grad_norm, eps=1e-5, rule=self.optimiser)


def evaluate(network: ActorCritic, rollout: Rollout) -> tuple[Array, Array, Array]:
    """Log pi(a|s), entropy and value of every step, `[T, B]`; observations are standardised already."""
    t = rollout.transitions
    if network.recurrent:
        whole = jax.vmap(lambda c, o, a, d: network.evaluate(c, o, a, d), in_axes=(0, 1, 1, 1), out_axes=1)
        return whole(rollout.carry, t.observation, t.action, t.done)
    return jax.vmap(jax.vmap(lambda o, a, d: network.evaluate(network.init(), o, a, d)))(
        t.observation, t.action, t.done
    )


def regress(
    network: ActorCritic,
    optimiser: optax.OptState,
    rule: Optimiser,
    rollout: Rollout,
    target: Float[Array, "T B"],
    steps: int,
) -> tuple[ActorCritic, optax.OptState, Float[Array, ""]]:
    """Steps of the regression of V on targets: network, optimiser, and the loss before them. The actor stays as it is, to the bit."""

    def step(
        loop: tuple[ActorCritic, optax.OptState], _: None
    ) -> tuple[tuple[ActorCritic, optax.OptState], Float[Array, ""]]:
        network, optimiser = loop
        loss, gradient = jax.value_and_grad(lambda n: _value_loss(evaluate(n, rollout), target))(network)
        return rule.step(network, gradient, optimiser), loss

    (network, optimiser), losses = jax.lax.scan(step, (network, optimiser), None, steps)
    return network, optimiser, losses[0]


def _value_loss(found: tuple[Array, Array, Array], target: Float[Array, "T B"]) -> Float[Array, ""]:
    return 0.5 * ((found[2] - target) ** 2).mean()


def _ends(done: Array) -> Array:
    """Where a trajectory ends within the rollout: at the end of an episode, and in the last row."""
    return done.at[-1].set(True)
