"""LQG: what it costs against simulation, against the regulator that sees the state, and against other gains."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.planning import Estimating, LQProblem, lqg, lqr, riccati

X, U, O, H = 3, 2, 2, 12
KEY = jax.random.key(0)


def parts_of(seed: int) -> tuple[LQProblem, tuple[np.ndarray, ...]]:
    """A random problem with noise, and sensor and first state: G, R, m, P, g."""
    rng = np.random.default_rng(seed)
    spread = lambda n: (lambda r: r @ r.T + 0.1 * np.eye(n))(0.5 * rng.normal(size=(n, n)))  # noqa: E731
    problem = LQProblem(
        0.6 * rng.normal(size=(H, X, X + U)), spread(X + U), H, 0.1 * rng.normal(size=X), rng.normal(size=X + U),
        spread(X), rng.normal(size=X), spread(X),
    )  # fmt: skip
    return problem, (rng.normal(size=(O, X)), spread(O), rng.normal(size=X), spread(X), rng.normal(size=O))


@jax.jit
def simulated(problem: LQProblem, policy: Estimating, keys: jax.Array) -> jax.Array:
    """Costs of episodes: states, looks and actions as they come."""
    system = policy.system
    root = lambda S: jnp.linalg.cholesky(S)  # noqa: E731

    def episode(key: jax.Array) -> jax.Array:
        first, *rest = jax.random.split(key, 3)
        x0 = system.mean + root(system.covariance) @ jax.random.normal(first, (X,))

        def step(loop, now):
            (x, carry), (t, look_key, step_key) = loop, now
            G, g, R = system.sensor_at(t)
            o = G @ x + g + root(R) @ jax.random.normal(look_key, (O,))
            carry, u, _ = policy(carry, o, look_key)
            x, cost = problem.step(x, u, t, step_key)
            return (x, carry), cost

        keys = (jax.random.split(rest[0], H), jax.random.split(rest[1], H))
        (x, _), costs = jax.lax.scan(step, (x0, policy.init(key)), (jnp.arange(H), *keys))
        return costs.sum() + problem.final_cost(x)

    return jax.vmap(episode)(keys)


def test_cost_and_separation(item, x64):
    problem, (G, R, m, P, g) = parts_of(0)
    solution = lqg(problem, G, R, m, P, g)
    costs = np.asarray(simulated(problem, solution.value, jax.random.split(KEY, 40_000)))
    error = costs.std() / np.sqrt(len(costs))
    predicted, seen = float(solution.stats["cost"]), float(solution.stats["seen"])
    with item("8.36") as check:
        check(abs(costs.mean() - predicted) / error, "<=", 3, "simulated cost from the trace formula, standard errors")
        check((predicted - seen) / error, ">=", 10, "what not seeing the state costs, in the same units")
        gap = float(jnp.abs(solution.value.K - riccati(problem).value.K).max())
        check(gap, "==", 0, "separation: gains from those of the regulator that sees the state")
        # Neither a bolder nor a shyer gain, of the regulator or of the filter, is as cheap on the same noise.
        least = np.inf
        for where in (lambda p: p.K, lambda p: p.L):
            for factor in (0.8, 1.2):
                other = eqx.tree_at(where, solution.value, factor * where(solution.value))
                change = np.asarray(simulated(problem, other, jax.random.split(KEY, 40_000))) - costs
                least = min(least, change.mean() / (change.std() / np.sqrt(len(costs))))
        check(least, ">=", 3, "dearer with gains of 0.8 and 1.2 times these, standard errors, the least")


def test_seeing_all_without_noise_is_the_regulator(item, x64):
    """A sensor that shows the state: the same actions and the same cost as LQR's feedback."""
    problem, (_, _, m, P, _) = parts_of(1)
    solution = lqg(problem, np.eye(X), 1e-12 * np.eye(X), m, P)
    regulator = lqr(problem, m).stats["regulator"]
    x = jnp.asarray(np.random.default_rng(0).normal(size=X))
    action = solution.value(solution.value.init(KEY), x, KEY)[1]
    with item("8.36") as check:
        check(
            float(jnp.abs(action - regulator.K[0] @ x - regulator.k[0]).max()), "<=", 1e-8, "first action, from LQR's"
        )
        check(float(solution.stats["cost"] - solution.stats["seen"]), "<=", 1e-8, "cost of not seeing")
    known = solution.value.inspect(solution.value.init(KEY), x)
    assert np.allclose(known["estimate"], x) and np.allclose(known["mean"], action)


def test_refusals():
    problem, (_, R, m, P, _) = parts_of(0)
    with pytest.raises(ValueError, match="G has shape"):
        lqg(problem, np.eye(2), R, m, P)
