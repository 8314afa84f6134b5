r"""Model-based reinforcement learning, versions 0.5, 1.0, 1.5 and PETS, as settings of one learner (notes 8.3.1, Algorithms 19 to 21).

    collect with a random policy;   repeat { fit f to all data;   for N steps { plan through f;  act;  append } }

- v0.5 (Algorithm 19): the data are random and stay so; the plan is made once an episode. `acting="random"`.
- v1.0 (Algorithm 20): a whole plan is carried out, and what happens is added to the data. `every` is the horizon.
- v1.5 (Algorithm 21): replanning at every step. `every=1`. The notes nest the loops the other way round (erratum E8.12).
- PETS (Chua et al. 2018): v1.5 with an ensemble of probabilistic networks.

The replay and the nesting are the loop's (`OffPolicy`): `unroll` is N, `updates` the gradient steps of a fit, which goes on from the last
fit. Until
the first fit it acts at random.

The network learns the change of the state and the reward, standardised (erratum E8.16), and the chance of an end. Deviations from PETS: the
reward is learned rather than given, bounds of the variance are fixed, a fit goes on from the last one.
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
    Learner,
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
from ..planning.mpc import MPC, CrossEntropy, Planner
from ..planning.problem import ModelProblem
from .ensembles import (
    Ensemble,
    LearnedModel,
    Prediction,
    aleatoric,
    bootstrap_weights,
    encode_action,
    epistemic,
    gaussian_nll,
    is_held_out,
)


class ModelBasedState(eqx.Module):
    """The model, its optimiser, and the number of gradient steps done."""

    ensemble: Ensemble
    inputs: RunningNorm
    targets: RunningNorm
    optimiser: optax.OptState
    updates: Int[Array, ""]
    spec: EnvSpec = eqx.field(static=True)


class Exploring(Policy):
    """Plans, or acts at random while there is nothing to plan with."""

    planning: MPC
    random: Bool[Array, ""]
    action: Spec = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        return self.planning.init(key)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        plan_key, random_key = jax.random.split(key)
        after, planned, _ = self.planning(carry, observation, plan_key)
        action = jnp.where(self.random, self.action.sample(random_key), planned)
        return after, action, {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.planning.inspect(carry, observation)


class ModelBased(Learner):
    """Learn a model of the environment from transitions, and act by planning in it. Any action but pictures' and dictionaries'."""

    sizes: tuple[int, ...] = setting((64, 64), "widths of the members' hidden layers")
    members: int = setting(5, "E: networks in the ensemble", at_least=1)
    probabilistic: bool = setting(True, "learn variances as well as means; without, the loss is the squared error")
    bootstrap: bool = setting(True, "each member has its own sample of the data")
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    holdout: Number = number(0.1, "share of the data that is kept for the metric `holdout_error`", at_least=0, below=1)
    gamma: Number = number(1.0, "discount of a plan's rewards", at_least=0, at_most=1)
    planner: Planner = part(CrossEntropy(samples=80, elites=8, iterations=3), "how the actions are found")
    horizon: int = setting(15, "H: actions in a plan", at_least=1)
    every: int = setting(1, "actions of a plan that are done before the next", at_least=1)
    acting: Literal["plan", "random"] = setting("plan", "what data are collected with", choices=("plan", "random"))
    particles: int = setting(1, "particles of each member", at_least=1)
    propagation: Literal["tsinf", "ts1", "mean"] = setting(
        "tsinf", "which member moves a particle, and whether with noise", choices=("tsinf", "ts1", "mean")
    )
    risk: Number = number(0.0, "kappa: reward less so many deviations of the members'; below 0 is optimistic")
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)

    def __check_init__(self) -> None:
        if self.every > self.horizon:
            raise ValueError(
                f"a plan of {self.horizon} actions cannot be followed for {self.every}: give a smaller every"
            )

    @property
    def batch(self) -> Literal["transitions"]:
        return "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete", "multi_discrete", "box")

    def init(self, spec: EnvSpec, key: PRNGKey) -> ModelBasedState:
        states, actions = flat_size(spec.observation), encode_action(spec.action, spec.action.zeros()).size
        ensemble = Ensemble.of(states + actions, states + 1, self.sizes, self.members, key)
        real = lambda size: RunningNorm.of(Spec("box", (size,), low=(-jnp.inf,), high=(jnp.inf,)))  # noqa: E731
        optimiser = Optimiser(0.0, 1.0).init(ensemble)
        return ModelBasedState(
            ensemble, real(states + actions), real(states + 1), optimiser, jnp.zeros((), jnp.int32), spec
        )

    def model(self, state: ModelBasedState) -> LearnedModel:
        """What has been learned, as a model to plan in."""
        now = self.at(state.updates)
        return LearnedModel(
            state.ensemble,
            state.inputs,
            state.targets,
            jnp.asarray(now.risk, jnp.float32),
            state.spec.observation,
            state.spec.action,
            self.particles,
            self.propagation,
        )

    def policy(self, state: ModelBasedState, explore: bool) -> Policy:
        problem = ModelProblem(
            self.model(state), self.horizon, state.spec.action, jnp.asarray(self.at(state.updates).gamma, jnp.float32)
        )
        planning = MPC(problem, self.planner, self.every)
        if not explore:
            return planning
        random = (state.updates == 0) | (self.acting == "random")
        return Exploring(planning, random, state.spec.action)

    def update(
        self, state: ModelBasedState, batch: Batch, key: PRNGKey
    ) -> tuple[ModelBasedState, dict[str, Array], Any]:
        del key
        now, t, spec = self.at(state.updates), batch.transitions, state.spec
        flat = jax.vmap(lambda o: flatten_observation(spec.observation, o))
        before, after = flat(t.observation), flat(t.next_observation)
        x = jnp.concatenate([before, jax.vmap(lambda a: encode_action(spec.action, a))(t.action)], 1)
        y = jnp.concatenate([after - before, t.reward[:, None]], 1)
        inputs, targets = state.inputs.update(x), state.targets.update(y)
        z = jnp.broadcast_to(jax.vmap(inputs)(x)[None], (self.members, *x.shape))
        wanted, ended = jax.vmap(targets)(y), t.terminated.astype(jnp.float32)
        kept = is_held_out(batch.indices, now.holdout)
        own = bootstrap_weights(batch.indices, self.members) if self.bootstrap else jnp.ones((self.members, len(y)))
        weights = jnp.where(kept[None], 0.0, own)

        def loss(ensemble: Ensemble) -> tuple[Float[Array, ""], Prediction]:
            said = ensemble(z)
            fit = gaussian_nll(said, wanted, self.probabilistic)
            end = optax.sigmoid_binary_cross_entropy(said.end, jnp.broadcast_to(ended[None], said.end.shape))
            return (weights * (fit + end)).sum() / jnp.maximum(weights.sum(), 1.0) * self.members, said

        (value, said), gradient = jax.value_and_grad(loss, has_aux=True)(state.ensemble)
        rule = Optimiser(now.learning_rate, now.max_grad_norm)
        ensemble, optimiser = rule.step(state.ensemble, gradient, state.optimiser)
        error = ((said.mean.mean(0) - wanted) ** 2).mean(1)
        share = lambda mask: (mask * error).sum() / jnp.maximum(mask.sum(), 1.0)  # noqa: E731
        metrics = {
            "model_loss": value / self.members,
            "model_error": share(~kept),
            "holdout_error": share(kept),
            "epistemic": epistemic(said).mean(),
            "aleatoric": aleatoric(said).mean() if self.probabilistic else jnp.zeros(()),
        }
        return (
            ModelBasedState(ensemble, inputs, targets, optimiser, state.updates + 1, spec),
            metrics,
            (),
        )
