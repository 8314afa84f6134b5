"""TRPO: the line search, the trust region over a run, and what it shares with the natural gradient and not with PPO."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import MaskedProbe, jit, lstm, small, small_env
from rewardtogo.core import MASK
from rewardtogo.envs.pendulum import Pendulum
from rewardtogo.policy_gradient.fisher import mean_kl
from rewardtogo.policy_gradient.fit import action_laws, actor_parameters, critic, samples_of
from rewardtogo.policy_gradient.natural import NaturalState
from rewardtogo.policy_gradient.npg import NPG
from rewardtogo.policy_gradient.trpo import TRPO, line_search

KEY = jax.random.key(0)
LENGTH = 40
ENV = rtg.vectorize(small_env(), 4)


# --- the line search -------------------------------------------------------------------------------------------------


@functools.cache
def searcher(tries: int) -> Any:
    """A search in one dimension from 0 by a step of 1: the objective is peak^2 - (x - peak)^2, the KL x^2 / 2."""

    def search(peak: Any, kl: Any, shrink: Any) -> Any:
        evaluate = lambda x: (peak**2 - ((x - peak) ** 2).sum(), 0.5 * (x**2).sum())  # noqa: E731
        zero = jnp.zeros(())
        return line_search(evaluate, jnp.zeros(1), jnp.ones(1), zero, kl, shrink, tries)

    return jit(search)


@pytest.mark.parametrize(
    ("peak", "kl", "fraction", "tries"),
    [
        (1.0, 0.51, 1.0, 1),  # the whole step
        (1.0, 0.3, 0.5, 2),  # shortened by the KL
        (0.2, 9.0, 0.25, 3),  # shortened by the objective, which is positive below 0.4
        (0.2, 0.01, 0.125, 4),  # by both
        (-1.0, 9.0, 0.0, 5),  # downhill all the way: given up
        (1.0, 1e-6, 0.0, 5),  # the KL never fits: given up
        (float("nan"), 9.0, 0.0, 5),
    ],
)
def test_the_line_search(peak, kl, fraction, tries):
    found = searcher(5)(peak, kl, 0.5)
    assert float(found.fraction) == pytest.approx(fraction)
    assert int(found.tries) == tries
    assert bool(found.accepted) == (fraction > 0)
    assert float(found.parameters[0]) == pytest.approx(fraction)
    assert float(found.kl) == pytest.approx(0.5 * fraction**2)
    if fraction:
        assert float(found.improvement) == pytest.approx(peak**2 - (fraction - peak) ** 2, rel=1e-5)
    else:
        assert float(found.improvement) == 0.0


def test_a_step_that_is_given_up_leaves_the_same_bits():
    start = jax.random.normal(KEY, (50,))
    found = line_search(lambda x: (-x.sum() * 0, (x**2).sum()), start, jnp.ones(50), jnp.zeros(()), 9e9, 0.8, 10)
    assert not bool(found.accepted)
    assert np.asarray(found.parameters).tobytes() == np.asarray(start).tobytes()


# --- the learner -----------------------------------------------------------------------------------------------------


def make(**options: Any) -> TRPO:
    return TRPO(**{"network": small, "value_epochs": 1, "gamma": 0.97, "gae_lambda": 0.9, **options})


@functools.cache
def run(network: Any = small, iterations: int = 12, **options: Any) -> tuple[Any, Any, Any]:
    """Learner states before each update and after the last, the rollouts, and the metrics, of a whole run."""
    loop = rtg.OnPolicy(ENV, make(network=network, **options), unroll=LENGTH)

    def iterate(state: Any, key: jax.Array) -> tuple[Any, Any]:
        collect_key, update_key = jax.random.split(key)
        policy = loop.policy(state, explore=True)
        actor, rollout, _ = rtg.collect(ENV, policy, state.actor, collect_key, LENGTH)
        learner, metrics, _ = loop.learner.update(state.learner, rollout, update_key)
        return eqx.tree_at(lambda s: (s.learner, s.actor), state, (learner, actor)), (state.learner, rollout, metrics)

    def whole(key: jax.Array) -> tuple[Any, Any, Any]:
        last, (states, rollouts, metrics) = jax.lax.scan(iterate, loop.init(key), jax.random.split(key, iterations))
        append = lambda xs, x: jnp.concatenate([xs, x[None]])  # noqa: E731
        return jax.tree.map(append, states, last.learner), rollouts, metrics

    return jit(whole)(KEY)


def kls(states: Any, rollouts: Any, kl_direction: str) -> np.ndarray:
    """The KL of every update, from the distributions before and after it in the states of its rollout."""

    def one(before: Any, after: Any, rollout: Any) -> jax.Array:
        samples = samples_of(before.network, before.norm, rollout, 0.97, 0.9, True, 32)
        old, new = action_laws(before.network, samples), action_laws(after.network, samples)
        return mean_kl(old, new) if kl_direction == "old_new" else mean_kl(new, old)

    first, then = (jax.tree.map(lambda x: x[i : len(x) - 1 + i], states) for i in (0, 1))  # noqa: B023
    return np.asarray(jit(jax.vmap(one))(first, then, rollouts), np.float64)


@pytest.mark.parametrize(
    ("network", "direction", "eps", "damping"),
    [(small, "old_new", 0.05, 1e-3), (small, "new_old", 0.01, 0.1), (lstm, "old_new", 0.01, 0.1)],
)
def test_the_policy_stays_in_the_trust_region(item, network, direction, eps, damping):
    states, rollouts, metrics = run(network, target_kl=eps, kl_direction=direction, damping=damping)
    measured = kls(states, rollouts, direction)
    accepted = np.asarray(metrics["accepted"]) > 0
    with item("7.26") as check:
        check(measured.max() / eps, "<=", 1.5, f"greatest KL of {len(measured)} updates over eps, {direction}")
        check(
            float(metrics["kl"].max()) / eps, "<=", 1.0, f"greatest KL that the search accepted over eps, {direction}"
        )
        check(float(metrics["improvement"][accepted].min()), ">", 0.0, "least gain of the surrogate")
    np.testing.assert_allclose(measured, metrics["kl"], atol=0.02 * eps)
    # The tests above would also pass for a policy that stands still.
    assert accepted.mean() > 0.8
    # Of the quadratic alone, hardly damped, every second step or so would have been too long.
    assert damping > 1e-3 or float(metrics["step_fraction"].min()) < 0.7
    assert np.median(measured) > 0.1 * eps
    assert all(bool(jnp.isfinite(value).all()) for value in metrics.values())


def test_a_whole_step_is_the_natural_gradient(item):
    """From one state and one rollout: TRPO that takes the first try is NPG; PPO goes elsewhere; the critics agree."""
    states, rollouts, _ = run()
    state, rollout = (jax.tree.map(lambda x: x[5], tree) for tree in (states, rollouts))
    update = lambda learner, s: jit(lambda s, r: learner.update(s, r, KEY))(s, rollout)[:2]  # noqa: E731
    options = {"network": small, "value_epochs": 1, "gamma": 0.97, "gae_lambda": 0.9}
    trpo, metrics = update(make(target_kl=1e-3), state)
    npg, _ = update(NPG(**options, kl_step=1e-3), NaturalState(state.network, state.optimiser, None, state.updates))
    assert float(metrics["step_fraction"]) == 1.0
    ppo_learner = rtg.PPO(network=small, epochs=1, minibatches=1, gamma=0.97, gae_lambda=0.9)
    fresh = ppo_learner.init(rtg.core.env_spec(ENV), KEY)
    ppo, _ = update(ppo_learner, eqx.tree_at(lambda s: s.network, fresh, state.network))
    theta = actor_parameters(state.network)[0]
    steps = [np.asarray(actor_parameters(s.network)[0] - theta, np.float64) for s in (trpo, npg, ppo)]
    unit = [step / np.linalg.norm(step) for step in steps]
    with item("3.43") as check:
        check(np.abs(steps[0] - steps[1]).max(), "<=", 1e-6, "TRPO's step, accepted at once, less NPG's")
        check(unit[1] @ unit[2], "<=", 0.9, "cosine of NPG's and PPO's step")
    for a, b in zip(jax.tree.leaves(critic(trpo.network)), jax.tree.leaves(critic(npg.network)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_nothing_to_gain_nothing_changed():
    """All advantages 0: no step succeeds, the policy keeps its bits, and the value function learns on."""
    states, rollouts, _ = run()
    state, rollout = (jax.tree.map(lambda x: x[5], tree) for tree in (states, rollouts))
    flat = eqx.tree_at(lambda s: s.network.value_head, state, jax.tree.map(jnp.zeros_like, state.network.value_head))
    still = eqx.tree_at(lambda r: r.transitions.reward, rollout, jnp.zeros_like(rollout.transitions.reward))
    new, metrics, _ = jit(lambda s, r: make().update(s, r, KEY))(flat, still)
    before, after = (np.asarray(actor_parameters(s.network)[0]) for s in (flat, new))
    assert before.tobytes() == after.tobytes()
    assert {name: float(metrics[name]) for name in ("accepted", "kl", "step_fraction", "improvement")} == {
        "accepted": 0.0,
        "kl": 0.0,
        "step_fraction": 0.0,
        "improvement": 0.0,
    }
    moved = jit(lambda s, r: make().update(s, r, KEY))(eqx.tree_at(lambda s: s.network, flat, state.network), still)[0]
    assert float(jnp.abs(moved.network.value_head.bias - state.network.value_head.bias)[0]) > 0


def test_a_masked_action_is_never_taken():
    env = rtg.vectorize(MaskedProbe(), 4)
    loop = rtg.OnPolicy(env, make(target_kl=0.05, fisher_every=2, normalise_observations=True), unroll=16)

    def play(key: jax.Array) -> Any:
        state = jax.lax.fori_loop(0, 3, lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0], loop.init(key))
        return state.learner, rtg.collect(env, loop.policy(state, explore=True), state.actor, key, 16)[1].transitions

    learner, t = jit(play)(KEY)
    assert np.all(np.take_along_axis(t.observation[MASK], t.action[..., None], -1) == 1)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(learner))


def test_a_gaussian_learns_its_width_too():
    env = rtg.vectorize(Pendulum(), 4)
    loop = rtg.OnPolicy(env, make(), unroll=LENGTH)
    step = jit(lambda s, k: loop.step(s, k))
    state = loop.init(KEY)
    after, (metrics, _) = step(state, KEY)
    assert float(metrics["accepted"]) == 1.0
    old, new = state.learner.network.head, after.learner.network.head
    assert float(jnp.abs(new.log_std - old.log_std)[0]) > 0
    assert float(jnp.abs(new.linear.weight - old.linear.weight).max()) > 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"target_kl": 0.0},
        {"target_kl": -0.01},
        {"cg_iterations": 0},
        {"line_search_steps": 0},
        {"shrink": 1.0},
        {"shrink": 0.0},
        {"damping": -1.0},
        {"minibatches": 0},
    ],
)
def test_what_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        TRPO(**wrong)
