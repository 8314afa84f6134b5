"""How far states move with the policy: bounds that hold, and the printed ones that do not."""

import jax
import numpy as np
import pytest
from theory_problems import problem, problems

from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import (
    greedy_policy,
    mixture_decomposition,
    policy_closeness,
    separation,
    state_distributions,
    state_l1_bound,
    tv_rows,
)
from rewardtogo.policy_gradient.couplings import (
    expectation_lower_bound,
    kl_rows,
    kl_to_tv,
    maximal_coupling,
    sample_maximal_coupling,
    tv_to_kl,
)

STEPS = np.arange(7)


def test_the_new_states_are_a_mixture(item):
    """For mixtures of policies, and for deterministic old policies and any new one, where ε is total variation."""
    least, sums, identity, first, apart = np.inf, 0.0, 0.0, 0.0, 0.0
    for seed in range(300):
        mdp, new, old = problem(seed, horizon=6)
        if seed % 3 == 0:
            old = greedy_policy(old)
            new = 0.8 * old + 0.2 * new
            apart = max(apart, abs(separation(new, old) - policy_closeness(new, old)))
        parts = mixture_decomposition(mdp, new, old)
        before, after = state_distributions(mdp, old), state_distributions(mdp, new)
        least, sums = min(least, parts.mistake.min()), max(sums, np.abs(parts.mistake.sum(-1) - 1).max())
        whole = parts.keep[:, None] * before + (1 - parts.keep)[:, None] * parts.mistake
        identity, first = max(identity, np.abs(whole - after).max()), max(first, abs(parts.keep[0] - 1))
    with item("7.7") as check:
        check(least, ">=", -1e-12, "least entry of p_mistake, 300 problems")
        check(sums, "<=", 1e-12, "its sum from 1")
        check(identity, "<=", 1e-12, "(1 - ε)^t d_t + (1 - (1 - ε)^t) p_mistake against d'_t")
        check(first, "==", 0, "t counts from 0: no action has been taken before s_0 (E2.2)")
        check(apart, "<=", 1e-12, "from a deterministic policy, ε is total variation")


def test_total_variation_alone_gives_no_mixture_of_a_stochastic_policy(item):
    """The notes' step from a deterministic to any policy: the bound survives it, the identity does not."""
    mdp = random_mdp(0, 2, 2, horizon=1)
    mdp = type(mdp)(np.eye(2)[None].repeat(2, 0), mdp.rewards, 0, 1.0, horizon=1)  # the action is the next state
    old, new = np.full((2, 2), 0.5), np.array([[0.6, 0.4]] * 2)
    eps = policy_closeness(new, old)
    after = state_distributions(mdp, new)[1]
    with item("7.7") as check:
        printed = after - (1 - eps) * state_distributions(mdp, old)[1]
        check(printed.min(), "<", -0.04, "residual with ε = D_TV = 0.1: no distribution")
        beyond = np.abs(after - state_distributions(mdp, old)[1]).sum() - state_l1_bound(eps, 1)
        check(beyond, "<=", 1e-12, "L1 distance beyond its bound, which holds with ε = D_TV")
        check(abs(separation(new, old) - 0.2), "<=", 1e-12, "from 1 - 0.4 / 0.5, the ε that the identity takes")
    with pytest.raises(ValueError, match=r"eps is 0\.1 and the new policy keeps only a share of 0\.8"):
        mixture_decomposition(mdp, new, old, eps=eps)
    assert mixture_decomposition(mdp, new, old, eps=0.5).mistake.min() >= 0


def test_the_l1_bound_of_states(item):
    worst, linear, sharpest = -np.inf, -np.inf, 0.0
    for mdp, new, old in problems(1000, horizon=6):
        moved = np.abs(state_distributions(mdp, new) - state_distributions(mdp, old)).sum(-1)
        bound = state_l1_bound(policy_closeness(new, old), STEPS)
        larger = state_l1_bound(policy_closeness(new, old), STEPS, linear=True)
        worst, linear = max(worst, (moved - bound).max()), max(linear, (bound - larger).max())
        sharpest = max(sharpest, (moved[1:] / bound[1:]).max())
    with item("7.8") as check:
        check(worst, "<=", 1e-12, "L1 distance beyond 2 (1 - (1 - ε)^t), 1000 problems, any two policies")
        check(linear, "<=", 1e-12, "2 (1 - (1 - ε)^t) beyond 2 ε t")
        check(sharpest, ">", 0.5, "largest share of the bound, so that it is not empty")


def test_closeness_is_total_variation(item):
    worst, exact = -np.inf, 0.0
    for seed in range(200):
        old, other = random_policy(seed, 4, 3), random_policy(seed + 1000, 4, 3)
        eps = np.random.default_rng(seed).uniform()
        worst = max(worst, policy_closeness((1 - eps) * old + eps * other, old) - eps)
        here, there = np.eye(3)[[seed % 3] * 4], np.eye(3)[[(seed + 1) % 3] * 4]
        exact = max(exact, abs(policy_closeness((1 - eps) * here + eps * there, here) - eps))
    old = np.full((1, 10), 0.1)
    new = old + 0.02 * np.array([1, -1] * 5)
    agree = np.trace(maximal_coupling(new[0], old[0]))
    with item("7.9") as check:
        check(worst, "<=", 1e-12, "beyond ε, for a share ε of another policy")
        check(exact, "<=", 1e-12, "from ε, for a disjoint one")
        check(agree - (1 - np.abs(new - old).max()), "<", -0.07, "E7.2: agreement from 1 - the printed |π' - π|")
        check(abs(agree - (1 - policy_closeness(new, old))), "<=", 1e-12, "agreement from 1 - D_TV")


def test_the_maximal_coupling(item):
    margins, agreement, least = 0.0, 0.0, np.inf
    for seed in range(200):
        p, q = random_policy(seed, 2, 5)
        joint = maximal_coupling(p, q)
        margins = max(margins, np.abs(joint.sum(1) - p).max(), np.abs(joint.sum(0) - q).max())
        agreement, least = max(agreement, abs(np.trace(joint) - 1 + tv_rows(p, q))), min(least, joint.min())
    p, q = np.array([0.5, 0.3, 0.2, 0.0]), np.array([0.2, 0.3, 0.1, 0.4])
    pairs = sample_maximal_coupling(p, q, jax.random.key(0), 100_000)
    same, share = (pairs[:, 0] == pairs[:, 1]).mean(), 1 - tv_rows(p, q)
    with item("7.10") as check:
        check(margins, "<=", 1e-12, "marginals of the joint")
        check(agreement, "<=", 1e-12, "P(x = y) from 1 - D_TV, exactly")
        check(least, ">=", 0, "least entry")
        check(abs(same - share) / np.sqrt(share * (1 - share) / 1e5), "<=", 3, "standard errors of P(x = y), samples")
        for name, k, law in (("x", 0, p), ("y", 1, q)):
            found = np.bincount(pairs[:, k], minlength=4) / 1e5
            errors = np.abs(found - law) / np.sqrt(np.maximum(law * (1 - law), 1e-12) / 1e5)
            check(errors.max(), "<=", 3.5, f"standard errors of the marginal of {name}")
    assert np.array_equal(maximal_coupling(p, p), np.diag(p))
    assert np.all(np.diff(sample_maximal_coupling(p, p, jax.random.key(1), 50)) == 0)


def test_the_bound_of_expectations(item):
    worst = -np.inf
    for seed, (mdp, new, old) in enumerate(problems(1000, horizon=6)):
        f = np.random.default_rng(seed).normal(size=mdp.num_states)
        before, after = state_distributions(mdp, old), state_distributions(mdp, new)
        eps = policy_closeness(new, old)
        for t in (0, 1, 3, 6):
            worst = max(worst, expectation_lower_bound(f, before[t], eps, t) - f @ after[t])
    old, new, f = np.array([0.5, 0.5]), np.array([0.9, 0.1]), np.array([-1.0, 0.0])
    eps = float(tv_rows(new, old))
    with item("7.11") as check:
        check(worst, "<=", 1e-12, "E_d f - 2 ε t max|f| beyond E_d' f, 1000 problems")
        check(f @ old - 2 * eps * f.max(), "==", -0.5, "E7.3: the printed bound, with max f")
        check(f @ new, "<", -0.5, "E7.3: what it was to bound from below")
        check(abs(expectation_lower_bound(f, old, eps, 1) + 1.3), "<=", 1e-12, "with max |f|: -1.3")


def pairs(count, outcomes=4):
    """Random pairs, some nearly degenerate (probabilities down to 1e-12), some nearly equal."""
    rng = np.random.default_rng(0)
    concentration = rng.choice([0.02, 0.2, 1.0, 10.0], (2, count, 1))
    weights = np.maximum(rng.gamma(concentration, size=(2, count, outcomes)), 1e-12)
    p, q = weights / weights.sum(-1, keepdims=True)
    share = rng.choice([1.0, 0.1, 1e-3], (count, 1))
    return p, (1 - share) * p + share * q


def test_pinsker(item):
    p, q = pairs(10_000)
    tv, least = tv_rows(p, q), min(p.min(), q.min())
    for name in ("7.15", "7.17"):
        with item(name) as check:
            for direction, kl in (("KL(p || q)", kl_rows(p, q)), ("KL(q || p)", kl_rows(q, p))):
                check((tv - kl_to_tv(kl)).max(), "<=", 1e-12, f"D_TV beyond sqrt({direction} / 2), 10^4 pairs")
    with item("7.15") as check:
        check(least, "<", 1e-11, "least probability among the pairs")
        check((tv - kl_rows(p, q)).max(), ">", 0.05, "E7.5: an ε of KL is not one of total variation")
        l1 = 2 * tv - kl_to_tv(kl_rows(p, q))
        check(l1.max(), ">", 0.05, "E7.6: nor is L1 within sqrt(KL / 2)")


def test_pinsker_becomes_tight(item):
    p = np.array([0.5, 0.5])
    ratios = [
        float(tv_rows(p, q) / kl_to_tv(kl_rows(p, q))) for q in (p + d * np.array([1, -1]) for d in (0.3, 1e-1, 1e-3))
    ]
    with item("7.17") as check:
        check(abs(1 - ratios[-1]), "<=", 1e-5, "D_TV / sqrt(KL / 2) as p -> q, Bernoulli(1/2)")
        check(min(np.diff(ratios)), ">", 0, "rising towards 1")
        check(abs(kl_to_tv(tv_to_kl(0.3)) - 0.3), "<=", 1e-15, "there and back")
    assert kl_rows(np.array([0.5, 0.5]), np.array([1.0, 0.0])) == np.inf
    assert kl_rows(np.array([1.0, 0.0]), p) == pytest.approx(np.log(2))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: state_l1_bound(1.5, 3), "eps is 1.5 and total variation lies in"),
        (lambda: state_l1_bound(0.1, -1), "t is -1 and time counts from 0"),
        (lambda: expectation_lower_bound(np.ones(2), np.ones(2), 0.1, 1), "not a distribution"),
        (lambda: policy_closeness(np.full((3, 2, 2), 0.5), np.full((4, 2, 2), 0.5)), "have shapes"),
        (lambda: tv_to_kl(-0.1), "eps is -0.1"),
        (lambda: kl_to_tv(-0.1), "none is below 0"),
        (lambda: sample_maximal_coupling(np.ones(1), np.ones(1), jax.random.key(0), 0), "number of samples is 0"),
        (lambda: mixture_decomposition(random_mdp(0, 2, 2), *[random_policy(0, 2, 2)] * 2), "give a horizon"),
    ],
)
def test_bad_input_is_refused(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()
