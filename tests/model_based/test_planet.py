"""PlaNet: the bound against an exact likelihood, memories that begin anew, and acting with the filter that was learned."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from algorithms_under_test import jit
from rewardtogo.core import EnvSpec, Spec
from rewardtogo.model_based import PlaNet
from rewardtogo.model_based.latent import Dense
from rewardtogo.model_based.planet import LEAST_STD, Cell, StateSpace, sequence_bound
from rewardtogo.nn import Linear
from rewardtogo.planning import CrossEntropy

KEY = jax.random.key(0)
M, S, O, A = 3, 2, 4, 1
BOUND = jit(sequence_bound)


def raw_of(std: np.ndarray) -> np.ndarray:
    """What the network must say for a deviation."""
    return np.log(np.expm1(std - LEAST_STD))


def exact_model() -> tuple[StateSpace, np.ndarray, np.ndarray, float]:
    """States without a past, seen through orthogonal columns with noise; prior and posterior, both diagonal, are what the networks say."""
    rng = np.random.default_rng(0)
    sigma, mean, std = 0.5, np.array([0.3, -0.2]), np.array([0.8, 1.3])
    W = np.linalg.qr(rng.normal(size=(O, S)))[0] * np.array([1.0, 0.7])
    b = rng.normal(size=O)
    scales = (W**2).sum(0)
    after = 1 / np.sqrt(1 / std**2 + scales / sigma**2)
    gain = (after**2 / sigma**2)[:, None] * W.T
    f = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    line = lambda w, c: Dense((Linear(f(w), f(c)),))  # noqa: E731
    zero = Linear(jnp.zeros((3 * M, S + A)), jnp.zeros(3 * M)), Linear(jnp.zeros((3 * M, M)), jnp.zeros(3 * M))
    model = StateSpace(
        Cell(*zero),
        line(np.zeros((2 * S, M)), np.concatenate([mean, raw_of(std)])),
        line(np.eye(O), np.zeros(O)),
        line(
            np.concatenate([np.zeros((2 * S, M)), np.concatenate([gain, np.zeros((S, O))])], 1),
            np.concatenate([mean - gain @ (b + W @ mean), raw_of(after)]),
        ),
        line(np.concatenate([np.zeros((O, M)), W], 1), b),
        line(np.zeros((2, M + S)), np.zeros(2)),
    )
    return model, b + W @ mean, W @ np.diag(std**2) @ W.T + sigma**2 * np.eye(O), sigma


def test_the_bound_and_the_likelihood(item):
    """With the exact posterior in the encoder the bound is the log-likelihood; with another it is less by the KL divergence from it."""
    model, mean, covariance, sigma = exact_model()
    count = 4000
    seen = np.random.default_rng(1).multivariate_normal(mean, covariance, (2, count))
    before, after = (jnp.asarray(x[None], jnp.float32) for x in seen)
    nothing = jnp.zeros((1, count))
    rest = (jnp.zeros((1, count, A)), nothing, nothing, nothing > 0, jnp.ones(count), jnp.zeros(()))
    normal = O / 2 * np.log(2 * np.pi * sigma**2)
    error = seen.reshape(-1, O) - mean
    exact = (
        -0.5
        * ((error @ np.linalg.inv(covariance) * error).sum(1) + np.linalg.slogdet(2 * np.pi * covariance)[1]).mean()
    )

    def bounds(model: StateSpace) -> np.ndarray:
        terms = [BOUND(model, before, after, *rest, key) for key in jax.random.split(KEY, 20)]
        return np.array([-0.5 * float(t.observation) / sigma**2 - float(t.kl) - normal for t in terms])

    found = bounds(model)
    shift = 0.3
    worse = eqx.tree_at(lambda m: m.posterior.layers[0].bias, model, replace_fn=lambda bias: bias.at[0].add(shift))
    moved = bounds(worse)
    std = float(jax.nn.softplus(model.posterior.layers[0].bias[S])) + LEAST_STD
    spread = max(found.std(), moved.std()) / np.sqrt(20)
    with item("8.66") as check:
        check(
            abs(found.mean() - exact) / spread, "<=", 3.5, "bound with the exact posterior, from the likelihood, s.e."
        )
        gap = exact - moved.mean() - 0.5 * shift**2 / std**2
        check(abs(gap) / spread, "<=", 3.5, "with a shifted one, from the likelihood less the KL divergence, s.e.")
        check((exact - moved.mean()) / spread, ">=", 10, "and below it, s.e.")


def blind_model() -> StateSpace:
    """Random networks in which nothing depends on what is drawn of the random state."""
    keys = jax.random.split(KEY, 6)
    model = StateSpace(
        Cell.of(S + A, M, keys[0]), Dense.of(M, (5,), 2 * S, keys[1]), Dense.of(O, (5,), 6, keys[2]),
        Dense.of(M + 6, (5,), 2 * S, keys[3]), Dense.of(M + S, (5,), O, keys[4]), Dense.of(M + S, (5,), 2, keys[5]),
    )  # fmt: skip
    places = lambda m: (m.cell.inputs.weight, m.decoder.layers[0].weight, m.outcome.layers[0].weight)  # noqa: E731
    cell, decoder, outcome = places(model)
    return eqx.tree_at(places, model, (cell.at[:, :S].set(0.0), decoder.at[:, M:].set(0.0), outcome.at[:, M:].set(0.0)))


def test_memories_begin_anew(item):
    """A sequence with an end inside is worth the two pieces it is made of; and with the end forgotten it is not."""
    model, rng = jit(blind_model)(), np.random.default_rng(2)
    f = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)  # noqa: E731
    data = (f(4, 3, O), f(4, 3, O), f(4, 3, A), f(4, 3), jnp.zeros((4, 3)))
    done = jnp.zeros((4, 3), bool).at[1].set(True)
    ones, free = jnp.ones(3), jnp.zeros(())
    whole = BOUND(model, *data, done, ones, free, KEY)
    forgotten = BOUND(model, *data, jnp.zeros_like(done), ones, free, KEY)
    halves = [BOUND(model, *(x[i : i + 2] for x in data), jnp.zeros((2, 3), bool), ones, free, KEY) for i in (0, 2)]
    names = ("observation", "reward", "kl", "end")
    gap = max(abs(float(getattr(whole, n)) - np.mean([float(getattr(h, n)) for h in halves])) for n in names)
    wrong = max(abs(float(getattr(forgotten, n)) - np.mean([float(getattr(h, n)) for h in halves])) for n in names)
    with item("8.67") as check:
        check(gap, "<=", 1e-5, "terms of a sequence with an end inside, from those of its pieces")
        check(wrong, ">", 1e-3, "the same where the end is forgotten")


def test_free_nats():
    """A KL divergence below the free nats costs them, and has no gradient."""
    model, rng = jit(blind_model)(), np.random.default_rng(3)
    f = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)  # noqa: E731
    data = (f(4, 3, O), f(4, 3, O), f(4, 3, A), f(4, 3), jnp.zeros((4, 3)), jnp.zeros((4, 3), bool), jnp.ones(3))
    much, none = (BOUND(model, *data, jnp.asarray(n), KEY) for n in (1e3, 0.0))
    assert float(much.limited_kl) == 1e3 and float(none.limited_kl) == pytest.approx(float(none.kl))
    slope = jit(jax.grad(lambda m: sequence_bound(m, *data, jnp.asarray(1e3), KEY).limited_kl))(model)
    assert all(float(jnp.abs(g).max()) == 0.0 for g in jax.tree.leaves(slope))


def test_acting_filters_as_the_model_learned(item):
    """Memory and state of the policy after three looks, against the model's own steps; a new episode begins with an empty memory."""
    spec = EnvSpec(Spec("box", (O,), low=(-1.0,), high=(1.0,)), Spec("box", (A,), low=(-2.0,), high=(2.0,)))
    planner = CrossEntropy(samples=6, elites=2, iterations=1)
    learner = PlaNet(memory_size=M, state_size=S, encoder_sizes=(5, 4), sizes=(5,), planner=planner, horizon=3)
    state = jit(lambda key: learner.init(spec, key))(KEY)
    policy, act = learner.policy(state, explore=True), jit(lambda p, c, o, k: p(c, o, k))
    seen = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (3, O)), jnp.float32)
    carry, networks, memory, past = policy.init(KEY), state.networks, jnp.zeros(M), None
    move = jit(lambda n, h, s, a: n.step(h, s, a)[0])
    look = jit(lambda n, h, o: n.filtered(h, n.encoder(o)).mode())
    for i, o in enumerate(seen):
        carry, action, _ = act(policy, carry, o, jax.random.fold_in(KEY, i))
        if past is not None:
            memory = move(networks, memory, *past)
        mean = look(networks, memory, o)
        past = (mean, action / 2.0)
        with item("8.67") as check:
            gap = float(jnp.abs(carry.memory - memory).max() + jnp.abs(carry.state - mean).max())
            check(gap, "<=", 1e-5, f"memory and state while acting from the model's, look {i + 1}")
    assert bool(policy.init(KEY).fresh) and not bool(carry.fresh)
    assert set(jit(lambda p, c, o: p.inspect(c, o))(policy, carry, seen[0])) == {"value", "mean"}


def test_refusals():
    with pytest.raises(ValueError, match="at least one layer"):
        PlaNet(encoder_sizes=())
    with pytest.raises(ValueError, match="free_nats"):
        PlaNet(free_nats=-1.0)
