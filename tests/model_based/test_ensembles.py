"""Learned models: variances and where they come from, the bootstrap, and what is planned on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import rewardtogo as rtg
from rewardtogo.core import EnvSpec, Spec
from rewardtogo.model_based import (
    Ensemble,
    LearnedModel,
    Objective,
    Prediction,
    aleatoric,
    epistemic,
    output_entropy,
    total_variance,
)
from rewardtogo.model_based.ensembles import bootstrap_weights, is_held_out
from rewardtogo.planning import ModelProblem, total_cost

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
    two = Prediction(jnp.zeros((1, 1, 2)), jnp.log(jnp.asarray([[[0.2, 0.7]]])), jnp.zeros((1, 1)))
    law = rtg.ops.FullGaussian.of_covariance(jnp.zeros(2), jnp.diag(jnp.asarray([0.2, 0.7])))
    determinant = 0.5 * np.log(np.linalg.det(2 * np.pi * np.e * np.diag([0.2, 0.7])))
    with item("8.52") as check:
        check(abs(float(output_entropy(two)[0, 0]) - determinant), "<=", 1e-12, "1/2 log det(2 pi e S)")
        check(abs(float(output_entropy(two)[0, 0] - law.entropy())), "<=", 1e-12, "entropy of the Gaussian itself")


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


def two_members(propagation: str, objective: Objective | None = None, discount: float = 1.0) -> LearnedModel:
    """x' = x + 1 by one member and x' = x - 1 by the other; the reward is x' by both. Variances are as small as they can be."""
    ensemble = Ensemble.of(2, 2, (), 2, KEY)
    layer = ensemble.layers[0]
    weight = jnp.zeros_like(layer.weight).at[:, 1, 0].set(1.0)
    bias = jnp.zeros_like(layer.bias).at[:, 2:4].set(-60.0).at[0, 0].set(1.0).at[1, 0].set(-1.0)
    bias = bias.at[:, 1].set(bias[:, 0]).at[:, 4].set(-60.0)
    ensemble = eqx.tree_at(lambda e: (e.layers[0].weight, e.layers[0].bias), ensemble, (weight, bias))
    plain = rtg.nn.RunningNorm.of(Spec("box", (2,), low=(-np.inf,), high=(np.inf,)))
    plain = eqx.tree_at(lambda n: (n.square, n.count), plain, ({"": jnp.full(2, 2.0 - 2e-8)}, jnp.asarray(2.0)))
    return LearnedModel(
        ensemble, plain, plain, objective or Objective.of(), jnp.asarray(discount), jnp.zeros((), bool), LINE.observation,
        LINE.action, 1, propagation,
    )  # fmt: skip


def value(model: LearnedModel, horizon: int = 4) -> float:
    """What is planned on, from x = 0.5, whatever is done."""
    problem = ModelProblem(model, horizon, LINE.action, model.discount)
    return -float(total_cost(problem, model.encode(jnp.asarray([0.5])), jnp.zeros((horizon, 1)), KEY))


def returns(discount: float = 1.0, horizon: int = 4) -> np.ndarray:
    """Of the two members, by hand."""
    steps = np.arange(1, horizon + 1)
    return np.array([(discount ** (steps - 1) * (0.5 + s * steps)).sum() for s in (1, -1)])


def test_the_mean_over_two_members(item):
    """Two models enumerated, with the same actions for both (erratum E8.14)."""
    with item("8.61") as check:
        check(abs(value(two_members("mean")) - returns().mean()), "<=", 1e-5, "J over two members, by hand")
        discounted = value(two_members("mean", discount=0.9))
        check(abs(discounted - returns(0.9).mean()), "<=", 1e-5, "the same, discounted")
        one = value(
            eqx.tree_at(
                lambda m: m.ensemble, two_members("mean"), jax.tree.map(lambda x: x[:1], two_members("mean").ensemble)
            )
        )
        check(abs(one - returns()[0]), "<=", 1e-5, "with the first member alone")
        check(abs(value(two_members("tsinf")) - returns().mean()), "<=", 0.1, "with the least noise a member can have")


def test_objectives(item):
    """Statistics of the members' whole returns, and not sums of those of their rewards."""
    for gamma in (1.0, 0.9):
        r = returns(gamma)
        found = {
            kind: value(two_members("mean", Objective.of(kind, 0.5, 0.25), gamma))
            for kind in ("mean", "lcb", "ucb", "quantile")
        }
        wanted = {
            "mean": r.mean(),
            "lcb": r.mean() - 0.5 * r.std(),
            "ucb": r.mean() + 0.5 * r.std(),
            "quantile": np.quantile(r, 0.25),
        }
        with item("8.51") as check:
            for kind in found:
                check(
                    abs(found[kind] - wanted[kind]),
                    "<=",
                    1e-4,
                    f"{kind} of two members' returns, gamma {gamma}, by hand",
                )
            check(found["mean"] - found["lcb"], ">", 0, "expected less pessimistic")
            check(found["ucb"] - found["mean"], ">", 0, "optimistic less expected")
    samples = jax.random.normal(KEY, (10_000,))
    with item("8.51") as check:
        levels = [float(Objective.of("quantile", level=q)(samples)) for q in (0.05, 0.5, 0.95)]
        check(min(np.diff(levels)), ">=", 1.5, "quantiles of levels .05, .5 and .95 are in this order")
    slope = jax.grad(lambda r: Objective.of("lcb")(r))(jnp.ones(3))
    assert bool(jnp.isfinite(slope).all())


def test_particles_and_their_members(item):
    """With a member for good the particles part; shuffled over the members at each step they wander. In the mean they are the same here."""

    def ends(model: LearnedModel, key: jax.Array) -> jax.Array:
        state = model.encode(jnp.asarray([0.0]))
        for k in jax.random.split(key, 4):
            state = model.transition(state, jnp.zeros(1), k)
        return state.particles[:, 0, 0]

    keys = jax.random.split(KEY, 400)
    for_good = jax.jit(jax.vmap(lambda k: ends(two_members("tsinf"), k)))(keys)
    shuffled = jax.jit(jax.vmap(lambda k: ends(two_members("ts1"), k)))(keys)
    with item("8.62") as check:
        check(float(jnp.abs(jnp.abs(for_good) - 4.0).max()), "<=", 0.1, "TS-infinity: four steps up, or four down")
        check(
            abs(float(jnp.mean(shuffled**2)) / 4 - 1), "<=", 0.2, "TS1: mean square of a walk of four random steps, 4"
        )
        check(abs(float(shuffled.mean())), "<=", 0.1, "TS1: mean, from that of the linear models, 0")
        check(abs(float(for_good.mean())), "<=", 0.1, "TS-infinity: mean")
