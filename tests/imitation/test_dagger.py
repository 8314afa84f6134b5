"""DAgger: whose actions are kept, what a round is, which policy is returned, experts of every kind, and the drift that it cures."""

from functools import partial

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imitating import run, spec_of, steps

import rewardtogo as rtg
from rewardtogo.core import env_spec
from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.imitation_problems import Lane
from rewardtogo.envs.tabular_problems import random_mdp
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.exact import expected_return, greedy_policy, optimal_q_values
from rewardtogo.imitation import BC, DAgger, Fallible, as_expert
from rewardtogo.loops.offline import Offline
from rewardtogo.nn import GRU, MLP
from rewardtogo.ops.schedules import Linear
from rewardtogo.runner.collect import Recorded, play
from rewardtogo.runner.evaluate import Evaluator

POLE = vectorize(TimeLimit(CartPole(), 100), 2)
ROAD = TimeLimit(Lane(), 200)


def balance(observation):
    """Pushes towards where the pole falls."""
    return (jnp.dot(jnp.asarray([0.1, 0.4, 3.0, 1.0]), observation) > 0).astype(jnp.int32)


def balance_in_numpy(observation: np.ndarray) -> int:
    """The same, for which JAX is no use."""
    return 1 if float(observation @ np.array([0.1, 0.4, 3.0, 1.0])) > 0 else 0


def small(expert=balance, **options) -> DAgger:
    """Rounds of 2 x 8 steps in CartPole."""
    learner = options.pop("learner", BC(network=MLP(8), learning_rate=0.01))
    expert = None if expert is None else as_expert(expert, env_spec(POLE))
    return DAgger(POLE, learner, expert, **{"unroll": 8, "updates": 3, "batch_size": 8, **options}).with_horizon(4)


@jax.jit
def step(algorithm: DAgger, state, key):
    return algorithm.step(state, key)


@jax.jit
def act(algorithm: DAgger, state, key):
    return algorithm.act(state, key)


@jax.jit
def learn(algorithm: DAgger, state, queries, labels, key, known=None):
    return algorithm.learn(state, queries, labels, key, known)


@jax.jit
def start(algorithm: DAgger, key):
    return algorithm.init(key)


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


# --- a round -----------------------------------------------------------------------------------------------------------


def test_what_is_kept_of_a_round(key, item):
    algorithm = small(beta=0.0)
    state, queries, _ = act(algorithm, start(algorithm, key), key)
    after, metrics = learn(algorithm, state, queries, queries.labels, key)
    rows = jax.tree.map(lambda x: np.asarray(x[:16]), after.data)
    labels = np.asarray(jax.vmap(balance)(rows.observation))
    done = np.swapaxes(np.asarray(queries.transitions.action), 0, 1).ravel()
    seen = np.swapaxes(np.asarray(queries.observations), 0, 1).reshape(16, 4)
    with item("2.8") as check:
        check((rows.action != labels).sum(), "==", 0, "stored actions that are not the expert's")
        check(np.abs(rows.observation - seen).max(), "==", 0, "observations against those of the learner's own path")
        check((rows.action != done).sum(), ">", 0, "stored actions that are not what was done")
        check(len(jax.tree.leaves(after.data.extras)), "==", 0, "what else is kept")
    ends = np.flatnonzero(rows.truncated | rows.terminated)
    assert {7, 15} <= set(ends.tolist())
    assert float(metrics["labels"]) == 16.0 == float(after.written)
    assert float(metrics["mistakes"]) == pytest.approx((np.asarray(queries.own) != np.asarray(queries.labels)).mean())


def test_labels_from_outside_give_the_same(key, item):
    """The labelling interface: observations out, labels in. A script that answers as the expert does changes no bit."""
    known, asked = small(beta=0.0), small(None, beta=0.0)
    states = start(known, key), start(asked, key)
    assert same(*states)
    for i in range(3):
        keys = jax.random.split(jax.random.fold_in(key, i))
        one, (_, _) = step(known, states[0], jax.random.fold_in(key, i))
        two, queries, _ = act(asked, states[1], keys[0])
        assert queries.labels is None
        labels = np.array([[balance_in_numpy(o) for o in row] for row in np.asarray(queries.observations, np.float64)])
        two, _ = learn(asked, two, queries, labels, keys[1])
        states = one, two
    different = sum(not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, states), strict=True))
    with item("2.10") as check:
        check(different, "==", 0, "arrays of the state that differ after three rounds")
    with pytest.raises(ValueError, match="there is no expert to ask: use act and learn"):
        asked.step(states[1], key)


def test_observations_without_a_label_are_left_out(key):
    """The data has the labelled rows in order, sequences end at the gaps, and mistakes are counted where somebody answered."""
    algorithm = small(None, beta=0.0)
    state, queries, _ = act(algorithm, start(algorithm, key), key)
    labels = np.asarray(jax.vmap(jax.vmap(balance))(queries.observations))
    known = np.ones((8, 2), bool)
    known[3, 0] = known[0, 1] = known[7, 1] = False
    after, metrics = learn(algorithm, state, queries, labels, key, known)
    kept = [(t, b) for b in range(2) for t in range(8) if known[t, b]]
    assert int(after.written) == 13 and float(metrics["labels"]) == 13.0
    for row, (t, b) in enumerate(kept):
        assert np.array_equal(after.data.observation[row], queries.observations[t, b])
        assert int(after.data.action[row]) == labels[t, b]
        cut = t == 7 or not known[t + 1, b]
        assert bool(after.data.truncated[row] | after.data.terminated[row]) == cut
    assert not np.any(np.asarray(after.data.observation[13:]))
    wrong = np.asarray(queries.own) != labels
    assert float(metrics["mistakes"]) == pytest.approx(wrong[known].mean())
    # Where nobody passed, it makes no difference whether that is said.
    whole, said = learn(algorithm, state, queries, labels, key), np.ones((8, 2), bool)
    assert same(whole, learn(algorithm, state, queries, labels, key, said))


def test_the_expert_acts_with_probability_beta(key):
    state = start(small(), key)
    for beta, share in ((1.0, 1.0), (0.0, None), (0.5, None)):
        algorithm = small(beta=beta, unroll=400)
        _, queries, _ = act(algorithm, state, key)
        agree = np.asarray(queries.transitions.action == queries.labels).mean()
        own = np.asarray(queries.own == queries.labels).mean()
        wanted = beta + (1.0 - beta) * own if share is None else share
        assert agree == pytest.approx(wanted, abs=0.06)
    rates = [float(small().at(i).beta) for i in range(4)]
    assert rates == [1.0, 0.0, 0.0, 0.0]
    assert float(small(beta=Linear(1.0, 0.0)).at(2).beta) == pytest.approx(0.5)


def test_one_program_for_all_rounds_and_a_ring(key, item):
    algorithm = small(capacity=40)
    state, before = start(algorithm, key), step._cache_size()
    for i in range(4):
        state, (metrics, _) = step(algorithm, state, jax.random.fold_in(key, i))
    with item("2.7") as check:
        check(step._cache_size() - before, "==", 1, "programs for four rounds of growing data")
        check(float(metrics["labels"]), "==", 64, "labels that were asked for")
    assert len(state.data.reward) == 40 and int(state.written) == 64
    assert np.array_equal(state.data.action, np.asarray(jax.vmap(balance)(state.data.observation)))


def test_the_best_policy_is_returned_and_not_the_last(key, item):
    """With a step size that makes it worse, the newest policy errs more than the one that is returned."""
    algorithm = small(learner=BC(network=MLP(8), learning_rate=Linear(0.02, 3.0)), unroll=64, updates=30)
    state, history, states = start(algorithm, key), [], []
    for i in range(4):
        states.append(state.learner)
        state, (metrics, _) = step(algorithm, state, jax.random.fold_in(key, i))
        history.append(float(metrics["mistakes"]))
    best = int(np.argmin(history[1:])) + 1
    with item("2.7") as check:
        check(float(state.best_mistakes), "==", min(history[1:]), "mistakes of the policy that is returned (E2.5)")
        check(history[-1] - min(history[1:]), ">", 0.0, "the last one judged makes more")
    assert same(algorithm.learned(state), states[best])
    assert not np.isfinite(float(start(algorithm, key).best_mistakes))


def test_demonstrations_come_first(key):
    observation = jax.random.uniform(key, (30, 4), minval=-0.05, maxval=0.05)
    data = steps(observation, jax.vmap(balance)(observation), env_spec(POLE))
    algorithm = small(demonstrations=data, beta=0.0)
    state = start(algorithm, key)
    assert int(state.written) == 30 and len(state.data.reward) == 30 + 4 * 16
    assert not same(state.learner, state.best)
    state, (metrics, _) = step(algorithm, state, key)
    # The first policy was fitted to something, and is judged.
    assert float(state.best_mistakes) == float(metrics["mistakes"])
    assert np.array_equal(state.data.observation[:30], observation)


def test_a_memory_learns_from_rounds(key):
    algorithm = small(learner=BC(network=GRU(6, MLP(5))), length=4)
    state = start(algorithm, key)
    for i in range(2):
        state, (metrics, _) = step(algorithm, state, jax.random.fold_in(key, i))
    assert np.isfinite(metrics["bc_loss"]) and int(state.written) == 32


def test_noise_follows_the_error(key, item):
    algorithm = small(beta=1.0, noise=0.3, adapt_noise=True, unroll=200)
    state = start(algorithm, key)
    _, queries, _ = act(algorithm, state, key)
    changed = np.asarray(queries.transitions.action != queries.labels).mean()
    after, (metrics, _) = step(algorithm, state, key)
    with item("2.33") as check:
        check(abs(changed - 0.15), "<=", 0.05, "share of the expert's actions that noise of 0.3 changes, two choices")
        check(abs(float(after.noise) - float(metrics["mistakes"])), "<=", 1e-7, "noise of the next round (DART)")


# --- experts -----------------------------------------------------------------------------------------------------------


def test_experts_of_every_kind(key, item):
    spec, observation = env_spec(POLE), jax.random.normal(key, (20, 4))
    wanted = np.asarray(jax.vmap(balance)(observation))
    worst = 0
    for source in (balance, balance_in_numpy, lambda o, key: balance(o), as_expert(balance, spec)):
        expert = as_expert(source, spec)
        answers = jax.jit(jax.vmap(lambda o, e=expert: e(e.init(key), o, key)[1]))(observation)
        worst = max(worst, int((np.asarray(answers) != wanted).sum()))
    with item("2.3") as check:
        check(worst, "==", 0, "answers that differ: traced, NumPy, with a key, a policy")
        returns = play(
            vectorize(TimeLimit(CartPole(), 100), 4), Recorded(as_expert(balance, spec), spec), 4, key
        ).returns
        check(returns.min(), "==", 100.0, "return of the scripted expert, cut at 100")


def test_an_expert_of_dynamic_programming_earns_its_value(item):
    mdp = random_mdp(3, 5, 3)
    q = optimal_q_values(mdp)
    table = greedy_policy(q)
    error = abs(
        expected_return(mdp, table) - float(np.asarray(mdp.initial) @ np.asarray(q)[0 if q.ndim == 3 else ...].max(-1))
    )
    with item("2.3") as check:
        check(error, "<=", 1e-9, "return of the optimal table against V*")


@pytest.mark.parametrize("votes", [1, 9])
def test_people_err_and_are_late(votes, key):
    spec = spec_of(spaces.Box(-1.0, 1.0, (1,)), spaces.Discrete(2))
    sure = as_expert(lambda o: (o[0] > 0).astype(jnp.int32), spec)
    expert = Fallible(sure, spec, noise=0.2, votes=votes)
    observation = jnp.ones((2000, 1))
    said = jax.jit(jax.vmap(lambda o, k: expert(expert.init(k), o, k)[1]))(observation, jax.random.split(key, 2000))
    # Of the replaced answers half happen to be right: one in ten is wrong.
    assert float((said == 0).mean()) == pytest.approx(0.1 if votes == 1 else 0.001, abs=0.02 if votes == 1 else 0.003)


def test_a_late_answer_is_to_an_earlier_question(key):
    spec = spec_of(spaces.Box(-1.0, 1.0, (1,)), spaces.Box(-9.0, 9.0, (1,)))
    late = Fallible(as_expert(lambda o: o, spec), spec, delay=2)
    carry, said = late.init(key), []
    for x in (1.0, 2.0, 3.0, 4.0, 5.0):
        carry, action, _ = late(carry, jnp.full(1, x), key)
        said.append(float(action[0]))
    assert said == [1.0, 1.0, 1.0, 2.0, 3.0]


# --- the drift ---------------------------------------------------------------------------------------------------------


def demonstrations(key, wind: float = 0.0):
    """One episode of the expert's without wind: it never leaves the middle."""
    env = vectorize(TimeLimit(Lane(wind), 200), 1)
    expert = as_expert(Lane().expert, env_spec(env))
    return play(env, Recorded(expert, env_spec(env)), 1, key)


@pytest.mark.slow
def test_drift_and_its_cure(key, item):
    env, learner = vectorize(ROAD, 4), BC(network=MLP(32), learning_rate=3e-3)
    spec, evaluate = env_spec(env), Evaluator(vectorize(ROAD, 50), 50)
    expert = evaluate(as_expert(Lane().expert, spec), key)[0].mean()
    cloned = Offline(demonstrations(key), learner, updates=200)
    bc = evaluate(cloned.policy(run(cloned, key, 10)[0]), key)[0].mean()
    asking = DAgger(env, learner, as_expert(Lane().expert, spec), unroll=100, updates=200)
    state, _ = run(asking, key, 10)
    dagger = evaluate(asking.policy(state), key)[0].mean()
    with item("2.7") as check:
        check(bc / expert, "<", 0.5, "return of BC from centred data, in the expert's")
        check(dagger / expert, ">=", 0.95, "return of DAgger in ten rounds, in the expert's")


# --- refusals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: small(lambda o: o), r"the expert answers with \(4,\)"),
        (lambda: small(lambda o, k, more: o), "takes 3"),
        (lambda: small("nobody"), "an expert is a policy or a function of an observation, not 'nobody'"),
        (lambda: small(capacity=5), "there is room for 5 rows, and the data to begin with and one round are 16"),
        (lambda: small(beta=1.5), r"DAgger.beta must be in \[0, 1\], not 1.5"),
        (lambda: DAgger(POLE, BC(), balance), "an expert is a policy, and <function balance"),
        (
            lambda: Fallible(as_expert(balance, env_spec(POLE)), env_spec(POLE), noise=2.0),
            "a probability from 0 to 1, not 2.0",
        ),
        (lambda: Fallible(as_expert(balance, env_spec(POLE)), env_spec(POLE), delay=-1), "a delay is at least 0 steps"),
        (lambda: small(partial(np.delete, obj=0)), "answers with 3 numbers, and an action here has 1"),
    ],
)
def test_what_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_several_seeds_learn_in_one_program(tmp_path):
    """Each judges its own policies, and has the scores that `evaluation.json` says."""
    balance = lambda observation: (observation[2] + observation[3] > 0).astype(jnp.int32)  # noqa: E731
    options = {"expert": balance, "steps": 256, "learner": {"network": {"sizes": [8]}}, "quiet": True}
    loop = {"unroll": 64, "updates": 20, "batch_size": 32}
    made = rtg.train("dagger", "CartPole-v1", num_seeds=2, loop=loop, out=tmp_path / "run", **options)
    first, second = ((r.path / "policy.safetensors").read_bytes() for r in made)
    assert first != second
    for r in made:
        assert r.evaluation is not None and r.evaluation["episodes"] == 100
