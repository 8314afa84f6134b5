"""The Fisher matrix against enumeration, and the natural step against what the notes claim of it. In float64."""

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import EnvSpec, from_space
from rewardtogo.nn import ACTION_KINDS, ActorCritic
from rewardtogo.ops.distributions import Categorical, DiagGaussian
from rewardtogo.ops.linalg import conjugate_gradients
from rewardtogo.policy_gradient.fisher import (
    fisher_matrix,
    fisher_vector_product,
    mean_kl,
    natural_gradient,
    score_fisher,
    step_size,
)
from rewardtogo.policy_gradient.fit import actor_parameters

SPACES = {
    "discrete": spaces.Discrete(3),
    "multi_discrete": spaces.MultiDiscrete([2, 3]),
    "multi_binary": spaces.MultiBinary(2),
    "box": spaces.Box(-2, 2, (2,), np.float32),
}


@pytest.fixture(autouse=True)
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def policy(kind: str, states: int = 6, seed: int = 0) -> tuple[jax.Array, Callable, jax.Array]:
    """Parameters of a small network that has begun to differ from the uniform policy, its laws, and the observations."""
    box = spaces.Box(-1, 1, (2,), np.float32)
    key, moved, seen = jax.random.split(jax.random.key(seed), 3)
    network = ActorCritic.of(rtg.MLP(4), EnvSpec(from_space(box), from_space(SPACES[kind])), key)
    network = jax.tree.map(lambda x: x.astype(jnp.float64), network)
    theta, network_of = actor_parameters(network)
    theta = theta + 0.3 * jax.random.normal(moved, theta.shape, theta.dtype)
    observations = jax.random.normal(seen, (states, 2), jnp.float64)
    return theta, lambda x: jax.vmap(lambda o: network_of(x).act((), o)[1])(observations), observations


def hessian(laws: Callable, theta: jax.Array, forward: bool = True) -> jax.Array:
    """Of KL(old || new), or KL(new || old), at new = old, with no other help than differentiation."""
    here = laws(theta)
    kl = lambda x: mean_kl(here, laws(x)) if forward else mean_kl(laws(x), here)  # noqa: E731
    return jit(jax.hessian(kl))(theta)


# --- the matrix ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ACTION_KINDS)
def test_the_product_is_the_hessian_of_the_kl(item, kind):
    theta, laws, _ = policy(kind)
    matrix = jit(lambda x: fisher_matrix(laws, x))(theta)
    scale = float(jnp.max(jnp.abs(matrix)))
    with item("3.40") as check:
        for forward in (True, False):
            gap = float(jnp.max(jnp.abs(matrix - hessian(laws, theta, forward))))
            check(gap / scale, "<=", 1e-5, f"{kind}: Fisher products against the Hessian of the KL")
        check(float(jnp.max(jnp.abs(matrix - matrix.T))) / scale, "<=", 1e-10, f"{kind}: asymmetry")


def test_three_fisher_matrices_agree(item):
    """Enumeration over states and actions of the definition, samples of it, and the products, of a softmax policy."""
    rng = np.random.default_rng(0)
    # Rows of states as they would come up in a rollout: state 0 half of the time.
    states, number = np.array([0, 0, 0, 1, 1, 2]), 20_000
    theta = jnp.asarray(rng.normal(size=(3, 4)))
    laws = lambda x: jax.vmap(Categorical)(x[states])  # noqa: E731
    probs = np.asarray(jax.nn.softmax(theta, axis=-1))
    pairs = np.array([(s, a) for s in range(3) for a in range(4)])
    weights = np.array([0.5, 1 / 3, 1 / 6])[pairs[:, 0]] * probs[pairs[:, 0], pairs[:, 1]]
    log_probs = lambda x, pairs: jax.nn.log_softmax(x, axis=-1)[pairs[:, 0], pairs[:, 1]]  # noqa: E731

    products = fisher_matrix(laws, theta)
    enumerated = score_fisher(lambda x: log_probs(x, pairs), theta, jnp.asarray(weights))
    drawn = pairs[rng.choice(len(pairs), number, p=weights / weights.sum())]
    sampled = score_fisher(lambda x: log_probs(x, drawn), theta, jnp.full(number, 1 / number))
    scores = np.asarray(jax.jacrev(lambda x: log_probs(x, pairs))(theta)).reshape(len(pairs), -1)
    outer = scores[:, :, None] * scores[:, None, :]
    error = np.sqrt(np.einsum("n,nij->ij", weights, (outer - np.asarray(enumerated)) ** 2) / number)
    rare = error > 0
    with item("3.40") as check:
        check(float(jnp.max(jnp.abs(products - enumerated))), "<=", 1e-10, "Fisher products against enumeration")
        check(np.max(np.abs(sampled - enumerated)[rare] / error[rare]), "<=", 4.0, "standard errors of 20 000 samples")
        check(float(jnp.max(jnp.abs(products - hessian(lambda x: laws(x.reshape(3, 4)), theta.ravel())))),
              "<=", 1e-5, "Fisher products against the Hessian of the KL")  # fmt: skip
        one = fisher_matrix(lambda x: jax.vmap(Categorical)(x[None]), theta[0])
        softmax = np.diag(probs[0]) - np.outer(probs[0], probs[0])
        check(float(np.max(np.abs(one - softmax))), "<=", 1e-12, "softmax: diag(p) - pp'")


def test_a_mask_takes_actions_out_of_the_matrix():
    masks = jnp.asarray([[1, 1, 0], [1, 0, 0]], jnp.int8)
    laws = lambda x: jax.vmap(lambda m: Categorical.masked(x, m))(masks)  # noqa: E731
    theta = jnp.asarray([0.2, -0.3, 5.0])
    p = np.exp([0.2, -0.3]) / np.exp([0.2, -0.3]).sum()
    expected = np.zeros((3, 3))
    expected[:2, :2] = 0.5 * (np.diag(p) - np.outer(p, p))
    np.testing.assert_allclose(fisher_matrix(laws, theta), expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["discrete", "box"])
def test_the_kl_is_half_the_quadratic_form(item, kind):
    theta, laws, _ = policy(kind, states=50)
    multiply, here = fisher_vector_product(laws, theta), laws(theta)
    directions = jax.random.normal(jax.random.key(9), (20, theta.size), theta.dtype)
    directions = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
    lengths = 1e-2 * 0.5 ** jnp.arange(4.0)

    def measure(direction: jax.Array, length: jax.Array) -> tuple[jax.Array, jax.Array]:
        step = length * direction
        return mean_kl(laws(theta + step), here), 0.5 * step @ multiply(step)

    kl, quadratic = jit(jax.vmap(jax.vmap(measure, (None, 0)), (0, None)))(directions, lengths)
    slopes = np.polyfit(np.log(lengths), np.log(np.abs(kl - quadratic)).T, 1)[0]
    with item("3.39") as check:
        check(float(jnp.max(jnp.abs(kl / quadratic - 1)[:, 0])), "<=", 0.01, f"{kind}: KL over d'Fd/2, less 1, at 1e-2")
        check(abs(float(np.median(slopes)) - 3.0), "<=", 0.1, f"{kind}: the error grows with the third power of d")
        without = float(jnp.max(jnp.abs(kl / (2 * quadratic) - 0.5)[:, 0]))
        check(without, "<=", 0.01, f"{kind}: KL over d'Fd as printed in 3.9.1 (E3.12), less 1/2")


def test_the_kl_of_two_policies_has_one_sign(item):
    theta, laws, _ = policy("discrete")
    others = theta[None] + jax.random.normal(jax.random.key(1), (100, theta.size), theta.dtype)
    here = laws(theta)

    def printed(new: Any) -> jax.Array:
        """E_{pi'}[log pi - log pi'], as in 3.9.1."""
        p = jax.nn.softmax(new.logits)
        return (p * (jax.nn.log_softmax(here.logits) - jax.nn.log_softmax(new.logits))).sum(-1).mean()

    right, wrong = jit(jax.vmap(lambda x: (mean_kl(laws(x), here), printed(laws(x)))))(others)
    with item("3.38") as check:
        check(float(jnp.min(right)), ">=", 0.0, "least KL of 100 policies from one")
        check(float(jnp.max(wrong)), "<", 0.0, "greatest of the formula as printed (E3.11)")


# --- the step --------------------------------------------------------------------------------------------------------

LOGITS, SLOPE, EPS = jnp.array([0.3, -0.2, 0.1]), jnp.array([0.3, -0.15, 0.06]), 1e-4


def three_logits(theta: jax.Array) -> Categorical:
    """One state and four actions; the last logit is 0, so that F has an inverse."""
    return jax.vmap(Categorical)(jnp.append(theta, 0.0)[None])


def test_the_step_has_the_kl_that_was_asked_for(item):
    theta = LOGITS.astype(jnp.float64)
    slope = SLOPE.astype(jnp.float64)
    natural = natural_gradient(lambda x: slope @ x, three_logits, theta, 0.0, 10)
    kl = lambda size: float(mean_kl(three_logits(theta + size * natural.direction), three_logits(theta)))  # noqa: E731
    matrix = fisher_matrix(three_logits, theta)
    inverse = slope @ jnp.linalg.solve(matrix, slope)
    with item("7.24") as check:
        check(abs(kl(step_size(natural.curvature, EPS)) / EPS - 1), "<=", 0.01, "KL of the step over 1e-4, less 1")
        check(abs(float(natural.curvature / inverse) - 1), "<=", 1e-10, "x'Fx over g'F^-1 g, less 1")
        check(kl(jnp.sqrt(2 * EPS / (slope @ matrix @ slope))) / EPS, ">=", 22.0, "as printed, with g'Fg (E7.9)")
    with item("3.39") as check:
        check(abs(kl(jnp.sqrt(EPS / inverse)) / (EPS / 2) - 1), "<=", 0.01, "d'Fd = eps gives half the KL (E3.12)")


def test_nothing_to_climb():
    natural = natural_gradient(lambda x: 0.0 * x.sum(), three_logits, LOGITS.astype(jnp.float64), 0.0, 10)
    assert float(step_size(natural.curvature, EPS)) == 0.0
    assert not natural.direction.any()


@pytest.mark.parametrize("kind", ACTION_KINDS)
def test_conjugate_gradients_solve_the_damped_system(item, kind):
    theta, laws, _ = policy(kind)
    b = jax.random.normal(jax.random.key(2), theta.shape, theta.dtype)

    def solve(theta: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        multiply, matrix = fisher_vector_product(laws, theta, 1e-2), fisher_matrix(laws, theta, 1e-2)
        x, _ = conjugate_gradients(multiply, b, 60, 1e-12)
        return x, matrix @ x - b, jnp.linalg.solve(matrix, b)

    x, residual, direct = jit(solve)(theta)
    with item("7.25") as check:
        check(float(jnp.linalg.norm(residual) / jnp.linalg.norm(b)), "<=", 1e-6, f"{kind}: relative residual")
        check(float(jnp.linalg.norm(x - direct) / jnp.linalg.norm(direct)), "<=", 1e-6, f"{kind}: direct solution")


def test_damping_and_fewer_samples(item):
    theta, laws, observations = policy("box", states=10_000)
    damping = 0.1
    few = lambda x: jax.tree.map(lambda leaf: leaf[::10], laws(x))  # noqa: E731
    target = jnp.sin(observations @ jnp.asarray([[1.0, 0.5], [-0.7, 1.0]]))

    def cosine(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        objective = lambda x: -((laws(x).mean - target) ** 2).mean() - laws(x).std.mean()  # noqa: E731
        whole, thinned = (natural_gradient(objective, part, theta, damping, 10).direction for part in (laws, few))
        return whole @ thinned / jnp.linalg.norm(whole) / jnp.linalg.norm(thinned), fisher_matrix(few, theta, damping)

    similar, matrix = jit(cosine)(theta)
    with item("7.28") as check:
        check(float(jnp.linalg.eigvalsh(matrix)[0]), ">=", damping - 1e-9, "least eigenvalue of F + 0.1 I")
        check(float(jnp.linalg.eigvalsh(matrix)[0]), "<=", 0.2, "F alone is nearly singular")
        check(float(similar), ">", 0.99, "cosine of the steps with 1 000 and with 10 000 samples")


# --- other coordinates -----------------------------------------------------------------------------------------------


def change(theta: jax.Array, laws: Callable, objective: Callable, natural: bool) -> jax.Array:
    """What one step does to the numbers of the distributions, in whatever coordinates `laws` takes."""
    if natural:
        found = natural_gradient(objective, laws, theta, 0.0, 60)
        step = step_size(found.curvature, 1e-3) * found.direction
    else:
        gradient = jax.grad(objective)(theta)
        step = 0.03 * gradient / jnp.linalg.norm(gradient)
    return ravel_pytree(laws(theta + step))[0] - ravel_pytree(laws(theta))[0]


def compare_coordinates(laws: Callable, objective: Callable, theta: jax.Array, seed: int) -> tuple[float, float]:
    """How far apart, relatively, the steps in theta and in psi with theta = A psi take the policy: natural, and vanilla."""
    size = theta.size
    matrix = jnp.asarray(np.random.default_rng(seed).normal(size=(size, size)))
    psi = jnp.linalg.solve(matrix, theta)
    gaps = []
    for natural in (True, False):
        one = jit(lambda x, n=natural: change(x, laws, objective, n))(theta)
        in_psi = lambda x, n=natural: change(x, lambda p: laws(matrix @ p), lambda p: objective(matrix @ p), n)  # noqa: E731
        gaps.append(float(jnp.max(jnp.abs(one - jit(in_psi)(psi))) / jnp.max(jnp.abs(one))))
    return gaps[0], gaps[1]


def test_a_gaussian_in_other_coordinates(item):
    """Mean W s and log std, five parameters; the reward is quadratic in the action."""
    states = jnp.asarray(np.random.default_rng(3).normal(size=(7, 2)))
    laws = lambda x: DiagGaussian(states @ x[:4].reshape(2, 2), jnp.broadcast_to(x[4], (7, 2)))  # noqa: E731
    objective = lambda x: -((laws(x).mean - jnp.sin(states)) ** 2 + laws(x).std ** 2).mean()  # noqa: E731
    natural, vanilla = compare_coordinates(laws, objective, jnp.asarray([0.3, -0.2, 0.5, 0.1, -0.4]), 0)
    with item("3.41") as check:
        check(natural, "<=", 1e-6, "natural steps in two coordinates, relative")
        check(vanilla, ">=", 0.05, "vanilla steps in two coordinates, relative")


def test_a_softmax_in_other_coordinates(item):
    rng = np.random.default_rng(4)
    features, reward = jnp.asarray(rng.normal(size=(4, 3, 4))), jnp.asarray(rng.normal(size=(4, 3)))
    laws = lambda x: jax.vmap(Categorical)(features @ x)  # noqa: E731
    objective = lambda x: (jax.nn.softmax(laws(x).logits) * reward).sum(-1).mean()  # noqa: E731
    theta = jnp.asarray(rng.normal(size=4))
    natural, vanilla = compare_coordinates(laws, objective, theta, 5)
    # A parameter that counts tenfold moves a tenth as far.
    influence = jnp.asarray([1.0, 10.0, 1.0, 1.0])
    steps = []
    for scale in (jnp.ones(4), influence):
        scaled = lambda x, s=scale: x * s  # noqa: E731
        found = natural_gradient(
            lambda x, f=scaled: objective(f(x)), lambda x, f=scaled: laws(f(x)), theta / scale, 0.0, 60
        )
        steps.append(found.direction)
    with item("3.42") as check:
        check(natural, "<=", 1e-6, "change of the policy by natural steps in theta and psi, relative")
        check(vanilla, ">=", 0.05, "the same of vanilla steps")
        gap = float(jnp.max(jnp.abs(steps[0] / influence - steps[1])) / jnp.max(jnp.abs(steps[0])))
        check(gap, "<=", 1e-6, "the step is divided by the influence of its parameter")


def test_a_gaussian_that_must_become_narrow(item):
    """Reward -a^2, one state: J = -(m^2 + sigma^2), theta = (m, log sigma), exact gradients, J >= -1e-4 wanted.

    The gradient of log sigma fades with sigma^2 while that of m does not, so that no learning rate suits both. The natural gradient
    divides by F = diag(1 / sigma^2, 2).
    """
    laws = lambda x: DiagGaussian(x[:1][None], x[1:][None])  # noqa: E731
    objective = lambda x: -(x[0] ** 2 + jnp.exp(2 * x[1]))  # noqa: E731
    start, most = jnp.asarray([1.0, 0.0]), 100_000

    def steps_of(update: Callable) -> jax.Array:
        unfinished = lambda loop: (loop[0] < most) & ~(objective(loop[1]) >= -1e-4)  # noqa: E731
        return jax.lax.while_loop(unfinished, lambda loop: (loop[0] + 1, update(loop[1])), (0, start))[0]

    def natural(x: jax.Array) -> jax.Array:
        found = natural_gradient(objective, laws, x, 0.0, 5)
        return x + step_size(found.curvature, 0.01) * found.direction

    rates = jnp.asarray([0.01, 0.03, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
    vanilla = jit(jax.vmap(lambda rate: steps_of(lambda x: x + rate * jax.grad(objective)(x))))(rates)
    taken = int(jit(lambda: steps_of(natural))())
    with item("3.41") as check:
        check(taken, "<", 1000, "steps of the natural gradient until J >= -1e-4")
        check(taken / int(vanilla.min()), "<=", 0.1, "those over the vanilla gradient's with its best of 8 rates")
