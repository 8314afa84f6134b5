"""Algorithm 17 against the quadratic programme written out in full, and against the formulas as the notes print them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from rewardtogo.envs.tabular import MDP
from rewardtogo.planning import (
    LinearController,
    LQProblem,
    cem,
    collocation,
    gradient_shooting,
    ilqr,
    lqr,
    lqr_infinite,
    newton_shooting,
    random_shooting,
    riccati,
    total_cost,
)
from rewardtogo.planning.linear_quadratic import backup
from rewardtogo.value import value_iteration

X, U, H = 3, 2, 5
KEY = jax.random.key(0)


def problem_of(seed: int, noise: bool = False) -> tuple[LQProblem, jax.Array]:
    """A random problem that changes with time, and a first state."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(H, X + U, X + U))
    spread = rng.normal(size=(X, X))
    problem = LQProblem(
        rng.normal(size=(H, X, X + U)),
        root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(X + U),
        H,
        rng.normal(size=(H, X)),
        rng.normal(size=(H, X + U)),
        spread @ spread.T,
        rng.normal(size=X),
        0.1 * spread @ spread.T if noise else None,
    )
    return problem, jnp.asarray(rng.normal(size=X))


COST = jax.jit(total_cost)
EXPANDED = jax.jit(
    lambda problem, x0: (lambda value: (jax.hessian(value)(jnp.zeros(H * U)), jax.grad(value)(jnp.zeros(H * U))))(
        lambda u: total_cost(problem, x0, u.reshape(H, U))
    )
)


def dense(problem: LQProblem, x0: jax.Array) -> tuple[np.ndarray, float]:
    """The best actions and their cost, from the quadratic function of all actions at once."""
    hessian, gradient = EXPANDED(problem, x0)
    actions = -np.linalg.solve(hessian, gradient).reshape(H, U)
    return actions, float(COST(problem, x0, actions))


def test_the_recursion_solves_the_quadratic_programme(item, x64):
    """Fifty problems; the values at the first state are the costs; the last step in closed form; the last step is alone."""
    gap, places, constants, last = 0.0, 0.0, 0.0, 0.0
    for seed in range(50):
        problem, x0 = problem_of(seed)
        actions, cost = dense(problem, x0)
        solution = lqr(problem, x0)
        regulator = solution.stats["regulator"]
        gap = max(gap, abs(float(solution.value.cost) - cost) / max(1.0, abs(cost)))
        places = max(places, float(np.abs(solution.value.actions - actions).max()))
        constants = max(constants, abs(float(regulator.cost_to_go(x0)) - cost) / max(1.0, abs(cost)))
        # With nothing to pay after the last step (erratum E8.5) it minimises its own cost.
        alone = LQProblem(problem.F[-1], problem.C[-1], 1, problem.f[-1], problem.c[-1])
        C, c = np.asarray(problem.C[-1]), np.asarray(problem.c[-1])
        expected = -np.linalg.solve(C[X:, X:], C[X:, :X] @ x0 + c[X:])
        last = max(last, float(np.abs(lqr(alone, x0).value.actions[0] - expected).max()))
    with item("8.30") as check:
        check(gap, "<=", 1e-10, "cost against the dense programme, relative, 50 problems")
        check(places, "<=", 1e-8, "actions against the dense programme")
    with item("8.31") as check:
        check(constants, "<=", 1e-10, "V_1(x_1) against the cost of the rollout")
    with item("8.32") as check:
        check(last, "<=", 1e-10, "u_T against -C_uu^-1 (C_ux x + c_u)")


def test_what_the_notes_print_is_not_the_optimum(x64):
    """Errata E8.1 and E8.2 as fixtures: k without the inverse, and f' V f in place of F' V f, cost more (or have no shape at all)."""
    problem, x0 = problem_of(3)
    _, best = dense(problem, x0)

    def cost(printed: str) -> float:
        V, v = np.asarray(problem.C_final), np.asarray(problem.c_final)
        gains = []
        for t in reversed(range(H)):
            F, f, _, c = (np.asarray(part) for part in problem.at(t))
            step = backup(*problem.at(t), jnp.asarray(V), jnp.asarray(v))
            Q, q = np.asarray(step.Q), np.asarray(step.q)
            if printed == "E8.2":
                q = c + F.T @ v + f @ V @ f
            K = -np.linalg.solve(Q[X:, X:], Q[X:, :X])
            k = -Q[X:, X:] @ q[X:] if printed == "E8.1" else -np.linalg.solve(Q[X:, X:], q[X:])
            V, v = np.asarray(step.V), q[:X] + Q[:X, X:] @ k + K.T @ (q[X:] + Q[X:, X:] @ k)
            gains.append((K, k))
        x, actions = np.asarray(x0), []
        for t, (K, k) in enumerate(reversed(gains)):
            u = K @ x + k
            actions.append(u)
            F, f, _, _ = problem.at(t)
            x = F @ np.concatenate([x, u]) + f
        return float(COST(problem, x0, jnp.asarray(actions)))

    assert cost("right") == pytest.approx(best, rel=1e-9)
    assert cost("E8.1") > best + 1.0
    assert cost("E8.2") > best + 0.1


def test_five_forms_of_the_riccati_equation_and_the_endless_horizon(item, x64):
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(X, X)), rng.normal(size=(X, U))
    root = rng.normal(size=(X + U, X + U))
    C = root @ root.T + 0.1 * np.eye(X + U)
    Q, N, R = C[:X, :X], C[:X, X:], C[X:, X:]
    V = (lambda m: m @ m.T)(rng.normal(size=(X, X)))
    F = np.hstack([A, B])
    M = C + F.T @ V @ F
    K = -np.linalg.solve(M[X:, X:], M[X:, :X])
    closed, S = A + B @ K, np.linalg.inv(M[X:, X:])
    forms = [
        M[:X, :X] + M[:X, X:] @ K + K.T @ M[X:, :X] + K.T @ M[X:, X:] @ K,
        M[:X, :X] + M[:X, X:] @ K,
        M[:X, :X] - M[:X, X:] @ S @ M[X:, :X],
        closed.T @ V @ closed + Q + N @ K + K.T @ N.T + K.T @ R @ K,
        M[:X, :X] - K.T @ M[X:, X:] @ K,
    ]
    zero = jnp.zeros
    library = np.asarray(backup(*map(jnp.asarray, (F, zero(X), C, zero(X + U), V, zero(X)))).V)
    endless = lqr_infinite(F, C)
    long = riccati(LQProblem(F, C, 200)).value
    oracle = scipy.linalg.solve_discrete_are(A, B, Q, R, s=N)
    with item("8.34") as check:
        check(max(np.abs(form - library).max() for form in forms), "<=", 1e-10, "five forms of V")
        check(float(endless.stats["spectral_radius"]), "<", 1, "spectral radius of A + B K")
    with item("8.30") as check:
        check(np.abs(endless.value.V[0] - oracle).max() / np.abs(oracle).max(), "<=", 1e-8, "DARE by doubling, SciPy's")
        check(np.abs(long.V[0] - oracle).max() / np.abs(oracle).max(), "<=", 1e-8, "recursion's fixed point, SciPy's")
        check(np.abs(long.K[0] - endless.value.K[0]).max(), "<=", 1e-8, "gains")


def test_noise_changes_the_constants_only(item, x64):
    problem, x0 = problem_of(1, noise=True)
    noisy, quiet = riccati(problem).value, riccati(problem.without_noise()).value
    plan = lqr(problem.without_noise(), x0).value
    controller = noisy.controller()

    def episode(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(loop: tuple, now: tuple) -> tuple[tuple, None]:
            (x, memory, total), (t, k) = loop, now
            memory, u, _ = controller(memory, x, k)
            following, cost = problem.step(x, u, t, k)
            return (following, memory, total + cost), None

        start = (x0, controller.init(key), jnp.zeros(()))
        (last, _, total), _ = jax.lax.scan(step, start, (jnp.arange(H), jax.random.split(key, H)))
        return total + problem.final_cost(last), total_cost(problem, x0, plan.actions, key)

    count = 20_000
    closed, open_loop = jax.jit(jax.vmap(episode))(jax.random.split(KEY, count))
    predicted = float(noisy.cost_to_go(x0))
    error = float(jnp.std(closed)) / count**0.5
    with item("8.35") as check:
        check(np.abs(noisy.K - quiet.K).max(), "==", 0, "gains with and without noise")
        check(
            abs(float(closed.mean()) - predicted) / error, "<=", 3, "simulated cost, in standard errors from V_1(x_1)"
        )
        check(
            float(open_loop.mean() - closed.mean()) / error,
            ">=",
            3,
            "what the plan alone costs more, in standard errors",
        )
        check(abs(float(lqr(problem, x0).value.cost) - predicted), "<=", 1e-9, "cost of the plan counts the noise")


def test_a_time_varying_controller_is_a_policy(item, x64):
    rng = np.random.default_rng(2)
    K, k, F = rng.normal(size=(H, U, X)), rng.normal(size=(H, U)), rng.normal(size=(X, X + U))
    controller = LinearController(jnp.asarray(K), jnp.asarray(k))
    x, memory, by_hand, worst = jnp.ones(X), controller.init(KEY), np.ones(X), 0.0
    for t in range(H):
        memory, u, _ = controller(memory, x, KEY)
        x = F @ jnp.concatenate([x, u])
        closed = F[:, :X] + F[:, X:] @ K[t]
        by_hand = closed @ by_hand + F[:, X:] @ k[t]
        worst = max(worst, float(np.abs(x - by_hand).max() / np.abs(by_hand).max()))
    spread = jnp.broadcast_to(jnp.asarray([[0.5, 0.0], [0.3, 0.2]]), (H, U, U))
    noisy = LinearController(jnp.asarray(K), jnp.asarray(k), spread)
    draws = jax.vmap(lambda key: noisy(jnp.asarray(1), jnp.ones(X), key)[1])(jax.random.split(KEY, 20_000))
    covariance = np.cov(np.asarray(draws).T)
    with item("8.7") as check:
        check(worst, "<=", 1e-12, "closed loop against the recursion of matrices, relative")
        check(np.abs(covariance - np.asarray(spread[0] @ spread[0].T)).max(), "<=", 0.01, "covariance of the noise")


def test_costs_and_rewards_are_one_problem(item, x64):
    """A regulator's value is minus that of the discretised decision process, ever nearer; its Q is the cost-to-go."""
    dt = 0.5
    F, C = np.array([[1.0, dt]]), dt * np.diag([1.0, 1.0])
    exact = lqr_infinite(F, C)
    found = []
    for points in (41, 161):
        x, u = np.linspace(-2, 2, points), np.linspace(-2, 2, points)
        following = np.clip(x[:, None] + dt * u[None, :], -2, 2)
        place = (following + 2) / (x[1] - x[0])
        below = np.clip(np.floor(place).astype(int), 0, points - 2)
        share = np.clip(place - below, 0.0, 1.0)
        transitions = np.zeros((points, points, points))
        s, a = np.meshgrid(np.arange(points), np.arange(points), indexing="ij")
        transitions[s, a, below] += 1 - share
        transitions[s, a, below + 1] += share
        rewards = -0.5 * dt * (x[:, None] ** 2 + u[None, :] ** 2)
        table = value_iteration(MDP(transitions, rewards, discount=1.0 - 1e-9), tolerance=1e-7)
        at = points // 2 + points // 4
        found.append(float(-table.value.values[at] / (0.5 * exact.value.V[0, 0, 0] * x[at] ** 2)) - 1)
    with item("1.18") as check:
        check(abs(found[1]), "<=", 0.01, "cost of the grid against the regulator's, relative")
        check(abs(found[1]), "<", abs(found[0]), "and nearer than on the coarser grid")
    problem, x0 = problem_of(5)
    regulator = riccati(problem).value
    u = jnp.asarray([0.3, -0.2])
    z = jnp.concatenate([x0, u])
    following, cost = problem.step(x0, u, 0, KEY)
    Q = cost + regulator.cost_to_go(following, 1)
    # Q_0(z) = z'Qz/2 + q'z + what the next value adds whatever z is.
    F, f, _, _ = problem.at(0)
    rest = 0.5 * f @ regulator.V[1] @ f + regulator.v[1] @ f + regulator.constant[1]
    in_use = lambda u: (lambda z: 0.5 * z @ regulator.Q[0] @ z + regulator.q[0] @ z)(jnp.concatenate([x0, u]))  # noqa: E731
    slope = jax.grad(in_use)(regulator.K[0] @ x0 + regulator.k[0])
    with item("1.22") as check:
        check(
            abs(float(0.5 * z @ regulator.Q[0] @ z + regulator.q[0] @ z + rest - Q)), "<=", 1e-10, "Q in units of cost"
        )
        check(float(jnp.abs(slope).max()), "<=", 1e-9, "slope of Q at u = K x + k")


def test_what_cannot_be_solved_is_said(item):
    with item("8.33") as check:
        with pytest.raises(
            ValueError, match=r"Q_uu of step 3 is not positive definite.*add a multiple of the identity"
        ):
            lqr(LQProblem(np.ones((2, 3)), np.diag([1.0, 1.0, -1.0]), 4), jnp.ones(2))
        inside = jax.jit(lambda x: lqr(LQProblem(jnp.ones((2, 3)), jnp.diag(jnp.asarray([1.0, 1.0, -1.0])), 4), x))(
            jnp.ones(2)
        )
        check(int(inside.converged), "==", 0, "inside a compiled function it is a flag")
        check(int(inside.stats["step"]), "==", 3, "and the step is known")
    for call, words in (
        (lambda: LQProblem(np.ones((2, 3)), np.eye(2), 4), r"C has shape \(2, 2\)"),
        (lambda: LQProblem(np.ones((2, 3)), np.eye(3), 4, f=np.ones(3)), r"f has shape \(3,\)"),
        (lambda: LQProblem(np.ones((3, 3)), np.eye(3), 4), "are there no actions"),
        (lambda: LQProblem(np.ones((2, 3)), np.eye(3), 0), "a horizon is a whole number"),
        (
            lambda: lqr_infinite(np.array([[2.0, 0, 0], [0, 0.5, 1.0]]), np.eye(3)),
            "no action reaches its mode of eigenvalue 2",
        ),
        (lambda: lqr_infinite(np.array([[0.5, 1.0]]), np.diag([1.0, 0.0])), "C_uu is not positive definite"),
        (lambda: lqr(LQProblem(np.ones((2, 3)), np.eye(3), 4), jnp.ones(3)), r"the state has shape \(3,\)"),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_every_planner_finds_the_regulators_plan_and_says_what_it_costs(item, x64):
    problem, x0 = problem_of(7)
    best = float(lqr(problem, x0).value.cost)
    found = {
        "ilqr": ilqr(problem, x0),
        "ddp": ilqr(problem, x0, ddp=True),
        "newton": newton_shooting(problem, x0),
        "gauss_newton": newton_shooting(problem, x0, gauss_newton=True),
        "collocation": collocation(problem, x0),
        "gradient": gradient_shooting(problem, x0, iterations=3000),
        "random": random_shooting(problem, x0, KEY, law="gaussian", samples=500),
        "cem": cem(problem, x0, KEY, samples=1000, iterations=60, tolerance=1e-6, sd=5.0),
    }
    with item("8.8") as check:
        for name, solution in found.items():
            again = float(COST(problem, x0, solution.value.actions))
            check(
                abs(float(solution.value.cost) - again) / abs(again),
                "<=",
                1e-9,
                f"{name}: its cost and that of its actions",
            )
    with item("8.28") as check:
        for name in ("newton", "gauss_newton"):
            check(abs(float(found[name].stats["costs"][0]) - best), "<=", 1e-8, f"{name}: cost after one step")
    with item("8.37") as check:
        check(abs(float(found["ilqr"].stats["costs"][0]) - best), "<=", 1e-8, "iLQR: cost after one iteration")
    with item("8.29") as check:
        check(abs(float(found["collocation"].value.cost) - best), "<=", 1e-6, "collocation: cost above the optimum")
        check(abs(float(found["gradient"].value.cost) - best), "<=", 1e-6, "shooting: cost above the optimum")
        check(float(found["collocation"].stats["residual"]), "<=", 1e-6, "collocation: residual of the dynamics")
    assert float(found["cem"].value.cost) - best < 0.1
    assert float(found["random"].value.cost) > best


def test_problems_are_solved_side_by_side(x64):
    """A thousand first states at once give what each gives alone."""
    problem, x0 = problem_of(8)
    states = x0[None] + jnp.arange(5.0)[:, None]
    together = jax.jit(jax.vmap(lambda x: lqr(problem, x)))(states)
    alone = [float(lqr(problem, x).value.cost) for x in states]
    np.testing.assert_allclose(together.value.cost, alone, rtol=1e-12)
    swept = jax.vmap(lambda x: ilqr(problem, x))(states)
    np.testing.assert_allclose(swept.value.cost, alone, rtol=1e-9)
