"""Fitted value and Q-iteration: value iteration where the features are one-hot, models demanded, data of any order and policy."""

from typing import Any

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import demonstrations, jit
from rewardtogo.core import Batch, EnvSpec, Model, Transition, from_space
from rewardtogo.envs.pendulum import Pendulum
from rewardtogo.envs.tabular import MDP, TabularModel
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import optimal_q_values
from rewardtogo.value.dynamic_programming import value_iteration
from rewardtogo.value.fitted import (
    LinearValue,
    LookaheadPolicy,
    fitted_q_iteration,
    fitted_value_iteration,
    outcomes,
    value_regression_loss,
)
from rewardtogo.value.gpi import generalised_policy_iteration

S, A, GAMMA = 6, 3, 0.8


def deterministic_mdp(seed: int) -> MDP:
    rng = np.random.default_rng(seed)
    return MDP(np.eye(S)[rng.integers(0, S, (S, A))], rng.normal(size=(S, A)), 0, GAMMA, np.arange(S) == S - 1)


def one_hot(state: jax.Array) -> jax.Array:
    return jax.nn.one_hot(state, S)


def test_the_loss_has_no_derivative_through_its_targets(item):
    value = LinearValue(jnp.asarray([0.5, -1.0]), lambda s: s)
    states, rewards = jnp.asarray([[1.0, 2.0], [0.0, 1.0], [3.0, -1.0]]), jnp.asarray([1.0, 0.0, 2.0])
    targets = lambda v: rewards + 0.9 * jax.vmap(lambda s: v(2 * s))(states)  # noqa: E731
    loss = lambda w: value_regression_loss(LinearValue(w, lambda s: s), states, targets(LinearValue(w, lambda s: s)))  # noqa: E731
    with jax.enable_x64(True):
        w = jnp.asarray([0.5, -1.0])
        fixed = np.asarray(targets(LinearValue(w, lambda s: s)), np.float64)
        frozen = lambda w: 0.5 * np.sum((np.asarray(states) @ w - fixed) ** 2)  # noqa: E731
        e = 1e-6 * np.eye(2)
        differences = [(frozen(np.asarray(w) + d) - frozen(np.asarray(w) - d)) / 2e-6 for d in e]
        with item("5.10") as check:
            check(
                np.abs(np.asarray(jax.grad(loss)(w)) - differences).max(),
                "<=",
                1e-6,
                "gradient against differences, y fixed",
            )
    assert float(value_regression_loss(value, states, rewards)) == pytest.approx(0.5 * (6.25 + 1.0 + 0.25))


def test_one_hot_features_make_it_value_iteration(item):
    with item("5.11") as check:
        mdp = deterministic_mdp(0)
        states, actions = jnp.arange(S), jnp.arange(A)
        data = outcomes(TabularModel(mdp), states, actions, one_hot)
        value, fitted = np.zeros(S), np.zeros(S)
        worst = 0.0
        from rewardtogo.value.operators import bellman_backup

        for _ in range(10):
            value, fitted = bellman_backup(mdp, value), data.targets(fitted, GAMMA)
            worst = max(worst, np.abs(value - fitted).max())
        check(worst, "<=", 1e-6, "one-hot features: ten rounds against ten sweeps (rewards are float32)")
        found = fitted_value_iteration(TabularModel(mdp), states, actions, one_hot, gamma=GAMMA)
        best = value_iteration(mdp).value.values
        check(np.abs(np.asarray(found.value.weights) - best).max(), "<=", 1e-5, "at the end, against V*")
        assert found.converged
    # The maximum inside of the expectation would be another thing: that of a world where the outcome is known first (E5.5).
    risky = random_mdp(1, S, A, discount=GAMMA)
    inside = outcomes(TabularModel(risky), states, actions, one_hot, samples=200)
    wrong = (inside.rewards + GAMMA * inside.next_features @ optimal_q_values(risky).max(-1)).max(1).mean(-1)
    assert (wrong - inside.targets(optimal_q_values(risky).max(-1), GAMMA)).max() > 0.05


def test_states_that_are_sampled_and_states_that_are_enumerated(item):
    """Features one-hot on the states that were drawn; the others are worth 0. Errors fall until every state is there."""
    mdp, counts = deterministic_mdp(3), (1, 2, 4, S)
    best, order = value_iteration(mdp).value.values, np.random.default_rng(0)
    errors = []
    for count in counts:
        found = []
        for _ in range(5 if count < S else 1):
            states = jnp.asarray(order.permutation(S)[:count])
            solution = fitted_value_iteration(TabularModel(mdp), states, jnp.arange(A), one_hot, gamma=GAMMA)
            found.append(np.sqrt(np.mean((np.asarray(solution.value.weights) - best) ** 2)))
        errors.append(float(np.mean(found)))
    slope = np.polyfit(np.log(counts[:-1]), np.log(errors[:-1]), 1)[0]
    with item("5.13") as check:
        check(np.diff(errors).max(), "<", 0, "change of the error with more states")
        check(slope, "<", 0, "its slope in log-log")
        check(errors[-1], "<=", 1e-5, "error with every state there")


def test_it_demands_a_model(item):
    refused = 0
    for world in (rtg.make("FrozenLake-v1", 1), demonstrations(), None):
        with pytest.raises(ValueError, match=r"takes a model \(rtg.Model\), not .* fitted Q-iteration"):
            fitted_value_iteration(world, jnp.arange(S), jnp.arange(A), one_hot, gamma=GAMMA)  # type: ignore[arg-type]
        refused += 1
    with item("5.12") as check:
        check(refused, "==", 3, "calls without a model that were refused")


class PendulumModel(Model):
    """The equations of the pendulum; states are angle and velocity."""

    env: Pendulum = eqx.field(default_factory=Pendulum)

    def encode(self, observation):
        return jnp.stack([jnp.arctan2(observation[1], observation[0]), observation[2]])

    def transition(self, state, action, key):
        after, _ = self.env.step(state, action, key)
        return jnp.stack([(after[0] + jnp.pi) % (2 * jnp.pi) - jnp.pi, after[1]])

    def reward(self, state, action, next_state):
        return self.env.step(state, action, jax.random.key(0))[1].reward

    def terminal(self, state):
        return jnp.zeros((), bool)


def grid_features(angles: int, speeds: int) -> Any:
    """Bilinear weights on a grid of the pendulum's states, round in the angle."""

    def features(state: jax.Array) -> jax.Array:
        along = (state[0] + jnp.pi) / (2 * jnp.pi) * angles
        across = jnp.clip((state[1] + 8) / 16, 0, 1) * (speeds - 1)
        around = jnp.arange(angles)
        gap = jnp.abs(along - around)
        a = jnp.maximum(0, 1 - jnp.minimum(gap, angles - gap))
        b = jnp.maximum(0, 1 - jnp.abs(across - jnp.arange(speeds)))
        return (a[:, None] * b[None, :]).ravel()

    return features


def test_the_pendulum_on_a_grid(item):
    """Averager's features on a coarse grid against a fine one: returns of the two greedy policies from 64 starts."""
    model, actions = PendulumModel(), jnp.asarray([[-2.0], [-1.0], [0.0], [1.0], [2.0]])

    def greedy_return(angles: int, speeds: int, rounds: int) -> np.ndarray:
        features = grid_features(angles, speeds)
        th, om = jnp.meshgrid(
            jnp.linspace(-jnp.pi, jnp.pi, angles, endpoint=False), jnp.linspace(-8, 8, speeds), indexing="ij"
        )
        states = jnp.stack([th.ravel(), om.ravel()], -1)
        found = fitted_value_iteration(model, states, actions, features, gamma=0.97, rounds=rounds, tolerance=1e-2)
        policy = LookaheadPolicy(model, found.value, actions, jnp.asarray(0.97))

        def play(key: jax.Array) -> jax.Array:
            state, observation = model.env.reset(key)

            def step(loop: tuple, _: None) -> tuple:
                state, observation = loop
                _, action, _ = policy((), observation, key)
                state, t = model.env.step(state, action, key)
                return (state, t.observation), t.reward

            return jax.lax.scan(step, (state, observation), None, 200)[1].sum()

        return np.asarray(jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(0), 64)))

    coarse, fine = greedy_return(25, 25, 300), greedy_return(35, 35, 300)
    with item("5.11") as check:
        check(
            abs(coarse.mean() / fine.mean() - 1),
            "<=",
            0.1,
            f"Pendulum: {coarse.mean():.0f} on a grid of 625, {fine.mean():.0f} on 1225",
        )
        check(fine.mean(), ">=", -180, "return of the greedy policy (the optimum is about -138)")


# --- Algorithm 9 -----------------------------------------------------------------------------------------------------


def transitions(mdp: MDP, policy: np.ndarray, n: int, seed: int) -> tuple[np.ndarray, ...]:
    """States drawn uniformly, actions from a policy, one step each."""
    rng = np.random.default_rng(seed)
    s = rng.integers(0, S, n)
    a = (rng.random((n, 1)) > policy[s].cumsum(-1)).sum(-1).clip(0, A - 1)
    to = (rng.random((n, 1)) > mdp.transitions[s, a].cumsum(-1)).sum(-1).clip(0, S - 1)
    return s, a, mdp.rewards[s, a], to


def fit(mdp: MDP, data: tuple[np.ndarray, ...], **options: Any) -> np.ndarray:
    """Tabular fitted Q-iteration on transitions: Q `[S, A]`."""
    s, a, r, to = data
    pairs = np.eye(S * A).reshape(S, A, S * A)
    found = fitted_q_iteration(pairs[s, a], r, GAMMA * (1.0 - mdp.terminal[to]), pairs[to], **options)
    assert found.converged
    return found.value.reshape(S, A)


def model_of(mdp: MDP, data: tuple[np.ndarray, ...]) -> MDP:
    """The process in which every transition of the data is as likely as it is frequent."""
    s, a, r, to = data
    counts, rewards = np.zeros((S, A, S)), np.zeros((S, A))
    np.add.at(counts, (s, a, to), 1.0)
    np.add.at(rewards, (s, a), r)
    visits = counts.sum(-1)
    return MDP(counts / visits[..., None], rewards / visits, 0, GAMMA, mdp.terminal)


def test_fitted_q_iteration_solves_the_model_of_its_data(item):
    mdp = random_mdp(5, S, A, discount=GAMMA, num_terminal=1)
    live = ~mdp.terminal
    data = transitions(mdp, 0.7 * random_policy(0, S, A) + 0.1, 3000, 0)
    q = fit(mdp, data)
    shuffled = tuple(x[np.random.default_rng(9).permutation(3000)] for x in data)
    with item("5.14") as check:
        check(
            np.abs(q - optimal_q_values(model_of(mdp, data)))[live].max(),
            "<=",
            1e-6,
            "Q against Q* of the sampled model",
        )
    with item("5.18") as check:
        check(np.abs(fit(mdp, shuffled) - q).max(), "<=", 1e-10, "change of Q when the transitions are shuffled")
    exact, errors = optimal_q_values(mdp), []
    every = tuple(x.ravel() for x in np.meshgrid(np.arange(S), np.arange(A), np.arange(S), indexing="ij"))
    with item("5.15") as check:
        for seed in range(3):
            policy = 0.7 * random_policy(seed, S, A) + 0.1
            s, a, to = every
            weights = policy[s, a] * mdp.transitions[s, a, to]
            found = fit(mdp, (s, a, mdp.rewards[s, a], to), weights=weights)
            check(np.abs(found - exact)[live].max(), "<=", 1e-6, f"exact weights of policy {seed}: Q against Q*")
            sampled = fit(mdp, transitions(mdp, policy, 30_000, seed))
            errors.append(np.abs(sampled - exact)[live].max())
        # A standard error of a target with 30,000 / 18 visits, carried through 1 / (1 - γ).
        noise = GAMMA * exact.max(-1).std() / np.sqrt(30_000 * 0.1 / S) / (1 - GAMMA)
        check(max(errors) / noise, "<=", 4, "samples of three policies: standard errors from Q*")


def test_it_is_an_instance_of_general_policy_iteration():
    """evaluate: one regression on r + γ Q(s', π(s')); improve: argmax (item 5.3)."""
    mdp = random_mdp(5, S, A, discount=GAMMA, num_terminal=1)
    data = transitions(mdp, 0.7 * random_policy(0, S, A) + 0.1, 2000, 1)
    model = model_of(mdp, data)

    def regress(policy: np.ndarray, q: np.ndarray) -> np.ndarray:
        return model.rewards + GAMMA * model.continuation @ q[np.arange(S), policy]

    found = generalised_policy_iteration(
        regress, lambda q: q.argmax(-1), np.zeros(S, int), np.zeros((S, A)), until="values", tolerance=1e-10
    )
    np.testing.assert_allclose(found.value[1], fit(mdp, data), atol=1e-6)


def test_a_deep_round_is_a_regression_on_targets_that_stay():
    """`fqi` is a setting of DQN: S gradient steps towards the y of a network that is copied after them, and a loss that is squared."""
    from rewardtogo.catalogue import ALGORITHMS
    from rewardtogo.runner.config import build, resolve

    row = ALGORITHMS["fqi"]
    learner = build(
        resolve(row.path), {**row.learner, "target_period": 3, "epsilon": 0.1, "network": {"class": "mlp", "sizes": []}}
    )
    spec = EnvSpec(from_space(spaces.Box(-9, 9, (2,), np.float32)), from_space(spaces.Discrete(2)))
    state = learner.init(spec, jax.random.key(0))
    x = jnp.asarray([[1.0, 0.0], [0.0, 3.0]])
    t = Transition(
        x, jnp.asarray([0, 1]), jnp.asarray([50.0, -1.0]), jnp.asarray([False, True]), jnp.zeros(2, bool), x[::-1], {}
    )
    batch = Batch(t, jnp.arange(2, dtype=jnp.int32), jnp.ones(2))
    update = jit(lambda s: learner.update(s, batch, jax.random.key(0)))
    first = state.target
    q = lambda n, x: np.asarray(jax.vmap(lambda o: n((), o)[1])(x))[..., 0]  # noqa: E731
    y = np.array([50.0 + 0.99 * q(first, x[::-1]).max(-1)[0], -1.0])
    for i in range(3):
        before = q(state.network, x)[np.arange(2), [0, 1]]
        jax.tree.map(np.testing.assert_array_equal, state.target, first)
        state, metrics, _ = update(state)
        assert float(metrics["q_loss"]) == pytest.approx(0.5 * np.mean((before - y) ** 2), rel=1e-4), i
    jax.tree.map(np.testing.assert_array_equal, state.target, state.network)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: fitted_q_iteration(np.eye(2), np.ones(2), np.ones(2), np.zeros((2, 0))),
            "next_features (2, 0) [2, A, 2]",
        ),
        (lambda: fitted_q_iteration(np.eye(2), np.ones(2), np.ones(2), np.zeros((3, 2, 2))), "next_features (3, 2, 2)"),
        (lambda: fitted_q_iteration(np.eye(2), np.ones(2), np.ones(2), np.zeros((2, 1, 2)), rounds=0), "0 rounds"),
        (
            lambda: outcomes(TabularModel(deterministic_mdp(0)), jnp.arange(2), jnp.arange(2), one_hot, samples=0),
            "0 samples",
        ),
        (
            lambda: generalised_policy_iteration(lambda p, v: v, lambda v: v, 0, 0, until="bored"),
            "'bored' policy values",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises((ValueError, TypeError)) as refused:
        make()
    assert all(word in str(refused.value) for word in words.split()) or "Type" in type(refused.value).__name__


@pytest.mark.slow
def test_cartpole_from_random_play(tmp_path, item):
    """20,000 transitions of a uniformly random policy, seen by no learner while they were made."""
    from rewardtogo.core import env_spec
    from rewardtogo.data import Dataset
    from rewardtogo.loops import RandomPolicy, begin
    from rewardtogo.runner.evaluate_run import evaluate_run

    env = rtg.make("CartPole-v1", 1)
    policy = RandomPolicy(env_spec(env))
    play = jax.jit(lambda key: rtg.collect(env, policy, begin(env, policy, key), key, 20_000)[1].transitions)
    t = jax.tree.map(lambda x: np.array(x[:, 0]), jax.device_get(play(jax.random.key(0))))
    t.truncated[-1] = not t.terminated[-1]
    data = Dataset.of(jax.tree.map(jnp.asarray, t), env_spec(env))
    options = {"learning_rate": "linear:1e-3:1e-4", "target_period": 100, "double": True}
    run = rtg.train("fqi", "CartPole-v1", steps=15_000, data=data, learner=options, out=tmp_path / "run", quiet=True)
    # The policy of one regression is much better or worse than that of the next; the best of ten is evaluated anew.
    score = evaluate_run(str(run.path), checkpoint="best", episodes=100)["return_mean"]
    with item("5.14") as check:
        check(
            score,
            ">=",
            200,
            f"CartPole, deep: best of ten evaluations, 15,000 gradient steps; the last {run.evaluation['return_mean']:.0f}",
        )
