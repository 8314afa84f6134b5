"""Lower bounds on the return, and the steps that keep within a distance."""

import numpy as np
import pytest
from theory_problems import drifting, problems

from rewardtogo.envs.tabular import MDP
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import advantage_values, expected_return, policy_closeness, tv_rows
from rewardtogo.policy_gradient.couplings import kl_rows, kl_to_tv
from rewardtogo.policy_gradient.theory import performance_difference, surrogate_advantage
from rewardtogo.policy_gradient.trust_regions import (
    advantage_limit,
    ball_constrained_step,
    improvement_penalty,
    kl_constrained_update,
    monotone_update,
    occupancy_kl,
    return_lower_bound,
    tv_constrained_update,
)


def test_lower_bounds_hold(item):
    worst, looser = {None: -np.inf, 6: -np.inf}, -np.inf
    for mdp, new, old in problems(1000):
        ours, trpo = (return_lower_bound(mdp, new, old, trpo=flag) for flag in (False, True))
        worst[mdp.horizon] = max(worst[mdp.horizon], ours - expected_return(mdp, new))
        looser = max(looser, trpo - ours)
    with item("7.12") as check:
        check(worst[None], "<=", 1e-9, "bound beyond J(π'), 500 problems that go on for ever")
        check(worst[6], "<=", 1e-9, "500 problems with a horizon: Σ_t 2 ε t γ^t max|E A_t|")
        check(looser, "<=", 1e-9, "TRPO's bound beyond ours")


def test_the_bound_is_attained_and_the_printed_one_is_none(item):
    eps, discount = 1e-4, 0.9
    mdp, new, old = drifting(eps, discount)
    lost = surrogate_advantage(mdp, new, old) - performance_difference(mdp, new, old)
    penalty = improvement_penalty(mdp, new, old)
    with item("7.12") as check:
        check(penalty - lost, ">=", 0, "what is lost by the mismatch is within the penalty")
        check(lost / penalty, ">=", 0.99, "and nearly all of it")
        printed = 2 * eps * eps / (1 - discount)
        check(lost / printed, ">", 8, "E7.4: with Σ_t γ^t C = max|E A| / (1 - γ) it is many times the penalty")
        times = np.arange(2000)
        check(abs((times * discount**times).sum() - 90), "<=", 1e-9, "E7.4: Σ_t t γ^t = γ / (1 - γ)² = 90")


def test_a_positive_surrogate_guarantees_nothing(item):
    mdp, new, old = drifting(0.05, 0.99)
    with item("7.12") as check:
        check(surrogate_advantage(mdp, new, old), ">", 4, "E7.5: surrogate gain")
        check(performance_difference(mdp, new, old), "<", -1, "E7.5: and what J did")
        check(return_lower_bound(mdp, new, old), "<", expected_return(mdp, old), "the bound promises nothing here")


def test_constants(item):
    worst, sharpest = {None: -np.inf, 6: -np.inf}, 0.0
    for mdp, _, old in problems(1000):
        found, limit = np.abs(advantage_values(mdp, old)).max((-1, -2)), advantage_limit(mdp)
        worst[mdp.horizon] = max(worst[mdp.horizon], (found - limit).max())
        sharpest = max(sharpest, (found / limit).max())
    with item("7.13") as check:
        check(worst[6], "<=", 1e-12, "max|A_t| beyond (T - t) range")
        check(worst[None], "<=", 1e-12, "max|A| beyond range / (1 - γ)")
        check(sharpest, ">", 0.5, "largest share of the limit, so that it is not empty")


def test_steps_of_bounded_total_variation(item):
    rng = np.random.default_rng(0)
    worst, beaten, falls = 0.0, -np.inf, -np.inf
    for mdp, _, old in problems(200):
        eps = rng.uniform(0, 1)
        new = tv_constrained_update(mdp, old, eps)
        worst = max(worst, policy_closeness(new, np.broadcast_to(old, new.shape)) - eps)
        falls = max(falls, expected_return(mdp, old) - expected_return(mdp, new))
        best = surrogate_advantage(mdp, new, old)
        for _ in range(5):
            other = rng.dirichlet(np.full(mdp.num_actions, 0.3), new.shape[:-1])
            share = np.minimum(1, eps / np.maximum(tv_rows(other, np.broadcast_to(old, new.shape)), 1e-12))[..., None]
            beaten = max(beaten, surrogate_advantage(mdp, share * other + (1 - share) * old, old) - best)
    with item("7.14") as check:
        check(worst, "<=", 1e-12, "D_TV beyond ε")
        check(beaten, "<=", 1e-12, "surrogate of 1000 random policies within ε, beyond that of the update")
        check(falls, "<=", 1e-12, "largest fall of J")


def test_updates_that_the_bound_guarantees_never_fall(item):
    falls, short, moved = -np.inf, -np.inf, 0
    for mdp, _, policy in problems(30):
        for _ in range(4):
            new = monotone_update(mdp, policy)
            rise = expected_return(mdp, new) - expected_return(mdp, policy)
            held = np.broadcast_to(policy, new.shape)
            moved += not np.array_equal(new, held)
            promised = surrogate_advantage(mdp, new, held) - improvement_penalty(mdp, new, held)
            short, falls, policy = max(short, promised - rise), max(falls, -rise), new
    with item("7.14") as check:
        check(falls, "<=", 1e-12, "largest fall of J over 120 updates")
        check(short, "<=", 1e-9, "promised rise beyond the real one")
        check(moved, ">", 100, "updates that moved")
    best = np.eye(2)[[0, 0]]
    flat = MDP(np.full((2, 2, 2), 0.5), np.array([[1.0, 0], [1.0, 0]]), 0, 0.9)
    assert np.array_equal(monotone_update(flat, best), best)


def test_steps_of_bounded_kl(item):
    apart, falls, tilt, multiplier, bound = 0.0, -np.inf, 0.0, 0.0, 0
    for seed, (mdp, _, old) in enumerate(problems(100)):
        eps = (1e-3, 0.01, 0.1)[seed % 3]
        step = kl_constrained_update(mdp, old, eps)
        falls = max(falls, expected_return(mdp, old) - expected_return(mdp, step.policy))
        if step.temperature > 0:
            bound += 1
            apart = max(apart, abs(occupancy_kl(mdp, step.policy, old) / eps - 1))
            weights = old * np.exp(advantage_values(mdp, old) / step.temperature)
            tilt = max(tilt, np.abs(weights / weights.sum(-1, keepdims=True) - step.policy).max())
            if seed % 5 == 0:
                ends = [kl_constrained_update(mdp, old, share * eps).policy for share in (1.001, 0.999)]
                rise = surrogate_advantage(mdp, ends[0], old) - surrogate_advantage(mdp, ends[1], old)
                multiplier = max(multiplier, abs(rise / (0.002 * eps) / step.multiplier - 1))
        else:
            apart = max(apart, (occupancy_kl(mdp, step.policy, old) - eps) / eps)
    with item("7.16") as check:
        check(apart, "<=", 1e-6, "E[KL] / ε - 1, 100 problems")
        check(tilt, "<=", 1e-9, "π' against π exp(A / η) / Z")
        check(falls, "<=", 1e-12, "largest fall of J")
        check(multiplier, "<=", 1e-4, "λ against the derivative of the best surrogate in ε")
        check(bound, ">", 90, "problems in which the constraint binds")


def test_steps_of_bounded_kl_in_every_state(item):
    apart, falls, beyond, promised = 0.0, -np.inf, -np.inf, -np.inf
    for mdp, _, old in problems(60):
        step = kl_constrained_update(mdp, old, 0.01, every_state=True)
        held = np.broadcast_to(old, step.policy.shape)
        rows, binds = kl_rows(step.policy, held), step.temperature > 0
        apart = max(apart, np.abs(rows[binds] / 0.01 - 1).max(initial=0), (rows - 0.01).max())
        falls = max(falls, expected_return(mdp, old) - expected_return(mdp, step.policy))
        beyond = max(beyond, policy_closeness(step.policy, held) - kl_to_tv(0.01))
        promised = max(promised, return_lower_bound(mdp, step.policy, held) - expected_return(mdp, step.policy))
    with item("7.16") as check:
        check(apart, "<=", 1e-6, "KL / ε - 1 in every state that it binds in")
        check(falls, "<=", 1e-12, "largest fall of J")
    with item("7.17") as check:
        check(beyond, "<=", 1e-12, "max_s D_TV beyond sqrt(ε_KL / 2) = 0.0707")
        check(promised, "<=", 1e-12, "lower bound beyond J(π') within this trust region")


def test_kl_steps_at_the_limits(item):
    mdp, old = random_mdp(0, 3, 3), random_policy(0, 3, 3)
    loose = kl_constrained_update(mdp, old, 100.0)
    tiny = kl_constrained_update(mdp, old, 1e-12)
    some = np.array([[0.5, 0.5, 0.0]] * 3)
    same = MDP(np.full((2, 2, 2), 0.5), np.array([[0.1, 0.1], [0.3, 0.3]]), 0, 0.9)
    with item("7.16") as check:
        greedy = np.eye(3)[advantage_values(mdp, old).argmax(-1)]
        check(np.abs(loose.policy - greedy).max(), "<=", 1e-12, "with room for it, the argmax step")
        check(loose.multiplier, "==", 0, "and λ = 0")
        check(abs(occupancy_kl(mdp, tiny.policy, old) / 1e-12 - 1), "<=", 1e-3, "KL / ε - 1 at ε = 1e-12")
        held = kl_constrained_update(mdp, some, 0.01).policy
        check(held[:, 2].max(), "==", 0, "what is never done stays so")
        for every_state in (False, True):
            flat = kl_constrained_update(
                same, old[:2, :2] / old[:2, :2].sum(-1, keepdims=True), 0.01, every_state=every_state
            )
            check(np.abs(flat.multiplier).max(), "==", 0, "equal actions move nothing")
    assert abs(occupancy_kl(mdp, tiny.policy, old) / occupancy_kl(mdp, tiny.policy, old, old_first=True) - 1) < 1e-3


def test_the_euclidean_step(item):
    rng = np.random.default_rng(0)
    norm, better = 0.0, -np.inf
    for size in (1e-200, 1e-3, 1.0, 1e200):
        g = rng.normal(size=7) * size
        step = ball_constrained_step(g, 0.02)
        norm = max(norm, abs((step**2).sum() - 0.02))
        others = rng.normal(size=(10_000, 7))
        others *= (np.sqrt(0.02) * rng.uniform(size=10_000) ** (1 / 7) / np.linalg.norm(others, axis=1))[:, None]
        better = max(better, (others @ (g / size)).max() - step @ (g / size))
    for name in ("3.37", "7.22"):
        with item(name) as check:
            check(norm, "<=", 1e-12, "||d||² from ε")
            check(better, "<=", 0, "g·d of the best of 10^4 random d in the ball, beyond that of the step")
            g = np.array([3.0, 4.0])
            check(
                np.abs(ball_constrained_step(g, 0.25) - [0.3, 0.4]).max(), "<=", 1e-15, "by hand: g = (3, 4), ε = 1/4"
            )
            # (E7.8) In a ball of radius ε, as the notes' word has it, the step would be sqrt(ε) times as long.
            check(np.linalg.norm(ball_constrained_step(g, 0.25)) - 0.25, ">", 0.2, "radius sqrt(ε), not ε")
    assert np.array_equal(ball_constrained_step(np.zeros(3), 0.1), np.zeros(3))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda mdp, pi: kl_constrained_update(mdp, pi, -0.01), r"KL target is -0\.01 and must be"),
        (lambda mdp, pi: kl_constrained_update(mdp, pi, float("nan")), "KL target is nan"),
        (lambda mdp, pi: tv_constrained_update(mdp, pi, 1.01), r"eps is 1\.01 and total variation lies in"),
        (lambda mdp, pi: ball_constrained_step(np.ones(2), -1.0), r"eps is -1\.0, and as the square of a radius"),
        (lambda mdp, pi: ball_constrained_step(np.array([np.nan]), 1.0), "not finite, so it has no direction"),
        (lambda mdp, pi: advantage_limit(ending()), "lower the discount or give a horizon"),
        (lambda mdp, pi: improvement_penalty(ending(), pi, pi), "lower the discount or give a horizon"),
    ],
)
def test_bad_input_is_refused(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call(random_mdp(0, 3, 2), random_policy(0, 3, 2))


def ending():
    return random_mdp(0, 3, 2, discount=1.0, num_terminal=1)
