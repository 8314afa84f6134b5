"""Planners that guess: random shooting, the cross-entropy method, MPPI; and model predictive control with any of them."""

import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import quadratic, swing_up

from rewardtogo.core import Spec, env_spec
from rewardtogo.envs import MDP, CartPole, KnownModel, Pendulum, TabularModel
from rewardtogo.planning import (
    MPC,
    CrossEntropy,
    FunctionProblem,
    LQProblem,
    ModelProblem,
    best_open_loop,
    box,
    cem,
    lqr,
    lqr_infinite,
    mppi,
    open_loop_return,
    random_shooting,
    total_cost,
    why,
)
from rewardtogo.planning.mpc import PLANNERS
from rewardtogo.planning.shooting import mean_costs
from rewardtogo.value import backward_induction

KEY = jax.random.key(0)
NOWHERE = jnp.zeros(1)
COIN = Spec("discrete", (), "int32", counts=(2,))


def coin_process() -> MDP:
    """A coin falls, and then is to be named: 1 for the right name. Whoever looks first is always right."""
    transitions = np.zeros((4, 2, 4))
    transitions[0, :, 1:3] = 0.5
    transitions[1:3, :, 3] = 1.0
    transitions[3, :, 3] = 1.0
    rewards = np.zeros((4, 2))
    rewards[1, 0] = rewards[2, 1] = 1.0
    return MDP(transitions, rewards, initial=np.eye(4)[0], terminal=np.eye(4, dtype=bool)[3], horizon=2)


def test_feedback_is_worth_something(item, x64):
    """Two coins: half without looking and all with; never less on 500 random processes; enumeration against simulation."""
    coins = coin_process()
    rng, worst = np.random.default_rng(0), np.inf
    policies, gap = 0.0, 0.0
    for seed in range(500):
        mdp = MDP(
            rng.dirichlet(np.ones(3), (3, 2)), rng.normal(size=(3, 2)), initial=rng.dirichlet(np.ones(3)), horizon=3
        )
        value = np.zeros(3)
        for _ in range(3):
            value = (mdp.rewards + mdp.transitions @ value).max(1)
        closed = float(mdp.initial @ value)
        worst = min(worst, closed - float(best_open_loop(mdp, 3).stats["return"]))
        if seed == 0:
            # All deterministic policies of three steps, one by one.
            tables = itertools.product(itertools.product(range(2), repeat=3), repeat=3)
            best = -np.inf
            for table in tables:
                value = np.zeros(3)
                for actions in reversed(table):
                    chosen = list(actions)
                    value = mdp.rewards[range(3), chosen] + mdp.transitions[range(3), chosen] @ value
                best = max(best, float(mdp.initial @ value))
            solved = float(mdp.initial @ backward_induction(mdp, 3).value.values)
            policies = max(policies, abs(best - solved), abs(closed - solved))
    sequence = np.array([0, 1, 1])
    exact = open_loop_return(mdp, sequence)
    problem = ModelProblem(TabularModel(mdp), 3, COIN)
    starts = jax.random.choice(KEY, 3, (20_000,), p=jnp.asarray(mdp.initial))
    draw = jax.jit(jax.vmap(lambda s, k: -total_cost(problem, s, jnp.asarray(sequence), k)))
    samples = draw(starts.astype(jnp.int32), jax.random.split(KEY, 20_000))
    gap = abs(float(samples.mean()) - exact) / (float(samples.std()) / 20_000**0.5)
    with item("8.4") as check:
        check(gap, "<=", 4, "E[sum of rewards] of a sequence, simulated, in standard errors from enumeration")
    with item("8.5") as check:
        check(policies, "<=", 1e-12, "dynamic programming against the best of all policies")
    with item("8.6") as check:
        check(float(backward_induction(coins, 2).value.values[0]), "==", 1.0, "coin, closed loop")
        check(float(best_open_loop(coins, 2).stats["return"]), "==", 0.5, "coin, open loop")
        check(worst, ">=", -1e-12, "least advantage of feedback on 500 processes")


def test_random_shooting(item):
    """The order statistic of the best of N on (u - 0.2)^2, u uniform on [-1, 1]; more samples of the same seed are never worse."""
    problem = FunctionProblem(lambda x, u: x, lambda x, u: jnp.abs(u[0] - 0.2), 1, box(1, -1, 1))
    keys = jax.random.split(KEY, 2000)
    best = jax.jit(jax.vmap(lambda k: random_shooting(problem, NOWHERE, k, samples=100).value.cost))(keys)
    # P(|u - 0.2| > d) = (1 - d)^N for d < 0.8.
    expected = 1 / 101
    costs = [float(random_shooting(problem, NOWHERE, KEY, samples=n).value.cost) for n in (1, 10, 100, 1000)]
    with item("8.9") as check:
        off = abs(float(best.mean()) - expected) / (float(best.std()) / 2000**0.5)
        check(off, "<=", 4, "mean of the best of 100 in 2000 runs, in standard errors from 1/101")
        check(float(np.diff(costs).max()), "<=", 0, "largest rise of the cost from N to 10 N samples of one seed")


def test_dimensions(item):
    """A thousand evaluations each: guessing loses to the cross-entropy method from ten dimensions on."""
    found = {}
    for size in (2, 10, 30):
        problem, _ = quadratic(size, 2.0)
        keys = jax.random.split(KEY, 10)
        guess = jax.jit(jax.vmap(lambda k: random_shooting(problem, NOWHERE, k, samples=1000).value.cost))  # noqa: B023
        settle = jax.jit(
            jax.vmap(lambda k: cem(problem, NOWHERE, k, samples=100, elites=10, iterations=10).value.cost)  # noqa: B023
        )
        found[size] = float(jnp.median(guess(keys))), float(jnp.median(settle(keys)))
    successes = {}
    for size in (5, 20, 50, 100):
        problem, _ = quadratic(size, 5.0)
        run = jax.jit(
            jax.vmap(lambda k: cem(problem, NOWHERE, k, samples=200, elites=20, iterations=25).value.cost)  # noqa: B023
        )
        successes[size] = float((run(jax.random.split(KEY, 10)) < 1e-2 * size).mean())
    with item("8.10") as check:
        check(found[10][1], "<", found[10][0], "CEM's cost against random shooting's, d = 10")
        check(found[30][1], "<", found[30][0], "CEM's cost against random shooting's, d = 30")
    with item("8.15") as check:
        check(successes[5], ">=", 0.9, "share of successes with 200 samples, d = 5")
        check(successes[100], "<", 0.5, "share of successes with 200 samples, d = 100")


def test_cross_entropy(item):
    problem, target = quadratic(10)
    run = lambda k, **options: cem(problem, NOWHERE, k, samples=200, elites=20, **options)  # noqa: E731
    settled = run(KEY, iterations=100, tolerance=1e-3, result="mean")
    capped = run(KEY, iterations=7, tolerance=0.0)
    spreads = np.asarray(settled.stats["spreads"])
    last = int(settled.stats["iterations"])
    rastrigin = FunctionProblem(
        lambda x, u: x, lambda x, u: 20 + (u**2 - 10 * jnp.cos(2 * np.pi * u)).sum(), 1, box(2, -5.12, 5.12)
    )
    many = jax.jit(jax.vmap(lambda k: cem(rastrigin, NOWHERE, k, samples=200, elites=20, iterations=50).value.cost))
    bits = jnp.asarray(np.random.default_rng(0).integers(0, 2, 20))
    one_max = FunctionProblem(
        lambda x, u, t: x, lambda x, u, t: (u != bits[t]).astype(jnp.float32), 20, COIN, timed=True
    )
    words = jax.jit(jax.vmap(lambda k: cem(one_max, NOWHERE, k, samples=200, elites=20, iterations=40).value.cost))
    # Far from where it begins: without a floor the deviation is gone before the mean has arrived.
    far = FunctionProblem(lambda x, u: x, lambda x, u: ((u - 20.0) ** 2).sum(), 1, 5)
    fast = lambda floor: cem(far, NOWHERE, KEY, samples=50, elites=3, iterations=40, floor=floor, tolerance=0.0)  # noqa: E731
    plain, floored = float(fast(0.0).value.cost), float(fast(0.5).value.cost)
    with item("8.11") as check:
        check(last, "<=", 30, "iterations on a ten-dimensional quadratic")
        check(float(jnp.abs(settled.value.actions[0] - target).max()), "<=", 1e-3, "error of the mean there")
        check(int((many(jax.random.split(KEY, 10)) < 1e-2).sum()), ">=", 8, "successes of 10 on Rastrigin's function")
    with item("8.12") as check:
        check(int((words(jax.random.split(KEY, 10)) == 0).sum()), "==", 10, "successes of 10 on twenty bits")
    with item("8.13") as check:
        check(int(capped.stats["evaluations"]), "==", 200 * 7, "evaluations")
        check(why(capped.stats["reason"]) == "max_iters", "==", True, "reason")
    with item("8.14") as check:
        check(float(spreads[last - 1]), "<", 1e-3, "largest deviation at the end")
        check(float(spreads[: last - 1].min()), ">=", 1e-3, "and never before")
        check(why(settled.stats["reason"]) == "converged", "==", True, "reason")
    with item("8.17") as check:
        check(floored, "<", plain / 10, "cost with a floor under the deviation, on a shifted objective")
        warm = run(KEY, iterations=3, guess=target[None], sd=0.01)
        check(float(warm.value.cost), "<", float(run(KEY, iterations=3).value.cost), "cost from a warm start")
    soft = mppi(problem, NOWHERE, KEY, samples=500, iterations=40, temperature=5.0, floor=0.05)
    assert float(soft.value.cost) < 0.1


def test_candidates_are_weighed_side_by_side(item):
    """The same numbers as one by one, and much sooner."""
    problem = swing_up(50)
    start = jnp.asarray([np.pi, 0.0])
    candidates = jax.random.normal(KEY, (500, 50, 1))
    # As users' programs are compiled, and not as tests are (tests/conftest.py).
    usual = {"xla_backend_optimization_level": 3}
    batch = jax.jit(lambda c: mean_costs(problem, start, c, KEY), compiler_options=usual)
    one = jax.jit(lambda u: total_cost(problem, start, u, KEY), compiler_options=usual)
    together, alone = batch(candidates), [one(u) for u in candidates]
    clock = lambda f: (time.perf_counter(), jax.block_until_ready(f()), time.perf_counter())  # noqa: E731
    # The least of several times each: another process that takes the core meanwhile only ever adds.
    batched, looped = [], []
    for _ in range(8):
        a, _, b = clock(lambda: batch(candidates))
        c, _, d = clock(lambda: [one(u) for u in candidates])
        batched.append(b - a)
        looped.append(d - c)
    with item("8.16") as check:
        check(float(np.abs(np.asarray(together) - np.asarray(alone)).max()), "<=", 1e-4, "batch against the loop")
        check(min(looped) / min(batched), ">=", 10, "how much sooner 500 are done together")


def test_mpc_is_the_regulator(item, x64):
    """On a linear-quadratic problem with the horizon that is left it does what Algorithm 17 does; replanning less often changes nothing
    where the model is right, and costs where it is wrong.
    """
    F, C = np.array([[1.0, 0.1, 0.0], [0.2, 1.0, 0.1]]), np.diag([1.0, 0.1, 0.1])
    start = np.array([1.0, 0.0])
    whole = lqr(LQProblem(F, C, 6), start).value
    x, actions = start, []
    for t in range(6):
        actions.append(np.asarray(lqr(LQProblem(F, C, 6 - t), x).value.actions[0]))
        x = F @ np.concatenate([x, actions[-1]])
    truth = F + np.array([[0.0, 0.05, 0.0], [0.1, 0.0, -0.03]])
    costs = []
    for every in (1, 3, 6):
        x, total = start, 0.0
        for t in range(0, 24, every):
            plan = np.asarray(lqr(LQProblem(F, C, 6), x).value.actions)
            for u in plan[:every]:
                z = np.concatenate([x, u])
                total += 0.5 * z @ C @ z
                x = truth @ z
            del t
        costs.append(total)
    unstable = np.array([[2.0, 1.0]])
    price = np.diag([1.0, 5.0])
    end = np.asarray(lqr_infinite(unstable, price).value.V[0])
    ends = {}
    for name, final in (("none", None), ("regulator", end)):
        x = np.array([1.0])
        for _ in range(24):
            u = np.asarray(lqr(LQProblem(unstable, price, 1, C_final=final), x).value.actions[0])
            x = unstable @ np.concatenate([x, u])
        ends[name] = abs(float(x[0]))
    with item("8.45") as check:
        check(
            float(np.abs(np.asarray(actions) - whole.actions).max()),
            "<=",
            1e-10,
            "MPC with the horizon that is left, LQR",
        )
    with item("8.46") as check:
        check(
            float(np.diff(costs).min()),
            ">=",
            0,
            "with a wrong model: least rise of the cost from replanning less often",
        )
    with item("8.48") as check:
        check(
            ends["regulator"],
            "<=",
            1e-6,
            "unstable system, one step ahead with the regulator's value at the end: |x| after 24",
        )
        check(ends["none"], ">=", 1e6, "and without it")


def test_short_plans_made_often_beat_a_long_one(item):
    """The pendulum as it is planned for weighs a fifth less than it is: plans of 15 steps at every step against one of 60, half of it
    done."""

    def heavy(x: jax.Array, u: jax.Array) -> jax.Array:
        spin = x[1] + 0.05 * (15 * jnp.sin(x[0]) + 2.4 * u[0] - 0.2 * x[1])
        return jnp.stack([x[0] + 0.05 * spin, spin])

    planned = swing_up()
    costs = {}
    for horizon, every in ((15, 1), (60, 60)):
        problem = planned.with_horizon(horizon)

        @jax.jit
        def plan(x, guess, key, problem=problem):
            return cem(
                problem, x, key, samples=100, elites=10, iterations=5, guess=guess, floor=0.1, result="mean"
            ).value.actions

        x, guess, total = jnp.asarray([0.6, 0.0]), jnp.zeros((horizon, 1)), 0.0
        move = jax.jit(lambda x, u: (heavy(x, u), planned.running(x, u)))
        for t in range(60):
            if t % every == 0:
                actions = plan(x, guess, jax.random.fold_in(KEY, t))
                guess = jnp.concatenate([actions[1:], actions[-1:]])
            x, cost = move(x, actions[t % every])
            total += float(cost)
        costs[horizon] = total
    with item("8.46") as check:
        check(costs[15], "<=", costs[60], "cost with a wrong model: short and often against long and once")


@pytest.mark.parametrize("name", ["cem", "mppi", "ilqr", "random_shooting"])
def test_mpc_plays_an_environment(name):
    """Every recipe as a policy, in the pendulum's own environment: it comes up and stays there."""
    env = Pendulum()
    problem = ModelProblem(KnownModel(env), 20, env_spec(env).action)
    cls, options = PLANNERS[name]
    policy = MPC(problem, cls(**options))

    def step(loop: tuple, key: jax.Array) -> tuple[tuple, jax.Array]:
        carry, state, observation = loop
        carry, action, _ = policy(carry, observation, key)
        state, timestep = env.step(state, env_spec(env).action.clip(action), key)
        return (carry, state, timestep.observation), timestep.reward

    state = jnp.asarray([1.5, 0.0])
    observation = jnp.asarray([np.cos(1.5), np.sin(1.5), 0.0], jnp.float32)
    loop = jax.jit(lambda k: jax.lax.scan(step, (policy.init(k), state, observation), jax.random.split(k, 80))[1])
    rewards = loop(KEY)
    # Random guesses shake.
    assert float(rewards[-10:].mean()) > (-0.5 if name == "random_shooting" else -0.02)


def test_discrete_mpc_balances(item):
    env = CartPole()
    policy = MPC(
        ModelProblem(KnownModel(env), 50, env_spec(env).action),
        CrossEntropy(samples=100, elites=10, iterations=3),
        every=2,
    )

    def step(loop: tuple, key: jax.Array) -> tuple[tuple, jax.Array]:
        carry, state = loop
        carry, action, _ = policy(carry, state, key)
        state, timestep = env.step(state, action, key)
        return (carry, state), timestep.terminated

    start = jnp.asarray([0.0, 0.0, 0.05, 0.0])
    loop = jax.jit(lambda k: jax.lax.scan(step, (policy.init(k), start), jax.random.split(k, 200))[1])
    with item("8.45") as check:
        check(
            int(loop(KEY).sum()),
            "==",
            0,
            "falls in 200 steps, cross-entropy over discrete pushes, replanned every other step",
        )


def test_what_cannot_be_sampled_is_refused():
    problem, _ = quadratic(2)
    unending = FunctionProblem(lambda x, u: x, lambda x, u: jnp.nan * u[0], 1, 1)
    env = Pendulum()
    model = ModelProblem(KnownModel(env), 5, env_spec(env).action)
    for call, words in (
        (lambda: cem(problem, NOWHERE, KEY, samples=10, elites=10), "1 <= elites < samples"),
        (lambda: cem(problem, NOWHERE, KEY, iterations=0), "at least one iteration"),
        (lambda: cem(problem, NOWHERE, KEY, guess=np.zeros((2, 2))), r"\(1, 2\) actions are wanted"),
        (lambda: cem(unending, NOWHERE, KEY), "not finite"),
        (lambda: random_shooting(unending, NOWHERE, KEY), "not finite"),
        (lambda: random_shooting(problem, NOWHERE, KEY, samples=0), "at least one sample"),
        (lambda: mppi(problem, NOWHERE, KEY, temperature=0.0), "must be more than 0"),
        (lambda: CrossEntropy(samples=10, elites=20), "cannot choose 20 elites among 10"),
        (lambda: MPC(model, CrossEntropy(), every=6), "1 to 5 of them, not for 6"),
        (lambda: best_open_loop(coin_process(), 30), "too many"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
