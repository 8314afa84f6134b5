"""Embed to control: divergences against matrices, the bound's terms by hand, lines where the truth is one, and the goal reached."""

import statistics
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import Batch, EnvSpec, Spec, Transition
from rewardtogo.envs import PlanarNavigation
from rewardtogo.envs.planar_navigation import GOAL
from rewardtogo.model_based import E2C
from rewardtogo.model_based.e2c import E2CNetworks, LocallyLinear, e2c_terms, predicted_kl
from rewardtogo.model_based.latent import Dense
from rewardtogo.nn import Linear
from rewardtogo.ops.distributions import DiagGaussian
from rewardtogo.ops.divergences import kl_gaussian
from rewardtogo.planning import ILQR, ModelProblem, ilqr

KEY = jax.random.key(0)
L, O, A = 3, 5, 2
SPEC = EnvSpec(Spec("box", (O,), low=(-1.0,), high=(1.0,)), Spec("box", (A,), low=(-2.0, -2.0), high=(2.0, 2.0)))
f = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731


def law_of(rng: np.random.Generator) -> DiagGaussian:
    return DiagGaussian(f(rng.normal(size=L)), f(0.4 * rng.normal(size=L)))


def full_kl(law: DiagGaussian, line: LocallyLinear, u: jax.Array, seen: DiagGaussian) -> jax.Array:
    """By the matrices A and A Sigma A^T, and Cholesky's factors."""
    matrix = line.A
    cov = matrix @ jnp.diag(law.std**2) @ matrix.T
    return kl_gaussian(matrix @ law.mean + line.B @ u + line.o, cov, seen.mean, jnp.diag(seen.std**2))


def test_divergences_against_matrices(item):
    """Of A Sigma A^T without building it; 0 where the prediction is what is seen; its derivative as well."""
    rng, gap, slope = np.random.default_rng(0), 0.0, 0.0
    ours, theirs = jit(predicted_kl), jit(full_kl)
    by_ours, by_theirs = jit(jax.grad(predicted_kl, argnums=(0, 1, 3))), jit(jax.grad(full_kl, argnums=(0, 1, 3)))
    for _ in range(20):
        v, r, o, u = (f(0.5 * rng.normal(size=n)) for n in (L, L, L, A))
        case = law_of(rng), LocallyLinear(v, r, f(rng.normal(size=(L, A))), o), u, law_of(rng)
        if abs(float(1 + r @ v)) < 0.2:
            continue
        exact = float(theirs(*case))
        gap = max(gap, abs(float(ours(*case)) / exact - 1))
        pairs = zip(jax.tree.leaves(by_ours(*case)), jax.tree.leaves(by_theirs(*case)), strict=True)
        slope = max(slope, max(float(jnp.abs(a - b).max() / (1 + jnp.abs(b).max())) for a, b in pairs))
    law = law_of(rng)
    still = LocallyLinear(jnp.zeros(L), f(rng.normal(size=L)), jnp.zeros((L, A)), jnp.zeros(L))
    with item("8.70") as check:
        check(
            gap, "<=", 1e-4, "KL(N(A mu + B u + o, A Sigma A^T) || N), against Cholesky's, relative, the largest of 20"
        )
        check(slope, "<=", 1e-3, "its derivatives, likewise")
        check(abs(float(ours(law, still, jnp.ones(A), law))), "<=", 1e-5, "the same law twice")


def test_terms_by_hand():
    """One transition, with the sample drawn again and everything in numpy."""
    learner = E2C(latent_size=L, encoder_sizes=(7,), sizes=(7,))
    networks = jit(lambda key: learner.init(SPEC, key))(KEY).networks
    x, u, after = (f(np.random.default_rng(n).normal(size=s)) for n, s in ((1, O), (2, A), (3, O)))
    found = jit(e2c_terms)(networks, x, u, after, KEY)
    law, seen = networks.encode(x), networks.encode(after)
    mean, std = np.asarray(law.mean, float), np.asarray(law.std, float)
    z = mean + std * np.asarray(jax.random.normal(KEY, (L,)))
    raw = np.asarray(networks.dynamics(f(z)), float)
    matrix = np.eye(L) + np.outer(raw[:L], raw[L : 2 * L])
    offset, control = raw[2 * L : 3 * L], raw[3 * L :].reshape(L, A)
    following = matrix @ z + control @ np.asarray(u) + offset
    square = lambda a, b: float(((np.asarray(a) - np.asarray(b)) ** 2).sum())  # noqa: E731
    assert float(found.observation) == pytest.approx(square(networks.decoder(f(z)), x), rel=1e-4)
    assert float(found.next_observation) == pytest.approx(square(networks.decoder(f(following)), after), rel=1e-4)
    assert float(found.prior_kl) == pytest.approx(0.5 * (std**2 + mean**2 - 1 - 2 * np.log(std)).sum(), rel=1e-4)
    exact = kl_gaussian(
        f(matrix @ mean + control @ np.asarray(u) + offset), f(matrix @ np.diag(std**2) @ matrix.T),
        seen.mean, jnp.diag(seen.std**2),
    )  # fmt: skip
    assert float(found.consistency_kl) == pytest.approx(float(exact), rel=1e-3)


def test_linear_where_the_truth_is(item):
    """An encoder that reads z off and the true I + v r^T, B, o: prediction and encoding agree, and regulators end at once."""
    rng = np.random.default_rng(0)
    v, r, B, o = (0.3 * rng.normal(size=s) for s in (O, O, (O, A), O))
    o = 0.2 * o
    line = lambda w, b: Dense((Linear(f(w), f(b)),))  # noqa: E731
    small = np.full(O, -9.0)
    networks = E2CNetworks(
        line(np.concatenate([np.eye(O), np.zeros((O, O))]), np.concatenate([np.zeros(O), small])),
        line(np.eye(O), np.zeros(O)),
        line(np.zeros((O * (3 + A), O)), np.concatenate([v, r, o, B.ravel()])),
    )
    learner = E2C(latent_size=O, action_cost=0.3)
    state = jit(lambda key: learner.init(SPEC, key))(KEY)
    state = eqx.tree_at(lambda s: s.networks, state, networks, is_leaf=lambda x: isinstance(x, E2CNetworks))
    state = eqx.tree_at(lambda s: s.goal, state, f([0.3, -0.2, 0.1, 0.0, 0.2]))
    model = learner.model(state)
    matrix = np.eye(O) + np.outer(v, r)
    x, a = f(0.3 * rng.normal(size=O)), f([0.4, -1.0])
    wanted = matrix @ np.asarray(x) + B @ np.asarray([0.2, -0.5]) + o
    error = np.abs(np.asarray(model.transition(model.encode(x), a, KEY)) - wanted).max()
    solution = ilqr(ModelProblem(model, 4, SPEC.action), model.encode(x), iterations=20)
    # The same plan by least squares: z_t = M^t x + sum M^(t-1-s) (B u_s + o).
    powers = [np.linalg.matrix_power(matrix, n) for n in range(5)]
    rows, right = [], []
    for t in range(1, 5):
        rows.append(np.concatenate([powers[t - 1 - s] @ B if s < t else np.zeros((O, A)) for s in range(4)], 1))
        right.append(np.asarray(state.goal) - powers[t] @ np.asarray(x) - sum(powers[t - 1 - s] @ o for s in range(t)))
    rows.append(np.sqrt(0.3) * np.eye(4 * A))
    right.append(np.zeros(4 * A))
    best = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0].reshape(4, A)
    assert np.abs(best).max() < 0.9, "no bound may hold"
    with item("8.70") as check:
        check(error, "<=", 1e-5, "locally linear model, step against the true linear one")
        gap = np.abs(np.asarray(solution.value.actions) / 2.0 - best).max()
        check(gap, "<=", 1e-3, "plan towards the goal's latent, from least squares")


def test_the_goal_is_the_best_that_was_seen():
    """Over batches, and whatever comes later."""
    learner = E2C(latent_size=2, encoder_sizes=(7,), sizes=(7,))
    state = jit(lambda key: learner.init(SPEC, key))(KEY)
    update = jit(learner.update)
    rng = np.random.default_rng(0)
    seen, never = f(rng.uniform(-1, 1, (3, 4, O))), jnp.zeros(4, bool)
    rewards = f([[-3, -1, -2, -4], [-0.5, -2, -0.25, -7], [-9, -8, -1, -2]])
    for after, reward in zip(seen, rewards, strict=True):
        t = Transition(seen[0], jnp.ones((4, A)), reward, never, never, after, {})
        state, metrics, _ = update(state, Batch(t, jnp.arange(4), jnp.ones(4)), KEY)
        assert all(np.isfinite(float(value)) for value in metrics.values())
    assert np.array_equal(state.goal, seen[1, 2]) and float(state.goal_reward) == -0.25
    model = learner.model(state)
    assert np.allclose(model.goal, model.encode(state.goal))


def test_refusals():
    with pytest.raises(ValueError, match="latent_size"):
        E2C(latent_size=0)
    assert E2C(planner=ILQR(iterations=3)).action_kinds == ("box",)


@pytest.mark.slow
def test_reaches_the_goal(tmp_path: Path, item: Any) -> None:
    """Within 0.1 of it after 40 steps, of 20 random starts; five seeds."""
    runs = rtg.train("e2c", "PlanarNavigation", num_seeds=5, out=tmp_path / "run", quiet=True)
    env = PlanarNavigation()
    first, first_seen = jax.vmap(env.reset)(jax.random.split(jax.random.key(7), 20))
    step = jax.jit(jax.vmap(lambda state, action: env.step(state, action, KEY)))

    def share(path: Path) -> float:
        policy, states, seen = rtg.load(path), first, first_seen
        for _ in range(40):
            states, timestep = step(states, jnp.asarray(policy(np.asarray(seen))))
            seen = timestep.observation
        return float((jnp.linalg.norm(states - f(GOAL)[None], axis=-1) < 0.1).mean())

    shares = [share(run.path) for run in runs]
    print(f"\ne2c-PlanarNavigation: shares of starts that reach the goal {shares}")
    with item("8.70") as check:
        check(
            statistics.median(shares),
            ">=",
            0.8,
            "share of 20 starts that end within 0.1 of the goal, median of 5 seeds",
        )
