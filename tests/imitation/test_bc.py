"""Behavioural cloning: items 2.1 and 2.2, its loss by hand, memories, masks, refusals."""

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imitating import run, spec_of, steps

from rewardtogo.core import Batch, Carry, EnvSpec, Observation, Policy, PRNGKey
from rewardtogo.data import Dataset
from rewardtogo.data.noise import EXPERT
from rewardtogo.envs.registry import make
from rewardtogo.imitation import BC
from rewardtogo.loops.offline import Offline
from rewardtogo.nn import GRU, MLP
from rewardtogo.ops.schedules import Linear
from rewardtogo.runner.collect import play
from rewardtogo.runner.evaluate import Evaluator


def fresh(learner: BC, spec: EnvSpec, key):
    """A new state, in one program: op by op a network takes seconds."""
    return jax.jit(lambda learner, key: learner.init(spec, key))(learner, key)


@jax.jit
def update(learner: BC, state, batch: Batch, key):
    return learner.update(state, batch, key)


def batch_of(dataset: Dataset) -> Batch:
    size = dataset.num_steps
    return Batch(dataset.transitions, jnp.arange(size), jnp.ones(size))


# --- item 2.1 ----------------------------------------------------------------------------------------------------------


def test_separable_tabular_expert(key, item):
    state = jax.random.randint(key, (200,), 0, 12)
    expert = jnp.asarray([0, 2, 1, 1, 0, 2, 2, 0, 1, 2, 0, 1])
    spec = spec_of(spaces.Discrete(12), spaces.Discrete(3))
    algorithm = Offline(steps(state, expert[state], spec), BC(network=MLP(), learning_rate=0.1), batch_size=64)
    learner = run(algorithm, key, 20)[0].learner
    policy = algorithm.learner.policy(learner, explore=False)
    seen = jnp.unique(state)
    act = jax.vmap(lambda o: policy((), o, key)[1])(seen)
    with item("2.1") as check:
        check(float((act == expert[seen]).mean()), "==", 1.0, "agreement with a separable tabular expert")


class Balancer(Policy):
    """Pushes towards where the pole falls: a linear rule that keeps CartPole up for 500 steps."""

    def init(self, key: PRNGKey) -> Carry:
        del key
        return ()

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey):
        del key
        lean = jnp.dot(jnp.asarray([0.1, 0.4, 3.0, 1.0]), observation)
        return carry, (lean > 0).astype(jnp.int32), {}

    def inspect(self, carry: Carry, observation: Observation):
        del carry, observation
        return {}


def test_cartpole_from_ten_episodes(key, item):
    expert = play(make("CartPole-v1", 10), Balancer(), 10, key)
    assert expert.num_episodes == 10 and expert.returns.min() == 500.0
    algorithm = Offline(expert, BC(), batch_size=64)
    keys = jax.random.split(key, 5)
    state, _ = run(algorithm, keys, 200)
    policies = jax.vmap(lambda s: algorithm.policy(s))(state)
    returns, _ = Evaluator(make("CartPole-v1", 100), 100, seeds=True)(policies, key)
    means = np.sort(returns.mean(-1))
    with item("2.1") as check:
        check(np.median(means), ">=", 475.0, "CartPole from 10 expert episodes, median of 5 seeds")
        check(means[1], ">=", 475.0, "all seeds but one")


# --- item 2.2 ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["nll", "mse"])
def test_linear_expert_without_noise(loss, key, item):
    gain = jnp.asarray([[1.0, -2.0, 0.5], [0.3, 0.0, -1.5]])
    x = jax.random.normal(key, (400, 3))
    u = x @ gain.T
    spec = spec_of(spaces.Box(-np.inf, np.inf, (3,)), spaces.Box(-20.0, 20.0, (2,)))
    learner = BC(network=MLP(), loss=loss, learning_rate=Linear(0.03, 0.0))
    state, metrics = run(Offline(steps(x, u, spec), learner, batch_size=64), key, 150)
    head = state.learner.network.head
    with item("2.2") as check:
        check(jnp.linalg.norm(20.0 * head.linear.weight - gain), "<", 1e-3, f"||K_hat - K||, {loss}")
        check(jnp.linalg.norm(20.0 * head.linear.bias), "<", 1e-3, f"bias, {loss}")
    assert np.all(np.isfinite(metrics["bc_loss"]))


def test_the_floor_of_the_standard_deviation(key):
    spec = spec_of(spaces.Box(-1.0, 1.0, (1,)), spaces.Box(-4.0, 4.0, (1,)))
    data = steps(jnp.zeros((20, 1)), jnp.ones((20, 1)), spec)
    state, metrics = run(Offline(data, BC(network=MLP(), learning_rate=0.1, min_std=0.05), batch_size=8), key, 30)
    assert np.exp(state.learner.network.head.log_std[0]) == pytest.approx(0.2, rel=1e-5)
    assert np.all(np.isfinite(metrics["bc_loss"]))


def test_the_spread_of_a_noisy_expert(key):
    spec = spec_of(spaces.Box(-1.0, 1.0, (1,)), spaces.Box(-10.0, 10.0, (1,)))
    noise = jax.random.normal(key, (2000, 1))
    data = steps(jnp.zeros((2000, 1)), 2.0 + 0.5 * noise, spec, length=100)
    learner = BC(network=MLP(), learning_rate=Linear(0.05, 0.0))
    state, _ = run(Offline(data, learner, batch_size=200), key, 50)
    head = state.learner.network.head
    assert np.exp(head.log_std[0]) == pytest.approx(float(0.5 * jnp.std(noise)), rel=0.03)
    assert 10 * head.linear.bias[0] == pytest.approx(float(2 + 0.5 * noise.mean()), abs=0.03)


# --- the loss and its parts --------------------------------------------------------------------------------------------


@pytest.fixture
def choices(key):
    """A dataset with three choices, and a learner's state with a policy that is not uniform."""
    spec = spec_of(spaces.Box(-1.0, 1.0, (2,)), spaces.Discrete(3))
    data = steps(jax.random.uniform(key, (20, 2)), jnp.arange(20) % 3, spec)
    state = fresh(BC(network=MLP(4)), spec, key)
    weight = jax.random.normal(key, state.network.head.linear.weight.shape)
    return data, eqx.tree_at(lambda s: s.network.head.linear.weight, state, weight)


def test_the_loss_is_the_cross_entropy(choices, key):
    data, state = choices
    policy = BC(network=MLP(4)).policy(state, explore=False)
    p = np.asarray(jax.vmap(lambda o: policy.inspect((), o)["probabilities"])(data.transitions.observation), np.float64)
    action = np.asarray(data.transitions.action)
    cross = -np.log(p[np.arange(20), action])
    entropy = -(p * np.log(p)).sum(1)
    weights = np.linspace(0.0, 2.0, 20)
    batch = eqx.tree_at(lambda b: b.weights, batch_of(data), jnp.asarray(weights, jnp.float32))
    _, metrics, feedback = update(BC(network=MLP(4), entropy_cost=0.3), state, batch, key)
    assert metrics["bc_loss"] == pytest.approx((weights * (cross - 0.3 * entropy)).mean(), rel=1e-5)
    assert metrics["entropy"] == pytest.approx(entropy.mean(), rel=1e-5)
    assert metrics["accuracy"] == pytest.approx((p.argmax(1) == action).mean())
    assert feedback == () and "mse" not in metrics


def test_the_squared_error(key):
    spec = spec_of(spaces.Box(-1.0, 1.0, (2,)), spaces.Box(-4.0, 4.0, (2,)))
    data = steps(jax.random.uniform(key, (20, 2)), jax.random.uniform(key, (20, 2)), spec)
    learner = BC(network=MLP(4), loss="mse")
    state = fresh(learner, spec, key)
    policy = learner.policy(state, explore=True)
    act = jax.vmap(lambda o, k: policy((), o, k)[1])(data.transitions.observation, jax.random.split(key, 20))
    greedy = learner.policy(state, explore=False)
    assert np.array_equal(act, jax.vmap(lambda o: greedy((), o, key)[1])(data.transitions.observation))
    _, metrics, _ = update(learner, state, batch_of(data), key)
    wanted = (np.asarray(act - data.transitions.action, np.float64) ** 2).mean() / 16
    assert metrics["bc_loss"] == pytest.approx(wanted, rel=1e-5) and metrics["mse"] == pytest.approx(wanted, rel=1e-5)


def test_weight_decay_is_decoupled(choices, key):
    data, state = choices
    plain = update(BC(network=MLP(4), learning_rate=0.01), state, batch_of(data), key)[0]
    decayed = update(BC(network=MLP(4), learning_rate=0.01, weight_decay=0.5), state, batch_of(data), key)[0]
    before, a, b = (s.network.head.linear.weight for s in (state, plain, decayed))
    assert np.allclose(a - b, 0.01 * 0.5 * before, atol=1e-7)


def test_labels_of_an_expert_who_was_perturbed(choices, key):
    data, state = choices
    label = (data.transitions.action + 1) % 3
    both = eqx.tree_at(lambda d: d.transitions.extras, data, {EXPERT: label})
    instead = eqx.tree_at(lambda d: d.transitions.action, data, label)
    loss = lambda d: update(BC(network=MLP(4)), state, batch_of(d), key)[1]["bc_loss"]  # noqa: E731
    assert loss(both) == loss(instead) != loss(data)


def test_normalised_observations(choices, key):
    data, _ = choices
    learner = BC(network=MLP(4), normalise_observations=True)
    state, _, _ = update(learner, fresh(learner, data.spec, key), batch_of(data), key)
    x = data.transitions.observation
    assert np.allclose(state.norm.mean[""], x.mean(0), atol=1e-6) and float(state.norm.count) == 20
    policy = learner.policy(state, explore=False)
    scaled = learner.policy(eqx.tree_at(lambda s: s.norm, state, None, is_leaf=lambda n: n is None), explore=False)
    z = (x - x.mean(0, keepdims=True)) / x.std(0, keepdims=True)
    read = lambda p, o: jax.vmap(lambda o: p.inspect((), o)["probabilities"])(o)  # noqa: E731
    assert np.allclose(read(policy, x), read(scaled, z), atol=1e-4)


@pytest.mark.parametrize(
    "action", [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2), spaces.Box(-1.0, 1.0, (2,))]
)
def test_every_kind_of_action(action, key):
    spec = spec_of(spaces.Box(-1.0, 1.0, (2,)), action)
    constant = spec.action.sample(jax.random.key(2))
    data = steps(jax.random.uniform(key, (30, 2)), jnp.broadcast_to(constant, (30, *spec.action.shape)), spec)
    state, metrics = run(Offline(data, BC(network=MLP(8), learning_rate=0.03), batch_size=16), key, 20)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(state))
    if action.dtype.kind == "f":
        assert metrics["mse"][-1] < 1e-3
    else:
        assert metrics["accuracy"][-1] == 1.0


def test_masked_actions_stay_out(key):
    mask = jnp.tile(jnp.asarray([[0, 1, 1]], jnp.int8), (20, 1))
    space = spaces.Dict({"action_mask": spaces.MultiBinary(3), "x": spaces.Box(-1.0, 1.0, (1,))})
    spec = spec_of(space, spaces.Discrete(3))
    data = steps({"action_mask": mask, "x": jax.random.uniform(key, (20, 1))}, jnp.arange(20) % 2 + 1, spec)
    learner = BC(network=MLP(4), entropy_cost=0.1)
    state, metrics, _ = update(learner, fresh(learner, spec, key), batch_of(data), key)
    assert metrics["bc_loss"] == pytest.approx(0.9 * np.log(2), rel=1e-2)
    one = jax.tree.map(lambda x: x[0], data.transitions.observation)
    assert float(learner.policy(state, explore=False).inspect((), one)["probabilities"][0]) == 0.0


# --- memories ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def echo(key):
    """The expert does what it saw one step before: nothing can be learnt from the present observation alone."""
    bit = jax.random.randint(key, (600,), 0, 2)
    first = jnp.arange(600) % 10 == 0
    return steps(bit, jnp.where(first, 0, jnp.roll(bit, 1)), spec_of(spaces.Discrete(2), spaces.Discrete(2)))


def test_a_memory_is_learnt(echo, key):
    learner = BC(network=GRU(16, MLP(8)), learning_rate=0.01)
    assert learner.batch == "sequences" and BC().batch == "transitions"
    _, metrics = run(Offline(echo, learner, batch_size=32, length=20), key, 30)
    # The first step of a window has a memory that it should not have: 1 step in 20 is a guess, half of them wrong.
    assert metrics["accuracy"][-1] > 0.95
    assert run(Offline(echo, BC(network=MLP(8)), batch_size=32), key, 30)[1]["accuracy"][-1] < 0.7


def test_replaying_is_acting(echo, key):
    learner = BC(network=GRU(4, MLP(3)))
    state = fresh(learner, echo.spec, key)
    state = eqx.tree_at(lambda s: s.network.head.linear.weight, state, jax.random.normal(key, (2, 4)))
    t = jax.tree.map(lambda x: x[:23], echo.transitions)
    policy = learner.policy(state, explore=False)

    @jax.jit
    def step(carry, observation, action, done):
        carry, distribution = state.network(carry, observation)
        fresh_carry = jax.tree.map(lambda new, old: jnp.where(done, new, old), policy.init(key), carry)
        return fresh_carry, distribution.log_prob(action)

    carry, acted = policy.init(key), []
    for inputs in zip(t.observation, t.action, t.done, strict=True):
        carry, log_prob = step(carry, *inputs)
        acted.append(log_prob)
    replayed = state.network.along(policy.init(key), t.observation, t.done)
    log_prob = jax.vmap(lambda d, a: d.log_prob(a))(replayed, t.action)
    assert np.allclose(log_prob, jnp.stack(acted), atol=1e-6)
    assert np.ptp(np.asarray(log_prob)) > 0.01


# --- refusals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make_learner", "action", "words"),
    [
        (
            lambda: BC(loss="mse"),
            spaces.Discrete(2),
            "a squared error needs actions that are boxes, and these are discrete",
        ),
        (lambda: BC(), spaces.Dict({"a": spaces.Discrete(2)}), "BC chooses discrete"),
        (lambda: BC(loss="l1"), spaces.Discrete(2), "BC.loss must be one of nll, mse, not 'l1'"),
        (lambda: BC(min_std=0.0), spaces.Discrete(2), "BC.min_std must be in"),
    ],
)
def test_what_is_refused(make_learner, action, words, key):
    with pytest.raises(ValueError, match=words):
        make_learner().init(spec_of(spaces.Box(-1.0, 1.0, (1,)), action), key)


# --- validation --------------------------------------------------------------------------------------------------------


def test_held_out_episodes_are_never_learnt_from(key):
    """Rows of whole episodes in two parts, and batches from the right one."""
    from rewardtogo.loops.offline import split_rows

    spec = spec_of(spaces.Box(0.0, 60.0, (1,)), spaces.Discrete(3))
    number = jnp.arange(60.0)[:, None]
    data = steps(number, jnp.zeros(60, jnp.int32), spec)
    rows, train = jax.jit(lambda t, k: split_rows(t, 0.3, k))(data.transitions, key)
    assert int(train) == 40 and sorted(np.asarray(rows).tolist()) == list(range(60))
    parts = [set((np.asarray(part) // 10).tolist()) for part in (rows[: int(train)], rows[int(train) :])]
    assert [len(p) for p in parts] == [4, 2] and not parts[0] & parts[1]
    assert np.all(np.diff(np.asarray(rows[: int(train)])) > 0)
    algorithm = Offline(data, BC(network=MLP(4)), batch_size=64, validation=0.3)
    state = jax.jit(lambda a, k: a.init(k))(algorithm, key)
    for training in (True, False):
        batch = algorithm._batch(state.learner, state.held_out, training, key)
        chosen = set((np.asarray(batch.transitions.observation)[:, 0] // 10).astype(int).tolist())
        held = set((np.asarray(state.held_out.rows)[int(state.held_out.train) :] // 10).tolist())
        assert chosen == held if not training else not chosen & held


def test_the_policy_is_the_best_on_held_out_data_and_learning_stops(key, item):
    """Labels without a rule: what is learnt of them is of no use for others, and the first policies are the best."""
    spec = spec_of(spaces.Box(-1.0, 1.0, (4,)), spaces.Discrete(2))
    one, two = jax.random.split(key)
    data = steps(jax.random.uniform(one, (60, 4)), jax.random.randint(two, (60,), 0, 2), spec)
    learner = BC(network=MLP(64), learning_rate=0.03)
    algorithm = Offline(data, learner, batch_size=40, updates=5, validation=0.3, patience=5)
    state, metrics = run(algorithm, key, 40)
    loss, best, stopped = (np.asarray(metrics[n]) for n in ("validation_loss", "best_validation_loss", "stopped"))
    with item("2.1") as check:
        check(
            best[-1], "==", loss[: int(np.argmax(stopped > 0))].min(), "validation loss of the policy that is returned"
        )
        check(stopped[-1], "==", 1, "learning has stopped")
        check(stopped.sum(), ">=", 20, "iterations in which nothing was learnt any more")
    assert np.array_equal(stopped, np.sort(stopped))
    differs = [
        not np.array_equal(a, b)
        for a, b in zip(*map(jax.tree.leaves, (state.learner, algorithm.learned(state))), strict=True)
    ]
    assert any(differs)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"validation": 1.0}, r"Offline.validation must be in \[0, 1\), not 1.0"),
        ({"patience": 3}, "early stopping looks at held-out episodes"),
        ({"validation": 0.2, "monitor": "no_such"}, "has no metric 'no_such' to validate by: name one of bc_loss"),
    ],
)
def test_what_validation_refuses(options, words, choices, key):
    data, _ = choices
    with pytest.raises(ValueError, match=words):
        algorithm = Offline(data, BC(network=MLP(4)), **options)
        jax.eval_shape(algorithm.step, jax.eval_shape(algorithm.init, key), key)
    with pytest.raises(ValueError, match="a dataset of one episode cannot be split"):
        Offline(data.take([0]), BC(network=MLP(4)), validation=0.5)
