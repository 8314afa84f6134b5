"""The estimators that learners train with, against the exact gradient."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import small

from rewardtogo.exact import (
    enumerate_observed,
    estimator_moments,
    gradient_samples,
    optimal_baselines,
    policy_gradient,
    softmax_policy,
    v_values,
    weights_of,
)
from rewardtogo.ops.estimators import Estimator, Steps, leave_one_out, optimal_baseline

GAMMA = 0.9
SMALL = small(GAMMA)
V = v_values(SMALL.mdp, softmax_policy(SMALL.logits))
ARRAYS = ("reward", "discount", "cut", "value", "next_value", "ratio")


@pytest.mark.parametrize("second", [False, True], ids=["option 1", "option 2"])
@pytest.mark.parametrize(
    ("returns", "baseline", "item_id"),
    [
        ("reward_to_go", "none", "3.18"),
        ("reward_to_go", "value", "4.28"),
        ("n_step", "value", "4.30"),
        ("gae", "value", "4.33"),
        ("vtrace", "value", "4.27"),
        ("gae", "none", "4.33"),
    ],
)
def test_every_member_is_unbiased_when_v_is_exact(item, returns, baseline, item_id, second):
    estimator = Estimator(returns, baseline, second, GAMMA, 0.6, 2)
    exact = policy_gradient(SMALL.mdp, SMALL.logits, discounting="option_2" if second else "option_1")
    with jax.enable_x64(True):
        found = estimator_moments(SMALL.mdp, SMALL.logits, weights_of(estimator, V))
    with item(item_id) as check:
        check(np.abs(found.mean - exact).max(), "<=", 1e-12, f"{returns}, {baseline}: bias, by enumeration")


def test_the_full_return_is_the_gradient_of_the_undiscounted_objective(item):
    plain = small(1.0)
    with jax.enable_x64(True):
        found = estimator_moments(plain.mdp, plain.logits, weights_of(Estimator("full", "none", gamma=1.0)))
    with item("3.5") as check:
        check(np.abs(found.mean - policy_gradient(plain.mdp, plain.logits)).max(), "<=", 1e-12, "`full`, `none`")


def test_the_variance_of_a_learners_estimator_can_be_asked_for(item):
    found = {}
    with jax.enable_x64(True):
        for returns, baseline in (("full", "none"), ("reward_to_go", "none"), ("reward_to_go", "value")):
            weights = weights_of(Estimator(returns, baseline, gamma=GAMMA), V)
            found[returns, baseline] = estimator_moments(SMALL.mdp, SMALL.logits, weights).total_variance
    with item("4.28") as check:
        check(found["reward_to_go", "value"], "<", found["reward_to_go", "none"], "variance, V against none")
        check(found["reward_to_go", "none"], "<", found["full", "none"], "variance, reward-to-go against full")


def batches(size):
    """Every batch of some trajectories of two steps, and its probability, `[K, N, T]`."""
    every, log_probs = enumerate_observed(SMALL.mdp, softmax_policy(SMALL.logits), 2)
    index = np.array(list(itertools.product(range(len(log_probs)), repeat=size)))
    scores = np.stack(
        [gradient_samples(SMALL.logits, every, np.broadcast_to(np.eye(2)[t], every.rewards.shape)) for t in range(2)], 1
    )
    return np.asarray(every.rewards)[index], scores[index], np.exp(log_probs[index].sum(-1))


@pytest.mark.parametrize(("baseline", "ratio", "item_id"), [("mean", 2 / 3, "3.20"), ("leave_one_out", 1.0, "3.21")])
def test_baselines_made_of_the_batch(item, baseline, ratio, item_id):
    rewards, scores, chance = batches(3)
    estimator = Estimator("full", baseline, gamma=1.0)

    def weigh(reward):
        zero, no = jnp.zeros_like(reward), jnp.zeros(reward.shape, bool).at[-1].set(True)
        return estimator.weights(Steps(reward, 1.0 - no, no, zero, zero, zero + 1.0, jnp.zeros(3, jnp.int32)))

    with jax.enable_x64(True):
        psi = np.asarray(jax.vmap(weigh)(jnp.asarray(np.swapaxes(rewards, 1, 2))))
    found = np.einsum("k,ktn,knt...->...", chance, psi, scores) / 3
    plain = np.einsum("k,kn,knt...->...", chance, rewards.sum(-1), scores) / 3
    with item(item_id) as check:
        check(
            np.abs(found / plain - ratio).max(),
            "<=",
            1e-12,
            f"`{baseline}`, N = 3: E[g] is {ratio:.4f} of the gradient",
        )


def steps(*, cut, reward, discount=None, elapsed=0):
    """One environment's rows as `[T, 1]`."""
    cut, reward = np.asarray(cut, bool)[:, None], np.asarray(reward, np.float32)[:, None]
    zero = np.zeros_like(reward)
    discount = np.where(cut, 0.0, 0.5).astype(np.float32) if discount is None else discount
    return Steps(
        *(jnp.asarray(x) for x in (reward, discount, cut, zero, zero, zero + 1)), jnp.full(1, elapsed, jnp.int32)
    )


def test_trajectories_and_times_by_hand():
    s = steps(cut=[0, 1, 0, 0, 1, 0], reward=[1, 2, 4, 8, 16, 32], elapsed=7)
    assert s.start[:, 0].tolist() == [0, 0, 2, 2, 2, 5]
    assert s.time[:, 0].tolist() == [7, 8, 0, 1, 2, 0]
    assert Estimator("full", "none").estimated_returns(s)[:, 0].tolist() == [2, 2, 12, 12, 12, 32]
    weights = Estimator("reward_to_go", "none", True, gamma=0.5).weights(s)
    expected = np.array([2, 2, 12, 16, 16, 32]) * 0.5 ** np.array([7, 8, 0, 1, 2, 0])
    np.testing.assert_allclose(weights[:, 0], expected, rtol=1e-6)


def test_baselines_by_hand():
    returns, trajectory = jnp.asarray([[1.0, 5.0], [3.0, 7.0]]), jnp.asarray([[0, 1], [0, 1]])
    np.testing.assert_allclose(leave_one_out(returns, trajectory), [[6, 2], [6, 2]])
    np.testing.assert_allclose(leave_one_out(returns, jnp.zeros((2, 2), int)), 0)
    s = steps(cut=[0, 1, 0, 1], reward=[1, 2, 3, 4], discount=np.zeros((4, 1), np.float32))
    np.testing.assert_allclose(Estimator("reward_to_go", "time_mean").weights(s)[:, 0], [-1, -1, 1, 1])


def test_the_optimal_baseline_has_the_least_variance(item):
    rng = np.random.default_rng(0)
    scores, returns = rng.normal(size=(200, 3)) * [1, 2, 5], rng.normal(size=200) + 3
    returns = returns + scores[:, 2] ** 2 / 25
    grid = np.linspace(-2, 8, 2001)
    second = lambda b: (scores**2 * (returns[:, None] - b) ** 2).mean(0)  # noqa: E731
    best = np.array([second(b) for b in grid])
    with jax.enable_x64(True):
        each = np.asarray(optimal_baseline(jnp.asarray(scores), jnp.asarray(returns), per_parameter=True))
        one = np.asarray(optimal_baseline(jnp.asarray(scores), jnp.asarray(returns), per_parameter=False))
    with item("3.24") as check:
        check(
            np.abs(grid[best.argmin(0)] - each).max(), "<=", 0.0026, "per parameter: distance from the best of a grid"
        )
        check(abs(grid[best.sum(1).argmin()] - one), "<=", 0.0026, "scalar: distance from the best of a grid")


def test_a_batch_estimates_the_exact_optimal_baselines(item):
    """`Estimator.gradient` forms them from trajectories, as `optimal_baselines` does from probabilities."""
    plain = small(1.0)
    every, log_probs = enumerate_observed(plain.mdp, softmax_policy(plain.logits))
    copies = np.repeat(np.arange(len(log_probs)), np.round(np.exp(log_probs) * 20_000).astype(int))
    score = np.stack(
        [gradient_samples(plain.logits, every, np.broadcast_to(np.eye(3)[t], every.rewards.shape)) for t in range(3)], 1
    )[copies].reshape(len(copies), 3, -1)
    total = np.asarray(every.returns())[copies]
    exact, scalar = optimal_baselines(plain.mdp, plain.logits)
    whole = score.sum(1)
    with item("3.24") as check, jax.enable_x64(True):
        each = optimal_baseline(jnp.asarray(whole), jnp.asarray(total), per_parameter=True)
        one = optimal_baseline(jnp.asarray(whole), jnp.asarray(total), per_parameter=False)
        check(np.abs(each - exact.ravel()).max(), "<=", 0.02, "per parameter, 20,000 trajectories in proportion")
        check(abs(one - scalar), "<=", 0.02, "scalar")
        reward = jnp.asarray(np.asarray(every.rewards)[copies].T)
        no = jnp.zeros(reward.shape, bool).at[-1].set(True)
        s = Steps(reward, 1.0 - no, no, 0 * reward, 0 * reward, 0 * reward + 1, jnp.zeros(len(copies), jnp.int32))
        for name, b in (("optimal", one), ("optimal_per_parameter", each)):
            found = Estimator("full", name, gamma=1.0).gradient(s, jnp.asarray(np.swapaxes(score, 0, 1)))
            by_hand = (whole * (total[:, None] - np.asarray(b))).sum(0) / reward.size
            check(np.abs(found - by_hand).max(), "<=", 1e-12, f"`{name}`: the gradient by hand")


def test_a_baseline_of_a_batch_has_no_weights_of_its_own():
    with pytest.raises(ValueError, match="batch"):
        weights_of(Estimator("full", "mean"))
    with pytest.raises(ValueError, match="scores"):
        Estimator("full", "optimal").weights(steps(cut=[0, 1], reward=[1, 1]))
