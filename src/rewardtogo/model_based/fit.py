r"""Fitting networks that know what they do not know, to plain data or to transitions (notes 8.3.1 and 8.3.3).

$$\min_\phi \; \mathbb{E}_{\theta \sim q_\phi} \Big[ \tfrac{1}{|D|} \sum_{i \in D} -\log p(y_i \mid x_i, \theta) \Big]
+ \tfrac{1}{|D|} \mathrm{KL}(q_\phi \,\|\, p(\theta))$$

by Adam, with x and y standardised. Of a model of dynamics y is the change of the state and the reward (erratum E8.16). A share of the
data is held out; the parameters that did best there are kept, and after `patience` epochs without better ones the fit stops (early
stopping).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PyTree, ScalarLike

from ..core import EnvSpec, Number, PRNGKey, Schedule, Solution, Spec, Transition
from ..nn import Optimiser, RunningNorm, flatten_observation
from .ensembles import Ensemble, Prediction, gaussian_nll
from .learned import LearnedModel, Objective
from .planned import encode_action
from .posteriors import Bootstrap, Posterior


class Sample(eqx.Module):
    """Standardised inputs and targets, and which samples ended an episode (None: not a question)."""

    x: Float[Array, "N I"]
    y: Float[Array, "N D"]
    ended: Bool[Array, "N"] | None = None


def bound(
    posterior: Posterior,
    parameters: PyTree,
    sample: Sample,
    shares: Float[Array, "E N"],
    size: ScalarLike,
    noise: float | Float[Array, "*D"] | None,
    key: PRNGKey,
) -> tuple[Float[Array, ""], Prediction]:
    """Minus the evidence lower bound over the number of data, `size`, times E, by one draw of E members; and what these say.

    - `shares`: how often each member counts each sample; 0 for those that are not to be learned from.
    - `noise`: a known deviation; None takes the members' own.
    """
    members = len(shares)
    said = posterior.draw(parameters, members, key)(jnp.broadcast_to(sample.x[None], (members, *sample.x.shape)))
    terms = gaussian_nll(said, sample.y, noise)
    if sample.ended is not None:
        ended = jnp.broadcast_to(sample.ended.astype(terms.dtype)[None], terms.shape)
        terms = terms + optax.sigmoid_binary_cross_entropy(said.end, ended)
    fit = (shares * terms).sum() / jnp.maximum(shares.sum(), 1.0)
    return members * (fit + posterior.divergence(parameters) / size), said


class Regression(eqx.Module):
    """Members fitted to data: a function with two kinds of uncertainty, in the units of the data."""

    ensemble: Ensemble
    inputs: RunningNorm
    targets: RunningNorm
    noise: Float[Array, "D"] | None
    noisy: bool = eqx.field(static=True, default=True)

    def __call__(self, x: Float[Array, "N I"]) -> Prediction:
        """What the members say of each x. Without variances of their own their log variances are the known noise's, or minus infinity."""
        z = jax.vmap(self.inputs)(x)
        said = self.ensemble(jnp.broadcast_to(z[None], (self.ensemble.layers[0].bias.shape[0], *z.shape)))
        sd = self.targets.sd()[None, None]
        if self.noisy:
            log_variance = said.log_variance + 2.0 * jnp.log(sd)
        else:
            nothing = jnp.full_like(said.mean, -jnp.inf)
            log_variance = nothing if self.noise is None else nothing.at[:].set(2.0 * jnp.log(self.noise))
        return Prediction(self.targets.mean[""][None, None] + sd * said.mean, log_variance, said.end)


class Fit(eqx.Module):
    """Where a fit stands: parameters, the best so far, and the losses of each epoch."""

    parameters: PyTree
    optimiser: optax.OptState
    best: PyTree
    least: Float[Array, ""]
    stale: Array
    epoch: Array
    losses: Float[Array, "T"]
    held_out: Float[Array, "T"]


@partial(jax.jit, static_argnames=("train", "batch_size", "epochs", "patience", "members"))
def _epochs(
    posterior: Posterior, parameters: PyTree, data: Sample, shares: Array, noise: Array | None, rate: Any, key: PRNGKey,
    train: int, batch_size: int, epochs: int, patience: int, members: int,
) -> Fit:  # fmt: skip
    """Epochs over the first `train` rows; the rest is held out."""
    order_key, judge_key = jax.random.split(key)
    steps = train // batch_size
    some = lambda rows: jax.tree.map(lambda x: x[rows], data)  # noqa: E731

    def loss(parameters: PyTree, rows: Array, key: PRNGKey) -> Array:
        return bound(posterior, parameters, some(rows), shares[:, rows], train, noise, key)[0]

    def judge(parameters: PyTree) -> Array:
        """The likelihood of what is held out, by the same draws every time."""
        rest = jax.tree.map(lambda x: x[train:], data)
        said = posterior.draw(parameters, members, judge_key)
        words = said(jnp.broadcast_to(rest.x[None], (members, *rest.x.shape)))
        return gaussian_nll(words, rest.y, noise).mean()

    def epoch(fit: Fit) -> Fit:
        now = jax.random.fold_in(order_key, fit.epoch)
        order = jax.random.permutation(now, train)[: steps * batch_size].reshape(steps, batch_size)

        def step(loop: tuple[PyTree, Any], i: Array) -> tuple[tuple[PyTree, Any], Array]:
            parameters, optimiser = loop
            value, gradient = jax.value_and_grad(loss)(parameters, order[i], jax.random.fold_in(now, i))
            count = fit.epoch * steps + i
            speed = rate(count) if isinstance(rate, Schedule) else rate
            return Optimiser(speed, 10.0 * members).step(parameters, gradient, optimiser), value

        (parameters, optimiser), losses = jax.lax.scan(step, (fit.parameters, fit.optimiser), jnp.arange(steps))
        error = judge(parameters) if len(data.x) > train else jnp.full((), jnp.nan)
        better = (error < fit.least) | (len(data.x) == train)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), parameters, fit.best)
        return Fit(
            parameters, optimiser, best, jnp.minimum(error, fit.least), jnp.where(better, 0, fit.stale + 1), fit.epoch + 1,
            fit.losses.at[fit.epoch].set(losses.mean() / members), fit.held_out.at[fit.epoch].set(error),
        )  # fmt: skip

    nothing, zero = jnp.full(epochs, jnp.nan), jnp.zeros((), jnp.int32)
    infinite = jnp.full((), jnp.inf)
    start = Fit(parameters, Optimiser(0.0, 1.0).init(parameters), parameters, infinite, zero, zero, nothing, nothing)
    going = lambda fit: (fit.epoch < epochs) & ((fit.stale < patience) | (patience == 0))  # noqa: E731
    return jax.lax.while_loop(going, epoch, start)


def fit(
    x: Array | np.ndarray,
    y: Array | np.ndarray,
    key: PRNGKey,
    *,
    posterior: Posterior | None = None,
    sizes: tuple[int, ...] = (64, 64),
    members: int = 5,
    probabilistic: bool = True,
    noise: Any = None,
    holdout: float = 0.1,
    patience: int = 20,
    epochs: int = 500,
    batch_size: int = 64,
    learning_rate: Number = 3e-3,
    ended: Bool[Array, "N"] | None = None,
) -> Solution:
    """Fit y(x) with its uncertainty: `Solution.value` is a `Regression`.

    - `x`, `y`: inputs `[N, I]` and targets `[N, D]`.
    - `posterior`: `Bootstrap()` (if not said), `MeanField()` or `Dropout()`.
    - `sizes`: hidden layers; `()` is a linear model.
    - `members`: E, networks of an ensemble, or draws from a posterior, in each step and in what comes back.
    - `probabilistic`: learn sigma(x) too. Otherwise the noise is `noise`, a deviation in the units of y, a number or `[D]`; without it the
      loss is half the squared error of standardised targets.
    - `holdout`: share of the data that is not learned from, by which the best epoch is chosen; `patience`: epochs without a better one
      after which the fit stops, 0 for never.
    - `learning_rate`: a number, or a schedule over all steps.

    `stats`: `epochs`, `loss` and `holdout_loss` `[epochs]` (NaN after the end), the log-likelihood with the other sign. `converged` says
    whether it stopped early. Raises `ValueError` for data of different lengths, not finite, or too few to hold some out.
    """
    posterior = Bootstrap() if posterior is None else posterior
    x, y = jnp.asarray(x, float), jnp.asarray(y, float)
    _check(x, y, holdout, epochs, batch_size, noise, probabilistic)
    size = len(x)
    held = round(holdout * size)
    order_key, init_key, fit_key, draw_key = jax.random.split(key, 4)
    order = jax.random.permutation(order_key, size)
    x, y, ended = jax.tree.map(lambda a: a[order], (x, y, ended))
    inputs, targets = standards(x.shape[1]).update(x), standards(y.shape[1]).update(y)
    parameters = posterior.init(x.shape[1], y.shape[1], tuple(sizes), members, init_key)
    data = Sample(jax.vmap(inputs)(x), jax.vmap(targets)(y), ended)
    scaled = None if probabilistic else jnp.ones(()) if noise is None else jnp.asarray(noise, y.dtype) / targets.sd()
    steps = max(1, (size - held) // min(batch_size, size - held))
    rate = (
        learning_rate.with_horizon(epochs * steps)
        if isinstance(learning_rate, Schedule)
        else jnp.asarray(learning_rate, jnp.float32)
    )
    done = _epochs(
        posterior, parameters, data, posterior.shares(jnp.arange(size), members), scaled, rate, fit_key, size - held,
        min(batch_size, size - held), epochs, patience if held else 0, members,
    )  # fmt: skip
    drawn = posterior.draw(done.best, members, draw_key)
    known = None if noise is None or probabilistic else jnp.broadcast_to(jnp.asarray(noise, y.dtype), y.shape[1:])
    stats = {"epochs": done.epoch, "loss": done.losses, "holdout_loss": done.held_out, "parameters": done.best}
    return Solution(Regression(drawn, inputs, targets, known, probabilistic), done.epoch < epochs, stats)


def fit_model(
    transitions: Transition,
    spec: EnvSpec,
    key: PRNGKey,
    *,
    predict_delta: bool = True,
    known_reward: Callable | None = None,
    objective: Objective | None = None,
    discount: float = 1.0,
    particles: int = 1,
    propagation: Any = "tsinf",
    **options: Any,
) -> Solution:
    """Fit a model of the dynamics and the rewards to transitions `[N]`: `Solution.value` is a `LearnedModel` to plan in.

    `options` are those of `fit`; the rest is said in `LearnedModel`.
    """
    x, y = dynamics_data(transitions, spec, predict_delta, known_reward is None)
    found = fit(x, y, key, ended=transitions.terminated, **options)
    r: Regression = found.value
    model = LearnedModel(
        r.ensemble, r.inputs, r.targets, Objective.of() if objective is None else objective, jnp.asarray(discount, float),
        transitions.terminated.any(), spec.observation, spec.action, particles, propagation, r.noisy, predict_delta,
        known_reward,
    )  # fmt: skip
    return Solution(model, found.converged, found.stats)


def dynamics_data(
    transitions: Transition, spec: EnvSpec, predict_delta: bool, with_reward: bool
) -> tuple[Float[Array, "N I"], Float[Array, "N D"]]:
    """Inputs (s, a) and targets (s' - s or s', and r) of transitions `[N]`."""
    flat = jax.vmap(lambda o: flatten_observation(spec.observation, o))
    before, after = flat(transitions.observation), flat(transitions.next_observation)
    x = jnp.concatenate([before, jax.vmap(lambda a: encode_action(spec.action, a))(transitions.action)], 1)
    y = after - before if predict_delta else after
    return x, jnp.concatenate([y, transitions.reward[:, None]], 1) if with_reward else y


def standards(size: int) -> RunningNorm:
    """Mean and deviation of vectors, of none so far."""
    return RunningNorm.of(Spec("box", (size,), low=(-jnp.inf,), high=(jnp.inf,)))


def _check(x: Array, y: Array, holdout: float, epochs: int, batch_size: int, noise: Any, probabilistic: bool) -> None:
    if len(x) != len(y) or x.ndim != 2 or y.ndim != 2:
        raise ValueError(
            f"fit needs as many targets as inputs, [N, I] and [N, D], and was given {x.shape} and {y.shape}"
        )
    if not bool(jnp.isfinite(x).all() & jnp.isfinite(y).all()):
        raise ValueError("fit was given inputs or targets that are not finite numbers: leave those samples out")
    if not 0.0 <= holdout < 1.0 or len(x) - round(holdout * len(x)) < 2:
        raise ValueError(
            f"with {len(x)} samples and holdout {holdout} there is too little to learn from: give holdout in [0, 1) and more data"
        )
    if epochs < 1 or batch_size < 1:
        raise ValueError(f"a fit takes at least one epoch and one sample in a batch, not {epochs} and {batch_size}")
    if noise is not None and (probabilistic or not np.all(np.asarray(noise) > 0)):
        raise ValueError(f"noise {noise} is a deviation above 0 that is known, for probabilistic=False")
