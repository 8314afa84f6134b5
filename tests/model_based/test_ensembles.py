"""Learned models: variances and where they come from, the bootstrap, and what is planned on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import rewardtogo as rtg
from rewardtogo.core import Batch, EnvSpec, Spec, Transition
from rewardtogo.model_based import Ensemble, LearnedModel, ModelBased, Prediction
from rewardtogo.model_based.ensembles import (
    aleatoric,
    bootstrap_weights,
    epistemic,
    gaussian_nll,
    is_held_out,
    total_variance,
)
from rewardtogo.planning import CrossEntropy, ModelProblem, total_cost

KEY = jax.random.key(0)
LINE = EnvSpec(Spec("box", (1,), low=(-np.inf,), high=(np.inf,)), Spec("box", (1,), low=(-1.0,), high=(1.0,)))


def word(means: list[float], variances: list[float]) -> Prediction:
    """Members with given means and variances of one target."""
    mean = jnp.asarray(means)[:, None, None]
    return Prediction(mean, jnp.log(jnp.asarray(variances))[:, None, None], jnp.zeros((len(means), 1)))


def test_the_variance_of_a_mixture(item, x64):
    """Mean of variances and variance of means, against samples; averaging the samples of the members would not do (erratum E8.14)."""
    said = word([-1.0, 0.0, 1.5], [0.1, 0.2, 0.3])
    rng = np.random.default_rng(0)
    member = rng.integers(0, 3, 400_000)
    mean, sd = np.array([-1.0, 0.0, 1.5]), np.sqrt([0.1, 0.2, 0.3])
    samples = mean[member] + sd[member] * rng.normal(size=400_000)
    averaged = (mean + sd * rng.normal(size=(100_000, 3))).mean(1)
    total = float(total_variance(said)[0, 0])
    with item("8.55") as check:
        check(abs(total / samples.var() - 1), "<=", 0.01, "variance of samples of the mixture, relative")
        check(abs(float(aleatoric(said)[0, 0] + epistemic(said)[0, 0]) - total), "<=", 1e-12, "its two parts")
        check(abs(averaged.var() / total - 1), ">=", 0.5, "averaged samples have another variance")
    entropy = 0.5 * np.log(2 * np.pi * np.e * 0.2)
    nll = float(gaussian_nll(word([0.0], [0.2]), jnp.full((1, 1), np.sqrt(0.2)))[0, 0]) + 0.5 * np.log(2 * np.pi)
    with item("8.52") as check:
        check(
            abs(nll - entropy), "<=", 1e-12, "likelihood one deviation off the mean is the entropy 1/2 log(2 pi e s^2)"
        )


def test_the_bootstrap(item):
    weights = np.asarray(bootstrap_weights(jnp.arange(5000), 5))
    again = np.asarray(bootstrap_weights(jnp.arange(100, 200), 5))
    with item("8.59") as check:
        check(
            abs((weights > 0).mean() - (1 - np.exp(-1))),
            "<=",
            0.01,
            "share of the data that a member has, from 1 - 1/e",
        )
        check(abs(weights.mean() - 1), "<=", 0.02, "mean weight, from 1")
        check(abs(weights.var() - 1), "<=", 0.05, "variance of the weights, from 1")
        check(
            float(np.abs(again - weights[:, 100:200]).max()),
            "==",
            0,
            "a place has the same weights whenever it is asked",
        )
    assert abs(float(is_held_out(jnp.arange(5000), 0.1).mean()) - 0.1) < 0.02


def fitted(x: np.ndarray, y: np.ndarray, members: int = 5, steps: int = 1500, bootstrap: bool = True) -> Ensemble:
    """An ensemble fitted to y(x) by Adam, each member on its own bootstrap sample."""
    ensemble = Ensemble.of(1, 1, (32, 32), members, KEY)
    inputs = jnp.broadcast_to(jnp.asarray(x, jnp.float32)[None, :, None], (members, len(x), 1))
    targets = jnp.asarray(y, jnp.float32)[:, None]
    weights = bootstrap_weights(jnp.arange(len(x)), members) if bootstrap else jnp.ones((members, len(x)))
    rule = optax.adam(3e-3)

    def step(loop: tuple, _: None) -> tuple[tuple, None]:
        ensemble, state = loop
        loss = lambda e: (weights * gaussian_nll(e(inputs), targets)).mean()  # noqa: E731
        change, state = rule.update(jax.grad(loss)(ensemble), state)
        return (optax.apply_updates(ensemble, change), state), None

    run = jax.jit(lambda e: jax.lax.scan(step, (e, rule.init(e)), None, length=steps)[0][0])
    return run(ensemble)


def said(ensemble: Ensemble, x: np.ndarray) -> Prediction:
    members = ensemble.layers[0].bias.shape[0]
    return ensemble(jnp.broadcast_to(jnp.asarray(x, jnp.float32)[None, :, None], (members, len(x), 1)))


def test_what_is_not_known(item):
    """Noise that differs from place to place is found there; the members differ where there are no data, and say so."""
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-1.0, -0.3, 300), rng.uniform(0.3, 1.0, 300)])
    noise = 0.1 + 0.2 * np.abs(x)
    y = np.sin(3 * x) + noise * rng.normal(size=len(x))
    ensemble = fitted(x, y, steps=800)
    at = np.array([-0.8, -0.6, 0.6, 0.8])
    near, far = said(ensemble, at), said(ensemble, np.array([2.5, 3.0, -2.5]))
    found = np.sqrt(np.asarray(aleatoric(near))[:, 0])
    fresh = rng.uniform(0.3, 1.0, 2000)
    answers = np.sin(3 * fresh) + (0.1 + 0.2 * np.abs(fresh)) * rng.normal(size=2000)
    law = said(ensemble, fresh)
    centre, width = np.asarray(law.mean.mean(0))[:, 0], 1.645 * np.sqrt(np.asarray(total_variance(law))[:, 0])
    covered = float((np.abs(answers - centre) <= width).mean())
    with item("8.53") as check:
        check(
            float(np.abs(found.mean() / (0.1 + 0.2 * np.abs(at)).mean() - 1)),
            "<=",
            0.1,
            "sigma(x), mean of four places, relative",
        )
    with item("8.54") as check:
        ratio = float(epistemic(far).mean() / epistemic(near).mean())
        check(ratio, ">=", 5, "epistemic variance off the data, times that on it")
    with item("8.58") as check:
        check(abs(covered - 0.9), "<=", 0.08, "cover of bands for 90 %")
    with item("8.52") as check:
        entropy = lambda p: float(p.log_variance.mean())  # noqa: E731
        check(
            entropy(far) - entropy(near),
            "<=",
            2.0,
            "a member's own entropy off the data hardly rises: it misses what is epistemic",
        )


def batch_of(rng: np.random.Generator, size: int, start: int = 0) -> Batch:
    """Transitions of x' = 0.9 x + 0.2 u with the reward x u."""
    x, u = rng.normal(size=(size, 1)), rng.uniform(-1, 1, (size, 1))
    no = jnp.zeros(size, bool)
    f = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    t = Transition(f(x), f(u), f(x * u)[:, 0], no, no, f(0.9 * x + 0.2 * u), {})
    return Batch(t, jnp.arange(start, start + size), jnp.ones(size))


def test_a_linear_system_is_learned_and_planned_in(item):
    """The change of the state and the reward, standardised; the cost of a plan in the model against that in the truth."""
    learner = ModelBased(sizes=(32,), members=3, learning_rate=3e-3, horizon=5)
    state = learner.init(LINE, KEY)
    rng = np.random.default_rng(0)
    batches = [batch_of(rng, 512) for _ in range(8)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *batches)

    def epoch(state, key):
        order = jax.random.permutation(key, 8)
        return jax.lax.scan(
            lambda s, i: learner.update(s, jax.tree.map(lambda x: x[i], stacked), key)[:2], state, order
        )

    state, metrics = jax.jit(lambda s: jax.lax.scan(epoch, s, jax.random.split(KEY, 150)))(state)
    fresh = batch_of(np.random.default_rng(1), 500).transitions
    model = learner.model(state)
    encoded = jax.vmap(lambda o: model.encode(o).particles)(fresh.observation)
    words = jax.vmap(lambda p, u: model.predict(p, jnp.broadcast_to(u, (3, 1, 1))))(encoded, fresh.action)
    mean = words.mean.mean((1, 2)) * model.targets.sd()[None] + model.targets.mean[""][None]
    change = np.asarray(fresh.next_observation - fresh.observation)[:, 0]
    r2 = 1 - ((mean[:, 0] - change) ** 2).mean() / change.var()
    with item("8.47") as check:
        check(float(r2), ">", 0.99, "R^2 of one step on fresh data")
        check(float(metrics["holdout_error"][-1].mean()), "<=", 0.05, "error on what is held out, standardised")
    actions = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (5, 1)), jnp.float32)
    problem = ModelProblem(model, 5, LINE.action)
    planned = -float(total_cost(problem, model.encode(jnp.asarray([1.0])), actions, KEY))
    x, real = 1.0, 0.0
    for u in np.asarray(actions)[:, 0]:
        real += x * u
        x = 0.9 * x + 0.2 * u
    assert planned == pytest.approx(real, abs=0.15)
    feel = lambda kappa: eqx.tree_at(lambda p: p.model.risk, problem, jnp.asarray(kappa))  # noqa: E731
    values = [-float(total_cost(feel(k), model.encode(jnp.asarray([1.0])), actions, KEY)) for k in (1.0, 0.0, -1.0)]
    with item("8.51") as check:
        check(min(np.diff(values)), ">=", 0, "pessimistic, expected and optimistic values are in this order")


def two_members(propagation: str) -> LearnedModel:
    """x' = x + 1 by one member and x' = x - 1 by the other, without noise; the reward is x' by both."""
    ensemble = Ensemble.of(2, 2, (), 2, KEY)
    layer = ensemble.layers[0]
    weight = jnp.zeros_like(layer.weight).at[:, 1, 0].set(1.0)
    bias = jnp.zeros_like(layer.bias).at[:, 2:4].set(-60.0).at[0, 0].set(1.0).at[1, 0].set(-1.0)
    bias = bias.at[:, 1].set(bias[:, 0]).at[:, 4].set(-60.0)
    ensemble = eqx.tree_at(lambda e: (e.layers[0].weight, e.layers[0].bias), ensemble, (weight, bias))
    plain = rtg.nn.RunningNorm.of(Spec("box", (2,), low=(-np.inf,), high=(np.inf,)))
    return LearnedModel(ensemble, plain, plain, jnp.zeros(()), LINE.observation, LINE.action, 1, propagation)


def test_particles_and_their_members(item):
    """The mean over two models by hand: with a member for good the particles part; shuffled they wander."""
    model = two_members("tsinf")
    problem = ModelProblem(model, 4, LINE.action)
    start = model.encode(jnp.asarray([0.5]))
    total = -float(total_cost(problem, start, jnp.zeros((4, 1)), KEY))
    by_hand = np.mean([sum(0.5 + k * s for k in range(1, 5)) for s in (1, -1)])

    def spread(model: LearnedModel, key: jax.Array) -> jax.Array:
        state = model.encode(jnp.asarray([0.0]))
        for k in jax.random.split(key, 4):
            state = model.transition(state, jnp.zeros(1), k)
        return jnp.abs(state.particles[:, 0, 0])

    keys = jax.random.split(KEY, 200)
    for_good = jax.vmap(lambda k: spread(two_members("tsinf"), k))(keys)
    shuffled = jax.vmap(lambda k: spread(two_members("ts1"), k))(keys)
    with item("8.61") as check:
        check(abs(total - by_hand), "<=", 0.05, "J over two members, enumerated")
    with item("8.62") as check:
        check(
            float(jnp.abs(for_good - 4.0).max()),
            "<=",
            0.1,
            "TS-infinity: distance of both particles after four steps, from 4",
        )
        check(float(jnp.mean(shuffled**2)), "<=", 6.0, "TS1: mean square of it, from 4 (a random walk)")
        check(float(jnp.mean(shuffled**2)), ">=", 2.5, "TS1: the same")


def test_refusals():
    with pytest.raises(ValueError, match="cannot be followed for 20"):
        ModelBased(horizon=5, every=20)
    with pytest.raises(ValueError, match="holdout"):
        ModelBased(holdout=1.0)
    assert ModelBased(planner=CrossEntropy(samples=10, elites=2)).planner.samples == 10
