"""Nonlinear problems: expansions against differences, iLQR, DDP, Newton and collocation against each other."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import balance_cost, cart_pole, pendulum, swing_cost, swing_end, swing_up

from rewardtogo.core import Spec
from rewardtogo.envs import KnownModel, Pendulum
from rewardtogo.planning import (
    FunctionProblem,
    ModelProblem,
    box,
    collocation,
    gradient_shooting,
    identify,
    ilqr,
    newton_shooting,
    rollout,
    shooting_hessian,
    total_cost,
    why,
)
from rewardtogo.planning.flat import FlatProblem
from rewardtogo.planning.iterated_lqr import backward, expand

KEY = jax.random.key(0)
HANGING = np.array([np.pi, 0.0])
WAVE = 0.1 * np.sin(np.arange(100) / 5)[:, None]


def test_the_objective_is_the_rollout_of_the_environment(item):
    """Bit for bit, and its gradient is that of differences."""
    env = Pendulum()
    spec = Spec("box", (1,), low=(-2.0,), high=(2.0,))
    problem = ModelProblem(KnownModel(env), 12, spec)
    state = jnp.asarray([2.0, 0.5])
    actions = jax.random.uniform(KEY, (12, 1), minval=-2, maxval=2)
    costs = rollout(problem, problem.model.at(state), actions)[1]
    step = jax.jit(env.step)
    rewards, s = [], state
    for action in actions:
        s, timestep = step(s, action, KEY)
        rewards.append(float(timestep.reward))
    with item("8.3") as check:
        check(
            float(np.abs(np.asarray(costs) + np.asarray(rewards, np.float32)).max()), "==", 0, "costs and minus rewards"
        )
    with item("8.26") as check:
        total = float(total_cost(problem, problem.model.at(state), actions))
        check(abs(total + sum(rewards)), "<=", 1e-4, "J by substitution, and the sum of rewards along the constraint")


def test_gradients_of_shooting(item, x64):
    problem = swing_up(10)
    value = jax.jit(lambda u: total_cost(problem, HANGING - 0.3, u))
    actions, h = jnp.asarray(WAVE[:10]), 1e-5
    gradient = jax.grad(value)(actions)
    differences = [float(value(actions.at[t, 0].add(h)) - value(actions.at[t, 0].add(-h))) / (2 * h) for t in range(10)]
    conditions = {}
    for horizon in (10, 50):
        flat, x0 = FlatProblem.of(swing_up(horizon), jnp.asarray([0.0, 0.0]))
        eigenvalues = np.linalg.eigvalsh(shooting_hessian(flat, x0, jnp.zeros((horizon, 1))))
        conditions[horizon] = eigenvalues[-1] / eigenvalues[0]
    with item("8.3") as check:
        check(
            float(np.abs(gradient[:, 0] - jnp.asarray(differences)).max()), "<=", 1e-7, "gradient against differences"
        )
    with item("8.27") as check:
        check(
            float(np.abs(gradient[:, 0] - jnp.asarray(differences)).max()), "<=", 1e-7, "gradient against differences"
        )
        check(conditions[50] / conditions[10], ">=", 10, "growth of the Hessian's condition number from T = 10 to 50")


def test_taylor_expansion(item, x64):
    """Against differences at the nominal point, and the orders of what is left out. At the deviations, as printed (E8.7), it is not."""
    flat, x0 = FlatProblem.of(swing_up(3), jnp.asarray([1.0, 0.5]))
    actions = jnp.asarray([[0.3], [-0.2], [0.4]])
    states = flat.follow(x0, lambda _, u: u, actions)[0]
    e = expand(flat, states, actions)
    z = jnp.concatenate([states[:-1], actions], 1)
    h, worst = 1e-5, 0.0
    for t, i in itertools.product(range(3), range(3)):
        up, down = z[t].at[i].add(h), z[t].at[i].add(-h)
        high, low = (flat.step(p[:2], p[2:], t) for p in (up, down))
        worst = max(worst, float(jnp.abs((high[0] - low[0]) / (2 * h) - e.F[t, :, i]).max()))
        worst = max(worst, float(jnp.abs((high[1] - low[1]) / (2 * h) - e.c[t, i])))
    direction = jnp.asarray([0.7, -0.4, 0.5])
    left = []
    for size in (1e-1, 1e-2):
        d = size * direction
        following, cost = flat.step(*jnp.split(z[1] + d, [2]), 1)
        model = states[2] + e.F[1] @ d
        priced = flat.step(states[1], actions[1], 1)[1] + e.c[1] @ d + 0.5 * d @ e.C[1] @ d
        left.append((float(jnp.abs(following - model).max()), float(jnp.abs(cost - priced))))
    printed = jax.jacfwd(lambda p: flat.step(p[:2], p[2:], 1)[0])(direction)
    with item("8.38") as check:
        check(worst, "<=", 1e-5, "F and c against differences")
        check(abs(np.log10(left[0][0] / left[1][0]) - 2), "<=", 0.2, "order of the error of the dynamics, from 2")
        check(abs(np.log10(left[0][1] / left[1][1]) - 3), "<=", 0.3, "order of the error of the cost, from 3")
        check(float(jnp.abs(e.f).max()), "<=", 1e-12, "f_t of a trajectory that obeys the dynamics")
        check(
            float(jnp.abs(printed - e.F[1]).max()),
            ">=",
            1e-2,
            "the expansion as printed, at the deviations, is another",
        )


def test_swing_up(item, x64):
    """iLQR, DDP and collocation at the same place; costs fall; DDP's last steps are quadratic; iLQR's step is Gauss and Newton's."""
    problem = swing_up()
    found = {
        "ilqr": ilqr(problem, HANGING, WAVE),
        "ddp": ilqr(problem, HANGING, WAVE, ddp=True),
        "collocation": collocation(problem, HANGING, states=np.linspace([np.pi, 0], [0, 0], 101)),
    }
    with item("8.37") as check:
        solution = found["ilqr"]
        check(abs(float(solution.value.states[-1, 0])), "<", 0.05, "final angle")
        check(
            float(np.diff(solution.stats["costs"]).max()),
            "<=",
            0,
            "largest rise of the cost from iteration to iteration",
        )
        check(float(solution.stats["gradient"]), "<", 1e-4, "gradient at the end")
        check(why(solution.stats["reason"]) == "converged", "==", True, "why it stopped")
    costs = {name: float(solution.value.cost) for name, solution in found.items()}
    with item("8.29") as check:
        check(abs(costs["collocation"] / costs["ilqr"] - 1), "<=", 0.01, "collocation and shooting, pendulum")
        check(float(found["collocation"].stats["residual"]), "<=", 1e-6, "residual of the dynamics")

    def order(horizon: int, ddp: bool) -> float:
        """The exponent at which the distance from the least cost falls, from the last three iterations above rounding."""
        costs = np.asarray(ilqr(swing_up(horizon), np.array([1.2, 0.0]), ddp=ddp, tolerance=1e-15).stats["costs"])
        gaps = np.log((costs - costs.min())[costs - costs.min() > 1e-12])
        return float((gaps[-1] - gaps[-2]) / (gaps[-2] - gaps[-3]))

    flat, x0 = FlatProblem.of(problem.with_horizon(10), HANGING - 0.5)
    actions = jnp.asarray(WAVE[:10])
    states = flat.follow(x0, lambda _, u: u, actions)[0]
    e = expand(flat, states, actions)
    sweep = backward(flat, e, states, actions, jnp.zeros(()), False)

    def linear(dx: jax.Array, now: tuple) -> tuple[jax.Array, jax.Array]:
        F, K, k = now
        du = K @ dx + k
        return F @ jnp.concatenate([dx, du]), du

    step = jax.lax.scan(linear, jnp.zeros(2), (e.F, sweep.K, sweep.k))[1].ravel()
    gradient = jax.grad(lambda u: flat.total(x0, u))(actions).ravel()
    newton = -np.linalg.solve(shooting_hessian(flat, x0, actions, gauss_newton=True), gradient)
    with item("8.39") as check:
        check(abs(costs["ddp"] / costs["ilqr"] - 1), "<=", 1e-8, "DDP and iLQR end at the same cost, relative")
        check(order(15, True), ">=", 1.8, "DDP: order of convergence")
        check(order(30, False), "<=", 1.2, "iLQR: order of convergence, where dynamics bend")
        check(float(np.abs(step - newton).max()), "<=", 1e-9, "iLQR's step against Gauss and Newton's")
        check(float(np.abs(sweep.gradient.ravel() - gradient).max()), "<=", 1e-9, "adjoint gradient against autodiff's")


def test_bounds_are_kept(x64):
    """A pendulum too weak to be lifted at once is swung, by shooting and by collocation, to the same cost."""
    problem = swing_up(most=2.0)
    one = ilqr(problem, HANGING, WAVE)
    states = rollout(problem, HANGING, jnp.asarray(WAVE))[0]
    two = collocation(problem, HANGING, WAVE, states)
    for solution in (one, two):
        assert abs(float(solution.value.states[-1, 0])) < 0.05
        assert float(jnp.abs(solution.value.actions).max()) <= 2.0
    assert float(one.value.cost) == pytest.approx(float(two.value.cost), rel=1e-4)
    short = swing_up(20, most=2.0)
    near = jnp.asarray([0.3, 0.0])
    newton = newton_shooting(short, near)
    assert float(newton.value.cost) == pytest.approx(float(ilqr(short, near).value.cost), rel=1e-6)


def test_collocation_where_shooting_explodes(item, x64):
    """x' = 1.5 x + 0.1 x^3 + u for a hundred steps: the gradient of shooting is 1.5^100, and states as unknowns keep it at bay."""
    problem = FunctionProblem(lambda x, u: 1.5 * x + 0.1 * x**3 + u, lambda x, u: (x**2).sum() + (u**2).sum(), 100, 1)
    start = jnp.asarray([0.5])
    gradient = jax.grad(lambda u: total_cost(problem, start, u))(jnp.zeros((100, 1)))
    solution = collocation(problem, start, states=np.linspace([0.5], [0.0], 101))
    with item("8.29") as check:
        check(
            bool(jnp.isfinite(gradient).all()) and float(jnp.abs(gradient).max()) < 1e6,
            "==",
            False,
            "the gradient of shooting is of use",
        )
        check(float(solution.stats["residual"]), "<=", 1e-6, "collocation: residual of the dynamics")
        check(bool(solution.converged), "==", True, "and it converges")


def test_mpc_with_ilqr_balances_the_cart_pole(item):
    """From a fifth of a radian to either side, 1000 steps. Plans of 25 steps, from what is left of the last."""
    problem = FunctionProblem(cart_pole, balance_cost, 25, box(1, -1, 1), lambda x: 10 * balance_cost(x, jnp.zeros(1)))

    def step(loop: tuple, _: None) -> tuple[tuple, jax.Array]:
        x, guess = loop
        plan = ilqr(problem, x, guess, iterations=2).value
        following = cart_pole(x, plan.actions[0])
        return (following, jnp.concatenate([plan.actions[1:], plan.actions[-1:]])), following

    run = jax.jit(jax.vmap(lambda x: jax.lax.scan(step, (x, jnp.zeros((25, 1))), None, length=1000)[1]))
    angles = run(jnp.asarray([[0.0, 0.0, 0.2, 0.0], [0.0, 0.0, -0.2, 0.0]]))
    with item("8.40") as check:
        check(float(jnp.abs(angles[:, :, 2]).max()), "<=", 0.21, "largest angle on the way")
        check(float(jnp.abs(angles[:, -1, 2]).max()), "<=", 0.01, "angle after 1000 steps")
        check(float(jnp.abs(angles[:, :, 0]).max()), "<=", 2.4, "furthest the cart went")


def test_parameters_of_a_pendulum_are_identified(item, x64):
    """Mass, length and friction from 500 noisy transitions."""

    def dynamics(theta: dict, x: jax.Array, u: jax.Array) -> jax.Array:
        inertia = theta["mass"] * theta["length"] ** 2
        turn = 9.81 / theta["length"] * jnp.sin(x[0]) + (u[0] - theta["friction"] * x[1]) / inertia
        spin = x[1] + DT * turn
        return jnp.stack([x[0] + DT * spin, spin])

    truth = {"mass": 1.3, "length": 0.8, "friction": 0.15}
    rng = np.random.default_rng(0)
    states = jnp.asarray(rng.uniform([-np.pi, -6], [np.pi, 6], (500, 2)))
    actions = jnp.asarray(rng.uniform(-3, 3, (500, 1)))
    clean = jax.vmap(lambda x, u: dynamics(truth, x, u))(states, actions)
    noisy = clean + 0.002 * jnp.asarray(rng.normal(size=(500, 2)))
    solution = identify(dynamics, {"mass": 1.0, "length": 1.0, "friction": 0.5}, states, actions, noisy)
    with item("8.2") as check:
        for name, value in truth.items():
            check(abs(float(solution.value[name]) / value - 1), "<=", 0.01, f"{name}, relative")
            off = abs(float(solution.value[name]) - value) / float(solution.stats["standard_errors"][name])
            check(off, "<=", 3.5, f"{name}, in its standard errors")
    with pytest.raises(ValueError, match="do not tell the parameters apart"):
        identify(lambda theta, x, u: (theta["a"] + theta["b"]) * x, {"a": 1.0, "b": 1.0}, states, actions, clean)


DT = 0.05


def test_bad_problems_are_refused_in_a_sentence():
    problem = swing_up(5)
    for call, words in (
        (lambda: problem.with_horizon(0), "a horizon is a whole number"),
        (lambda: FunctionProblem(pendulum, swing_cost, True, 1), "a horizon is a whole number"),
        (lambda: box(2, 1.0, -1.0), "must lie below"),
        (lambda: box(2, [1, 2, 3]), "a number or 2 of them"),
        (lambda: ilqr(problem, HANGING, np.zeros((4, 1))), r"\(5, 1\) actions are wanted"),
        (
            lambda: ilqr(FunctionProblem(lambda x, u: x[:1], swing_cost, 5, 1), HANGING),
            r"shape \(2,\) to one of shape \(1,\)",
        ),
        (lambda: ilqr(FunctionProblem(pendulum, lambda x, u: x, 5, 1), HANGING), "must be one number"),
        (lambda: ilqr(FunctionProblem(lambda x, u: x * jnp.nan, swing_cost, 5, 1), HANGING), "not finite"),
        (lambda: collocation(FunctionProblem(lambda x, u: x * jnp.nan, swing_cost, 5, 1), HANGING), "not finite"),
        (lambda: newton_shooting(FunctionProblem(lambda x, u: x / 0.0, swing_cost, 5, 1), HANGING), "not finite"),
        (lambda: gradient_shooting(FunctionProblem(lambda x, u: x / 0.0, swing_cost, 5, 1), HANGING), "not finite"),
        (
            lambda: ilqr(FunctionProblem(pendulum, swing_cost, 5, Spec("discrete", (), "int32", counts=(2,))), HANGING),
            "these are discrete",
        ),
        (lambda: ilqr(FunctionProblem(pendulum, swing_cost, 5, 1), jnp.asarray([1, 2])), "holds no real numbers"),
        (lambda: collocation(problem, HANGING, states=np.zeros((5, 2))), r"\(6, 2\) is wanted"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
    hollow = FunctionProblem(pendulum, lambda x, u: -(u[0] ** 2) - x[0], 5, 1, swing_end)
    solution = ilqr(hollow, HANGING, iterations=60)
    assert not bool(solution.converged)
    assert why(solution.stats["reason"]) in ("not_positive_definite", "line_search_failed", "max_iters")
