r"""Model-based reinforcement learning, versions 0.5, 1.0, 1.5 and PETS, as settings of one learner (notes 8.3.1, Algorithms 19 to 21).

    collect with a random policy;   repeat { fit f to all data;   for N steps { plan through f;  act;  append } }

- v0.5 (Algorithm 19): the data are random and stay so; the plan is made once an episode. `acting="random"`.
- v1.0 (Algorithm 20): a whole plan is carried out, and what happens is added to the data. `every` is the horizon.
- v1.5 (Algorithm 21): replanning at every step. `every=1`. The notes nest the loops the other way round (erratum E8.12).
- PETS (Chua et al. 2018): v1.5 with an ensemble of probabilistic networks.

The replay and the nesting are the loop's (`OffPolicy`): `unroll` is N, `updates` the gradient steps of a fit, which goes on from the last
fit. Until the first fit it acts at random.

The network learns the change of the state and the reward, standardised (erratum E8.16), and the chance of an end, where any was seen; what
is known of its weights is the `posterior`'s. Deviations from PETS: the reward is learned unless it is given, bounds of the variance are
fixed, a fit goes on from the last one.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree, UInt32

from ..core import (
    Batch,
    EnvSpec,
    Number,
    Policy,
    PRNGKey,
    number,
    part,
    setting,
)
from ..nn import Optimiser, RunningNorm, flat_size
from ..planning.mpc import CrossEntropy, Planner
from .ensembles import aleatoric, epistemic, gaussian_nll, is_held_out
from .fit import Sample, bound, dynamics_data, standards
from .learned import OBJECTIVES, LearnedModel, Objective
from .planned import ModelLearner, encoded_size, planning
from .posteriors import Bootstrap, Posterior

NOTHING = float(jnp.finfo(jnp.float32).max)
"""A loss that any other is less than; infinity would pass for a fit that broke."""


class Best(eqx.Module):
    """What early stopping remembers: the smoothed loss on held-out data (`NOTHING` before the first), its least value, the parameters that
    had it, and for how many updates nothing was better.
    """

    parameters: PyTree
    error: Float[Array, ""]
    least: Float[Array, ""]
    stale: Int[Array, ""]


class ModelBasedState(eqx.Module):
    """Parameters of the posterior and the number that members are drawn by, the optimiser, how many gradient steps there were and how many
    places of the data were seen, and whether an episode ever ended.
    """

    parameters: PyTree
    draw: UInt32[Array, ""]
    inputs: RunningNorm
    targets: RunningNorm
    optimiser: optax.OptState
    updates: Int[Array, ""]
    size: Int[Array, ""]
    ends: Bool[Array, ""]
    best: Best | None
    spec: EnvSpec = eqx.field(static=True)


class ModelBased(ModelLearner):
    """Learn a model of the environment from transitions, and act by planning in it. Any action but pictures' and dictionaries'."""

    sizes: tuple[int, ...] = setting((64, 64), "widths of the members' hidden layers")
    members: int = setting(5, "E: networks in the ensemble, or drawn from the posterior", at_least=1)
    posterior: Posterior = part(
        Bootstrap(), "what is kept of p(theta | D): an ensemble, a Gaussian of each weight, or dropout"
    )
    probabilistic: bool = setting(True, "learn variances as well as means; without, the loss is the squared error")
    predict_delta: bool = setting(True, "learn the change of the state; otherwise the next state")
    learning_rate: Number = number(1e-3, "Adam's step size", above=0)
    holdout: Number = number(
        0.1, "share of the data that is not learned from, for `holdout_error`", at_least=0, below=1
    )
    patience: int = setting(
        0,
        "updates without less loss on held-out data after which the fit stops until data come; 0 never stops",
        at_least=0,
    )
    gamma: Number = number(1.0, "discount of a plan's rewards", at_least=0, at_most=1)
    planner: Planner = part(CrossEntropy(samples=80, elites=8, iterations=3), "how the actions are found")
    horizon: int = setting(15, "H: actions in a plan", at_least=1)
    every: int = setting(1, "actions of a plan that are done before the next", at_least=1)
    acting: Literal["plan", "random"] = setting("plan", "what data are collected with", choices=("plan", "random"))
    particles: int = setting(1, "particles of each member", at_least=1)
    propagation: Literal["tsinf", "ts1", "mean"] = setting(
        "tsinf", "which member moves a particle, and whether with noise", choices=("tsinf", "ts1", "mean")
    )
    objective: Literal["mean", "lcb", "ucb", "quantile"] = setting(
        "mean", "what is made of the members' returns: as expected, pessimistic, optimistic", choices=OBJECTIVES
    )
    kappa: Number = number(1.0, "deviations below (lcb) or above (ucb) the mean", at_least=0)
    level: Number = number(0.25, "level of the quantile", above=0, below=1)
    reward: Any = setting(None, "r(o, a, o') of flat observations, from Python, where it need not be learned")
    max_grad_norm: Number = number(10.0, "gradients are scaled down to this global norm", above=0)

    def __check_init__(self) -> None:
        if self.every > self.horizon:
            raise ValueError(
                f"a plan of {self.horizon} actions cannot be followed for {self.every}: give a smaller every"
            )
        if not isinstance(self.posterior, Posterior):
            raise ValueError(
                f"a posterior is Bootstrap(), MeanField() or Dropout() of rtg.model_based, not {self.posterior!r}"
            )
        if self.reward is not None and not callable(self.reward):
            raise ValueError(f"the reward is a function r(o, a, o') given from Python, or learned, not {self.reward!r}")

    @property
    def batch(self) -> Literal["transitions"]:
        return "transitions"

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete", "multi_discrete", "box")

    def init(self, spec: EnvSpec, key: PRNGKey) -> ModelBasedState:
        network_key, draw_key = jax.random.split(key)
        states, actions = flat_size(spec.observation), encoded_size(spec.action)
        targets = states + (self.reward is None)
        parameters = self.posterior.init(states + actions, targets, self.sizes, self.members, network_key)
        zero, nothing = jnp.zeros((), jnp.int32), jnp.full((), NOTHING, jnp.float32)
        best = Best(parameters, nothing, nothing, zero) if self.patience else None
        return ModelBasedState(
            parameters, jax.random.bits(draw_key), standards(states + actions), standards(targets), Optimiser(0.0, 1.0).init(parameters),
            zero, zero, jnp.zeros((), bool), best, spec,
        )  # fmt: skip

    def model(self, state: ModelBasedState) -> LearnedModel:
        """What has been learned, as a model to plan in."""
        now = self.at(state.updates)
        parameters = state.parameters if state.best is None else state.best.parameters
        number = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
        return LearnedModel(
            self.posterior.draw(parameters, self.members, jax.random.key(state.draw)), state.inputs, state.targets,
            Objective(number(now.kappa), number(now.level), self.objective), number(now.gamma), state.ends,
            state.spec.observation, state.spec.action, self.particles, self.propagation, self.probabilistic,
            self.predict_delta, self.reward,
        )  # fmt: skip

    def policy(self, state: ModelBasedState, explore: bool) -> Policy:
        now, random = self.at(state.updates), (state.updates == 0) | (self.acting == "random")
        return planning(now, self.model(state), state.spec.action, explore, random, every=self.every)

    def update(
        self, state: ModelBasedState, batch: Batch, key: PRNGKey
    ) -> tuple[ModelBasedState, dict[str, Array], Any]:
        now, t = self.at(state.updates), batch.transitions
        bound_key, draw_key = jax.random.split(key)
        x, y = dynamics_data(t, state.spec, self.predict_delta, self.reward is None)
        inputs, targets = state.inputs.update(x), state.targets.update(y)
        sample = Sample(jax.vmap(inputs)(x), jax.vmap(targets)(y), t.terminated)
        kept = is_held_out(batch.indices, now.holdout)
        shares = jnp.where(kept[None], 0.0, self.posterior.shares(batch.indices, self.members))
        # How much there is to learn from is not said: as many places as were seen, less what is held out.
        size = jnp.maximum(state.size, batch.indices.max() + 1)
        noise = None if self.probabilistic else 1.0
        learned_from = jnp.maximum(size * (1.0 - now.holdout), 1.0)
        loss = lambda p: bound(self.posterior, p, sample, shares, learned_from, noise, bound_key)  # noqa: E731
        parameters, optimiser, value, said = now.descended(loss, state.parameters, state.optimiser)
        error = ((said.mean.mean(0) - sample.y) ** 2).mean(1)
        share = lambda mask, x: (mask * x).sum() / jnp.maximum(mask.sum(), 1.0)  # noqa: E731
        best, stopped = state.best, jnp.zeros((), bool)
        if best is not None:
            held_out = share(kept, gaussian_nll(said, sample.y, noise).mean(0))
            best, stopped = self._judged(best, state.parameters, held_out, kept.any(), size > state.size)
            # A fit that stopped waits where it was best.
            parameters = jax.tree.map(lambda new, old: jnp.where(stopped, old, new), parameters, best.parameters)
        metrics = {
            "model_loss": value / self.members,
            "model_error": share(~kept, error),
            "holdout_error": share(kept, error),
            "epistemic": epistemic(said).mean(),
            "aleatoric": aleatoric(said).mean() if self.probabilistic else jnp.zeros(()),
            "stopped": stopped.astype(jnp.float32),
        }
        ends = state.ends | t.terminated.any()
        state = ModelBasedState(
            parameters, jax.random.bits(draw_key), inputs, targets, optimiser, state.updates + 1, size, ends, best, state.spec
        )  # fmt: skip
        return state, metrics, ()

    def _judged(
        self, best: Best, parameters: PyTree, loss: Float[Array, ""], any_held: Bool[Array, ""], grown: Bool[Array, ""]
    ) -> tuple[Best, Bool[Array, ""]]:
        """The best parameters after the held-out loss of the current ones, and whether the fit has stopped.

        It goes on with new data, which show by places that were not seen before, or, in a replay that is full, by a loss that rises again.
        """
        smoothed = jnp.where(best.error < NOTHING, best.error + 0.1 * (loss - best.error), loss)
        error = jnp.where(any_held, smoothed, best.error)
        stopped = best.stale >= self.patience
        again = grown | (stopped & (error > best.least + 0.1 * jnp.abs(best.least)))
        least = jnp.where(again, NOTHING, best.least)
        better = any_held & (error < least)
        kept = jax.tree.map(lambda new, old: jnp.where(better, new, old), parameters, best.parameters)
        stale = jnp.where(better | again, 0, best.stale + 1)
        return Best(kept, error, jnp.minimum(error, least), stale), stale >= self.patience
