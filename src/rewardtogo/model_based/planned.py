r"""What learners of models share: a step of their fit, and how they act by planning in what they have learned.

    while nothing is learned:  a ~ uniform;     then:  plan from the state through the model, do the first action, with noise

Nothing is planned while actions are random: steps of warm-up cost no more than those of a random policy.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from ..core import Action, Carry, Learner, Model, Number, Observation, Policy, PRNGKey, Spec, State
from ..nn import Optimiser, RunningNorm
from ..ops.distributions import DiagGaussian
from ..planning.mpc import MPC
from ..planning.problem import ModelProblem

Parameters = TypeVar("Parameters")


class ModelLearner(Learner):
    """A learner that descends a loss by Adam, its gradient clipped."""

    learning_rate: eqx.AbstractVar[Number]
    max_grad_norm: eqx.AbstractVar[Number]

    def descended(
        self, loss: Callable[[Parameters], tuple[Array, Any]], parameters: Parameters, optimiser: optax.OptState
    ) -> tuple[Parameters, optax.OptState, Float[Array, ""], Any]:
        """A step: parameters, optimiser, the loss before it, and what that said besides. Of `at(...)`, where numbers may be schedules."""
        (value, said), gradient = jax.value_and_grad(loss, has_aux=True)(parameters)
        rule = Optimiser(self.learning_rate, self.max_grad_norm)
        return *rule.step(parameters, gradient, optimiser), value, said


class Exploring(Policy):
    """Plans, and adds noise where there is any; acts at random, without planning, while there is nothing to plan with."""

    planning: MPC
    random: Bool[Array, ""]
    noise: Float[Array, ""] | None
    action: Spec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        return self.planning.init(key)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        plan_key, random_key, noise_key = jax.random.split(key, 3)
        idle = lambda: (carry, self.action.clip(self.action.zeros()))  # noqa: E731
        after, planned = jax.lax.cond(self.random, idle, lambda: self.planning(carry, observation, plan_key)[:2])
        return after, explored(self.action, planned, self.random, self.noise, random_key, noise_key), {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.planning.inspect(carry, observation)


def planning(
    now: Any, model: Model, action: Spec, explore: bool, random: Bool[Array, ""], noise: Any = None, every: int = 1
) -> Policy:
    """`MPC` in a model by the `planner`, the `horizon` and the `gamma` of a learner; to explore, with noise or at random."""
    problem = ModelProblem(model, now.horizon, action, jnp.asarray(now.gamma, jnp.float32))
    policy = MPC(problem, now.planner, every)
    return (
        Exploring(policy, random, None if noise is None else jnp.asarray(noise, jnp.float32), action)
        if explore
        else policy
    )


def explored(
    spec: Spec,
    planned: Action,
    random: Bool[Array, ""],
    noise: Float[Array, ""] | None,
    key: PRNGKey,
    noise_key: PRNGKey,
) -> Action:
    """A planned action with noise, or a random one where `random` says so: deviation `noise` in half-widths of the box, or of choices the
    chance of another. None is no noise.
    """
    guess = spec.sample(key)
    if noise is not None and spec.kind == "box":
        span = jnp.ones(spec.shape)
        if spec.is_bounded:
            low, high = spec.bounds()
            span = jnp.asarray(0.5 * (high - low))
        planned = spec.clip(planned + noise * span * jax.random.normal(noise_key, span.shape))
    elif noise is not None:
        planned = jnp.where(jax.random.uniform(noise_key) < noise, guess, planned)
    return jnp.where(random, guess, planned)


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


def encoded_size(spec: Spec) -> int:
    """Length of `encode_action`'s result."""
    return encode_action(spec, spec.zeros()).size


class Imagining(Model):
    """A model whose states hold the `reward` that led to them and in `alive` the chance, or of several particles the chances, to go on."""

    def reward(self, state: State, action: Action, next_state: State) -> Float[Array, ""]:
        del state, action
        return next_state.reward

    def terminal(self, state: State) -> Bool[Array, ""]:
        return state.alive.max() < 1e-3


def gaussian(raw: Float[Array, "D"], least: float) -> DiagGaussian:
    """Mean and deviation, at least `least`, from a network's output."""
    mean, spread = jnp.split(raw, 2)
    return DiagGaussian(mean, jnp.log(jax.nn.softplus(spread) + least))


def standardised_rewards(rewards: RunningNorm, given: Array) -> Array:
    """Rewards in units of their deviation, which networks predict."""
    return (given - rewards.mean[""][0]) / rewards.sd()[0]


def scaled(error: Float[Array, ""], deviation: Number) -> Float[Array, ""]:
    """Minus the logarithm of a Gaussian density, of a squared error, but for what does not depend on that."""
    return 0.5 * error / jnp.asarray(deviation, jnp.float32) ** 2
