"""Learning a model and planning in it: Algorithms 19 to 21 as settings of one learner."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.core import Batch, EnvSpec, Spec, Transition
from rewardtogo.model_based import Bootstrap, Dropout, MeanField, ModelBased, Objective, fit_model
from rewardtogo.planning import CrossEntropy, LQProblem, ModelProblem, ilqr, lqr, total_cost
from rewardtogo.runner.config import build

KEY = jax.random.key(0)
LINE = EnvSpec(Spec("box", (1,), low=(-np.inf,), high=(np.inf,)), Spec("box", (1,), low=(-1.0,), high=(1.0,)))


def batch_of(rng: np.random.Generator, size: int, start: int = 0) -> Batch:
    """Transitions of x' = 0.9 x + 0.2 u with the reward x u."""
    x, u = rng.normal(size=(size, 1)), rng.uniform(-1, 1, (size, 1))
    no = jnp.zeros(size, bool)
    f = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    t = Transition(f(x), f(u), f(x * u)[:, 0], no, no, f(0.9 * x + 0.2 * u), {})
    return Batch(t, jnp.arange(start, start + size), jnp.ones(size))


def learn(learner: ModelBased, size: int = 2048, rounds: int = 80, seed: int = 0):
    """A fit to `size` transitions in eight batches, `rounds` times over; the metrics of each update."""
    rng = np.random.default_rng(seed)
    batches = [batch_of(rng, size // 8, i * (size // 8)) for i in range(8)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *batches)

    def epoch(state, key):
        order = jax.random.permutation(key, 8)
        step = lambda s, i: learner.update(s, jax.tree.map(lambda x: x[i], stacked), jax.random.fold_in(key, i))[:2]  # noqa: E731
        return jax.lax.scan(step, state, order)

    run = jax.jit(lambda s: jax.lax.scan(epoch, s, jax.random.split(KEY, rounds)))
    return run(learner.init(LINE, KEY))


def r_squared(model) -> float:
    """Of one step on fresh data."""
    fresh = batch_of(np.random.default_rng(1), 500).transitions
    encoded = jax.vmap(lambda o: model.encode(o).particles)(fresh.observation)
    words = jax.vmap(lambda p, u: model.predict(p, jnp.broadcast_to(u, (model.members, 1, 1))))(encoded, fresh.action)
    mean = words.mean.mean((1, 2)) * model.targets.sd()[None] + model.targets.mean[""][None]
    change = np.asarray(fresh.next_observation - (fresh.observation if model.predict_delta else 0.0))[:, 0]
    return float(1 - ((mean[:, 0] - change) ** 2).mean() / change.var())


@pytest.mark.parametrize(
    "learner",
    [
        ModelBased(sizes=(32,), members=3, learning_rate=5e-3, horizon=5),
        ModelBased(sizes=(32,), members=3, learning_rate=5e-3, horizon=5, predict_delta=False, probabilistic=False),
        ModelBased(sizes=(32,), members=3, learning_rate=5e-3, horizon=5, posterior=MeanField()),
        ModelBased(sizes=(32,), members=3, learning_rate=5e-3, horizon=5, posterior=Dropout(0.02), patience=100),
    ],
    ids=["bootstrap", "next-state-squares", "mean-field", "dropout-patience"],
)
def test_one_step_is_learned(item, learner):
    """The change of the state (or the next one) and the reward, standardised; what a plan is worth in the model and in truth."""
    state, metrics = learn(learner)
    model = learner.model(state)
    actions = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (5, 1)), jnp.float32)
    model = dataclasses.replace(model, propagation="mean")
    planned = -float(total_cost(ModelProblem(model, 5, LINE.action), model.encode(jnp.asarray([1.0])), actions, KEY))
    x, real = 1.0, 0.0
    for u in np.asarray(actions)[:, 0]:
        real += x * u
        x = 0.9 * x + 0.2 * u
    with item("8.47") as check:
        check(r_squared(model), ">", 0.99, "R^2 of one step on fresh data")
        check(float(metrics["holdout_error"][-1].mean()), "<=", 0.05, "error on what is held out, standardised")
        check(abs(planned - real), "<=", 0.25, "what a plan is worth, model and truth")
    with item("8.51") as check:
        feel = lambda kind: eqx.tree_at(lambda m: m.objective, model, Objective.of(kind, 1.0, 0.5))  # noqa: E731
        problem = lambda kind: ModelProblem(feel(kind), 5, LINE.action)  # noqa: E731
        start = model.encode(jnp.asarray([1.0]))
        values = [-float(total_cost(problem(kind), start, actions, KEY)) for kind in ("lcb", "mean", "ucb")]
        check(min(np.diff(values)), ">=", 0, "pessimistic, expected and optimistic values are in this order")


def test_posteriors_by_name():
    """As the command line gives them."""
    made = build(ModelBased, {"posterior": "mean_field"})
    assert isinstance(made.posterior, MeanField)
    dropped = build(ModelBased, {"posterior": {"class": "dropout", "rate": "0.2"}}).posterior
    assert isinstance(dropped, Dropout) and float(dropped.rate) == pytest.approx(0.2)
    assert build(ModelBased, {"posterior": {"resample": "false"}}).posterior == Bootstrap(False)


def test_a_fit_stops_and_goes_on():
    """With few data it stops, and waits at its best parameters; new places in the data set it going."""
    learner = ModelBased(sizes=(64, 64), members=1, horizon=5, patience=20, holdout=0.3, probabilistic=False)
    rng = np.random.default_rng(0)
    few = batch_of(rng, 40)
    noisy = few.transitions.next_observation + 0.5 * jnp.asarray(rng.normal(size=(40, 1)), jnp.float32)
    few = eqx.tree_at(lambda b: b.transitions.next_observation, few, noisy)
    update = jax.jit(learner.update)
    state, stopped, errors = learner.init(LINE, KEY), [], []
    for i in range(300):
        before = state
        state, metrics, _ = update(state, few, jax.random.fold_in(KEY, i))
        stopped.append(float(metrics["stopped"]))
        errors.append(float(state.best.least))
    assert stopped[0] == 0.0 and stopped[-1] == 1.0
    same = jax.tree.map(lambda a, b: bool((a == b).all()), before.parameters, state.parameters)
    assert all(jax.tree.leaves(same)) and np.diff(errors).max() <= 0
    more = eqx.tree_at(lambda b: b.indices, few, few.indices + 40)
    state, metrics, _ = update(state, more, KEY)
    assert float(metrics["stopped"]) == 0.0 and int(state.size) == 80


def linear_system(size: int = 400, noise: float = 0.0) -> tuple[EnvSpec, Transition, np.ndarray]:
    """Random actions in a double integrator: positions and speeds, a push."""
    F = np.array([[1.0, 0.1, 0.0], [-0.05, 0.95, 0.1]])
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(size, 2)), rng.uniform(-3, 3, (size, 1))
    after = np.concatenate([x, u], 1) @ F.T + noise * rng.normal(size=(size, 2))
    reward = -(x**2).sum(1) - 0.1 * (u**2).sum(1)
    f, no = lambda a: jnp.asarray(a, jnp.float32), jnp.zeros(size, bool)
    free = (-np.inf,)
    spec = EnvSpec(Spec("box", (2,), low=free * 2, high=(np.inf,) * 2), Spec("box", (1,), low=(-3.0,), high=(3.0,)))
    return spec, Transition(f(x), f(u), f(reward), no, no, f(after), {}), F


def test_a_linear_system_and_its_regulator(item):
    """Version 0.5, step by step: random data, a linear fit, a plan through it, carried out in the truth."""
    spec, data, F = linear_system()
    reward = lambda o, a, o_: -(o**2).sum() - 0.1 * (a**2).sum()  # noqa: E731
    found = fit_model(
        data, spec, KEY, known_reward=reward, sizes=(), members=1, posterior=Bootstrap(False), probabilistic=False,
        holdout=0.0, learning_rate=rtg.ops.Exponential(0.03, 1e-5), epochs=3000, batch_size=400, propagation="mean",
    )  # fmt: skip
    model = found.value
    step = jax.jit(lambda o, a: model.transition(model.encode(o), a, KEY).particles[0, 0])
    errors = jax.vmap(step)(data.observation, data.action) - data.next_observation
    start = np.array([1.0, -0.5])
    plan = ilqr(ModelProblem(model, 20, spec.action), model.encode(jnp.asarray(start, jnp.float32)), jnp.zeros((20, 1)))
    x, cost = start, 0.0
    for u in np.asarray(plan.value.actions):
        cost += (x**2).sum() + 0.1 * (u**2).sum()
        x = F @ np.concatenate([x, u])
    best = float(lqr(LQProblem(F, 2 * np.diag([1.0, 1.0, 0.1]), 20), start).value.cost)
    with item("8.41") as check:
        check(float(jnp.abs(errors).max()), "<", 1e-6, "largest error of one step of the model")
        check(cost / best - 1, "<=", 0.01, "true cost of the plan made in the model, over the regulator's")
        check(cost / best - 1, ">=", -1e-5, "which it cannot be below")


def test_refusals():
    with pytest.raises(ValueError, match="cannot be followed for 20"):
        ModelBased(horizon=5, every=20)
    with pytest.raises(ValueError, match="holdout"):
        ModelBased(holdout=1.0)
    with pytest.raises(ValueError, match="objective must be one of mean, lcb, ucb, quantile"):
        build(ModelBased, {"objective": "best"})
    with pytest.raises(ValueError, match="the reward is a function"):
        build(ModelBased, {"reward": "mine:r"})
    with pytest.raises(ValueError, match="cannot be 'laplace' by name"):
        build(ModelBased, {"posterior": "laplace"})
    assert ModelBased(planner=CrossEntropy(samples=10, elites=2)).planner.samples == 10
