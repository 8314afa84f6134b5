"""What imitation costs, exactly: rewards of imitating, bounds on mistakes, the mixture of state distributions, the tightrope."""

import itertools

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imitating import run, spec_of, steps

from rewardtogo.core import Batch, env_spec
from rewardtogo.envs.tabular import TabularEnv
from rewardtogo.envs.tabular_problems import GROUND, ROPE, TIGHTROPE_EXPERT, random_mdp, random_policy, tightrope
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.exact import (
    TablePolicy,
    enumerate_trajectories,
    expected_return,
    one_hot_policy,
    optimal_q_values,
    simulate,
    softmax_policy,
    state_distributions,
    state_mismatch,
)
from rewardtogo.imitation import (
    BC,
    DAgger,
    as_expert,
    data_mismatch,
    error_bounds,
    expected_mistakes,
    log_likelihood_reward,
    mistake_cost,
    mistake_mixture,
    mistake_probability,
    mixture_weight,
    worst_mistake,
)
from rewardtogo.loops.offline import Offline
from rewardtogo.nn import MLP

STEPPING = lambda eps: np.array([[1 - eps, eps], [1.0, 0.0]])  # noqa: E731
"""A copy of the tightrope's expert: errs with chance eps on the rope, and steps on the ground as if it were there."""
REPAIRED = lambda eps: np.array([[1 - eps, eps], [eps, 1 - eps]])  # noqa: E731
"""A copy that was told what to do on the ground as well."""


def copy(seed: int, eps: float, states: int = 4, actions: int = 3):
    """A random problem, an expert, and a stochastic copy that errs with chance at most `eps` in every state."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(seed, states, actions, horizon=6, num_terminal=seed % 2, concentration=0.3)
    expert = rng.integers(0, actions, states)
    errs = eps * rng.uniform(size=(states, 1))
    return mdp, (1 - errs) * one_hot_policy(expert, actions) + errs * random_policy(seed, states, actions), expert


def slope(horizons, values) -> float:
    """Of log values against log horizons, by least squares."""
    return float(np.polyfit(np.log(horizons), np.log(values), 1)[0])


# --- rewards and costs -------------------------------------------------------------------------------------------------


def test_the_reward_of_imitating_is_minus_the_cross_entropy(key, item):
    rng = np.random.default_rng(0)
    logits, expert, states = rng.normal(size=(5, 3)), rng.integers(0, 3, 5), rng.integers(0, 5, 400)
    policy = softmax_policy(logits)
    reward = log_likelihood_reward(policy, expert)[states].mean()
    # The cross-entropy of the empirical law of (s, a*) from the policy, over counts and not over samples.
    counts = np.zeros((5, 3))
    np.add.at(counts, (states, expert[states]), 1 / 400)
    log_pi = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
    with item("2.24") as check:
        check(abs(reward - (counts * log_pi).sum()), "<=", 1e-12, "mean reward over the data, against - cross-entropy")
    spec = spec_of(spaces.Discrete(5), spaces.Discrete(3))
    data = steps(jnp.asarray(states), jnp.asarray(expert[states]), spec)
    learner = BC(network=MLP(), learning_rate=0.05)
    state, _ = run(Offline(data, learner, batch_size=400), key, 20)
    act = learner.policy(state.learner, True)
    table = jax.jit(jax.vmap(lambda o: act.inspect((), o)["probabilities"]))(jnp.arange(5))
    table = np.asarray(table, np.float64)
    batch = Batch(data.transitions, jnp.arange(400), jnp.ones(400))
    loss = jax.jit(lambda s: learner.update(s, batch, key)[1]["bc_loss"])(state.learner)
    with item("2.24") as check:
        found = log_likelihood_reward(table / table.sum(-1, keepdims=True), expert)[states].mean()
        check(
            abs(found + float(loss)), "<=", 1e-5, "mean reward of a fitted network, against - the loss of BC (float32)"
        )


def test_the_mistake_cost(item):
    worst = 0.0
    for seed in range(50):
        _, policy, expert = copy(seed, 1.0)
        cost = mistake_cost(np.arange(3)[None], expert[:, None])
        worst = max(worst, np.abs((policy * cost).sum(-1) - mistake_probability(policy, expert)).max())
    with item("2.25") as check:
        check(worst, "<=", 1e-12, "E[1(a != pi*(s))] against 1 - pi(pi*(s) | s)")
        check(mistake_cost(np.array([0, 1, 2]), np.array([0, 2, 2])).sum(), "==", 1, "mistakes of 0 1 2 against 0 2 2")
        sure = one_hot_policy(np.array([0, 1]), 2)
        check(
            np.isneginf(log_likelihood_reward(sure, np.array([0, 0]))[1]),
            "==",
            1,
            "log-likelihood of a sure learner: 0 or -inf (E2.6)",
        )


def test_expected_mistakes_by_enumeration():
    mdp, policy, expert = copy(3, 0.8, states=3, actions=2)
    mdp = type(mdp)(mdp.transitions, mdp.rewards, mdp.initial, 1.0, mdp.terminal, 3)
    every, log_chance = enumerate_trajectories(mdp, policy)
    chance = np.exp(log_chance)
    acting = np.arange(3) < np.asarray(every.lengths)[:, None]
    costs = mistake_cost(np.asarray(every.actions), expert[np.asarray(every.observations)[:, :-1]]) * acting
    assert np.isclose(chance.sum(), 1)
    assert np.allclose(expected_mistakes(mdp, policy, expert), chance @ costs, atol=1e-12)


# --- bounds ------------------------------------------------------------------------------------------------------------


def test_the_calculator(item):
    found = error_bounds(0.05, 30)
    with item("2.26") as check:
        check(abs(found.tightrope - 15.0781), "<=", 5e-5, "tightrope at eps = 0.05, T = 30, from 15.0781")
        closed = 30 - 0.95 * (1 - 0.95**30) / 0.05
        check(abs(found.tightrope - closed), "<=", 1e-12, "from its closed form")
        check(abs(found.sharp - 23.25), "<=", 1e-12, "eps T (T + 1) / 2, from 23.25")
        check(abs(found.quadratic - 45), "<=", 1e-12, "eps T^2, from 45")
        check(abs(found.printed - 48), "<=", 1e-12, "what is printed, from 48")
        check(np.abs(found.l1 - 2 * (1 - 0.95 ** np.arange(30))).max(), "<=", 1e-15, "L1 bound")
        check((found.l1 - found.l1_linear).max(), "<=", 1e-15, "L1 bound beyond 2 eps t")
        # Adding up the bounds of each step gives the totals (E2.4).
        check(
            abs((0.05 + found.l1_linear).sum() - found.quadratic),
            "<=",
            1e-12,
            "sum of eps + 2 eps t, t from 0, from eps T^2",
        )
        check(
            abs((0.05 + 2 * 0.05 * np.arange(1, 31)).sum() - found.printed),
            "<=",
            1e-12,
            "the same from t = 1, from the printed one",
        )
    grid = [error_bounds(e, n) for e in (0.0, 1e-9, 0.01, 0.3, 1.0) for n in (1, 2, 17, 200)]
    order = max(
        a - b for g in grid for a, b in itertools.pairwise((g.linear, g.tightrope, g.sharp, g.quadratic, g.printed))
    )
    assert order <= 1e-9
    assert error_bounds(1e-12, 3).tightrope == pytest.approx(6e-12, rel=1e-9)


def test_the_exponent_of_the_mixture(item):
    """Counting from 1 the exponent is t - 1 (E2.2); the printed one, t, would put weight on mistakes in s_1, before any action."""
    t = np.arange(1, 9)
    with item("2.26") as check:
        check(np.abs(mixture_weight(0.1, t, first=1) - 0.9 ** (t - 1)).max(), "==", 0, "weights from t = 1")
        check(np.abs(mixture_weight(0.1, t - 1) - mixture_weight(0.1, t, first=1)).max(), "==", 0, "and from t = 0")
        check(float(mixture_weight(0.1, 1, first=1)), "==", 1, "weight at the first state")
    with item("2.29") as check:
        eps, times = np.linspace(0, 1, 100)[:, None], np.arange(100)
        gap = [mixture_weight(float(e), times) - mixture_weight(float(e), times, on_average=True) for e in eps[:, 0]]
        check(np.min(gap), ">=", -1e-12, "(1 - eps)^t - (1 - eps t), 100 x 100")


def test_the_residual_is_a_distribution(item):
    least, sums, identity, beyond, gain = np.inf, 0.0, 0.0, -np.inf, 0.0
    for seed in range(200):
        mdp, policy, expert = copy(seed, 0.3)
        eps = worst_mistake(mdp, policy, expert)
        parts = mistake_mixture(mdp, policy, expert)
        train, own = (state_distributions(mdp, p) for p in (one_hot_policy(expert, 3), policy))
        least, sums = min(least, parts.mistake.min()), max(sums, np.abs(parts.mistake.sum(-1) - 1).max())
        whole = parts.keep[:, None] * train + (1 - parts.keep)[:, None] * parts.mistake
        identity = max(
            identity, np.abs(whole - own).max(), np.abs(parts.keep - mixture_weight(eps, np.arange(7))).max()
        )
        bounds = error_bounds(eps, 6)
        beyond = max(beyond, (2 * state_mismatch(mdp, policy, one_hot_policy(expert, 3))[:-1] - bounds.l1).max(),
                     expected_mistakes(mdp, policy, expert).sum() - bounds.tightrope)  # fmt: skip
        gain = max(gain, mistake_probability(policy, expert).max() - eps)
    with item("2.30") as check:
        check(least, ">=", -1e-12, "least entry of p_mistake, 200 random MDPs, all t")
        check(sums, "<=", 1e-12, "its sum from 1")
        check(identity, "<=", 1e-12, "the mixture against p_theta, and its weights against (1 - eps)^t")
    with item("2.26") as check:
        check(beyond, "<=", 1e-12, "L1 distances and mistakes beyond their bounds, 200 random MDPs")


def test_only_the_experts_own_states_count(item):
    """What the copy does where the expert never is changes nothing of the mixture: on the ground it always errs."""
    mdp = tightrope(6)
    parts = mistake_mixture(mdp, STEPPING(0.1), TIGHTROPE_EXPERT)
    with item("2.30") as check:
        check(
            worst_mistake(mdp, STEPPING(0.1), TIGHTROPE_EXPERT),
            "<=",
            0.1 + 1e-15,
            "eps of a copy that is lost on the ground",
        )
        check(np.abs(parts.mistake[1:] - [0, 1]).max(), "<=", 1e-12, "p_mistake: the ground")


def test_a_mean_mistake_gives_less(item):
    """With eps only on average over the expert's states, (1 - eps)^t is no weight that always holds, 1 - eps t is (E2.2)."""
    power, union = np.inf, np.inf
    for seed in range(200):
        mdp, policy, expert = copy(seed, 0.9)
        train, own = (state_distributions(mdp, p) for p in (one_hot_policy(expert, 3), policy))
        errs = mistake_probability(policy, expert)
        eps = float(((train[:-1] * ~mdp.terminal) @ errs).max())  # the greatest mean over the times
        common = np.minimum(train, own).sum(-1)
        union = min(union, (common - mixture_weight(eps, np.arange(7), on_average=True)).min())
        power = min(power, (common - mixture_weight(eps, np.arange(7))).min())
    with item("2.26") as check:
        check(union, ">=", -1e-12, "what p_theta and p_train share, less 1 - eps t, with eps a mean")


# --- where the states go -----------------------------------------------------------------------------------------------


def test_the_mismatch_of_distributions(item):
    mdp = tightrope(40, recovers=False)
    expert = one_hot_policy(TIGHTROPE_EXPERT, 2)
    found = state_mismatch(mdp, STEPPING(0.05), expert)
    with item("2.5") as check:
        check(found[0], "==", 0, "total variation before anything was done")
        check(np.diff(found).min(), ">", 0, "its least growth in a step, on a tightrope")
        check(
            np.abs(found - (1 - 0.95 ** np.arange(41))).max(), "<=", 1e-12, "from 1 - (1 - eps)^t: the bound is reached"
        )
        check(state_mismatch(mdp, expert, expert).max(), "==", 0, "of the expert from itself")
        sampled = simulate(TabularEnv(mdp), TablePolicy(jnp.asarray(STEPPING(0.05))), jax.random.key(0), 4000, 40)
        fallen = (np.asarray(sampled.observations) == GROUND).mean(0)
        error = np.abs(fallen - found) / np.maximum(np.sqrt(found * (1 - found) / 4000), 1e-9)
        check(error[1:].max(), "<=", 4, "standard errors between it and 4,000 episodes, any t")


HORIZONS = np.array([8, 16, 32, 64])


def test_the_tightrope_is_quadratic(key, item):
    eps = 1e-4
    exact = [expected_mistakes(tightrope(int(n)), STEPPING(eps), TIGHTROPE_EXPERT).sum() for n in HORIZONS]
    bounds = [error_bounds(eps, int(n)) for n in HORIZONS]
    policy = TablePolicy(jnp.asarray(STEPPING(0.05)))
    drawn = simulate(TabularEnv(tightrope(30)), policy, key, 4000, 30)
    labels = TIGHTROPE_EXPERT[np.asarray(drawn.observations)[:, :-1]]
    mistakes = mistake_cost(np.asarray(drawn.actions), labels).sum(-1)
    error = abs(mistakes.mean() - error_bounds(0.05, 30).tightrope) / (mistakes.std(ddof=1) / np.sqrt(4000))
    with item("2.27") as check:
        check(slope(HORIZONS, exact), ">=", 1.8, "slope of log mistakes against log T, eps = 1e-4, T = 8..64")
        check(slope(HORIZONS, exact), "<=", 2.05, "the same")
        check(
            max(abs(a - b.tightrope) for a, b in zip(exact, bounds, strict=True)), "<=", 1e-12, "from the closed form"
        )
        check(error, "<=", 3, "standard errors between it and 4,000 episodes, eps = 0.05, T = 30")


@pytest.mark.parametrize("recovers", [True, False])
def test_labels_on_the_ground_make_it_linear(recovers, item):
    eps, horizons = 0.01, (8, 16, 32, 64, 128)
    problems = [tightrope(n, recovers=recovers) for n in horizons]
    exact = np.array([expected_mistakes(mdp, REPAIRED(eps), TIGHTROPE_EXPERT).sum() for mdp in problems])
    lost = [n - expected_return(mdp, REPAIRED(eps)) for n, mdp in zip(horizons, problems, strict=True)]
    name = "with a way back" if recovers else "without a way back"
    with item("2.28") as check:
        check(abs(slope(horizons, exact) - 1), "<=", 0.1, f"slope of log mistakes against log T, from 1, {name}")
        check((exact - eps * np.array(horizons)).max(), "<=", 2, f"mistakes beyond eps T, {name}")
        if recovers:
            check(slope(horizons, lost), "<=", 1.1, "slope of the reward that is lost, with a way back")
        else:
            check(
                slope(horizons, lost), ">=", 1.7, "slope of the reward that is lost without one: quadratic again (E2.5)"
            )


def test_the_data_comes_to_look_like_the_policy(key, item):
    """As DAgger goes on, what it has learnt from is ever more of what its policy comes to (notes 2.2)."""
    mdp, horizon = random_mdp(5, 8, 3, concentration=0.1), 20
    labels = jnp.asarray(optimal_q_values(mdp).argmax(-1), jnp.int32)
    env = vectorize(TimeLimit(TabularEnv(mdp), horizon), 16)
    learner = BC(network=MLP(), learning_rate=0.1)
    expert = as_expert(lambda o: labels[o], env_spec(env))
    algorithm = DAgger(env, learner, expert, unroll=horizon, updates=30, beta=0.0).with_horizon(16)
    step = jax.jit(lambda state, key: algorithm.step(state, key)[0])
    act = jax.jit(lambda s: jax.vmap(lambda o: learner.policy(s, False)((), o, key)[1])(jnp.arange(8)))
    state, found = jax.jit(lambda k: algorithm.init(k))(key), []
    for i in range(16):
        state = step(state, jax.random.fold_in(key, i))
        seen = np.asarray(state.data.observation[: int(state.written)])
        policy = one_hot_policy(np.asarray(act(state.learner)), 3)
        found.append(data_mismatch(mdp, seen, policy, horizon))
    with item("2.11") as check:
        check(found[0], ">", 0.1, "total variation between the data and the policy after a round")
        check(found[-1], "<", 0.05, "after 16 rounds")
        order = np.corrcoef(np.argsort(np.argsort(found)), np.arange(16))[0, 1]
        check(order, "<", -0.8, "rank correlation with the round")


def test_what_is_refused():
    mdp, policy, expert = copy(1, 0.3)
    with pytest.raises(ValueError, match=r"eps is 1\.2 and total variation lies in"):
        error_bounds(1.2, 3)
    with pytest.raises(ValueError, match="the horizon is 0"):
        error_bounds(0.1, 0)
    with pytest.raises(ValueError, match="t is 0 and time counts from 1"):
        mixture_weight(0.1, 0, first=1)
    with pytest.raises(ValueError, match="give one of the actions for each state"):
        mistake_probability(policy, np.array([0, 1, 5, 0]))
    with pytest.raises(ValueError, match="may be negative: give eps of at least"):
        mistake_mixture(mdp, policy, expert, eps=1e-4)
    with pytest.raises(ValueError, match="the states of the data must be numbers from 0 to 3"):
        data_mismatch(mdp, np.array([0, 4]), policy)
    assert data_mismatch(tightrope(4), np.array([ROPE, ROPE]), STEPPING(0.0)) == 0
