"""The Lagrangian of the trust region, and dual gradient descent."""

import numpy as np
import pytest
from theory_problems import problems

from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import softmax_policy
from rewardtogo.policy_gradient.duals import dual_gradient_descent, dual_kl_update, lagrangian, lagrangian_gradient
from rewardtogo.policy_gradient.trust_regions import kl_constrained_update, occupancy_kl


def test_the_gradient_of_the_lagrangian(item):
    worst, step = 0.0, 1e-5
    for mdp, new, old in problems(24):
        logits = np.log(new)
        found = lagrangian_gradient(mdp, logits, old, 0.7)
        for place in np.ndindex(logits.shape):
            moved = np.zeros_like(logits)
            moved[place] = step
            ends = [lagrangian(mdp, softmax_policy(x), old, 0.7, 0.01) for x in (logits + moved, logits - moved)]
            worst = max(worst, abs((ends[0] - ends[1]) / (2 * step) - found[place]))
    with item("7.18") as check:
        check(worst, "<=", 1e-7, "against differences")


def test_the_stationary_point_is_the_constrained_update(item):
    slope, higher, tested = 0.0, -np.inf, 0
    rng = np.random.default_rng(0)
    for mdp, _, old in problems(40):
        best = kl_constrained_update(mdp, old, 0.01)
        if not best.multiplier > 0:
            continue
        tested += 1
        multiplier = float(best.multiplier)
        slope = max(slope, np.abs(lagrangian_gradient(mdp, np.log(best.policy), old, multiplier)).max())
        top = lagrangian(mdp, best.policy, old, multiplier, 0.01)
        for size in (1e-3, 0.1, 1.0):
            other = softmax_policy(np.log(best.policy) + size * rng.normal(size=best.policy.shape))
            higher = max(higher, lagrangian(mdp, other, old, multiplier, 0.01) - top)
    with item("7.18") as check:
        check(slope, "<=", 1e-9, "gradient of L at the exact update and its λ")
        check(higher, "<=", 1e-12, "L of random policies beyond its own: a maximum")
        check(tested, ">", 30, "problems")


def ascend(x, multiplier):
    """One small step up -(x - 2)² - λ (x - limit): far from the maximum, so incomplete."""
    return x + 0.1 * (-2 * (x - 2) - multiplier)


def test_dual_gradient_descent_in_one_dimension(item):
    binds = dual_gradient_descent(ascend, lambda x: float(x[0]) - 1, np.zeros(1))
    free = dual_gradient_descent(ascend, lambda x: float(x[0]) - 3, np.zeros(1))
    unprojected, point = 1.0, np.zeros(1)
    for _ in range(1000):
        point = ascend(point, unprojected)
        unprojected += 0.1 * (float(point[0]) - 3)
    with item("7.19") as check:
        check(abs(binds.multiplier - 2), "<=", 1e-3, "λ from 2, for max -(x - 2)² with x <= 1")
        check(abs(binds.point[0] - 1), "<=", 1e-3, "x from 1")
        check(min(binds.multipliers.min(), free.multipliers.min()), ">=", 0, "least λ on the way")
        check(abs(free.multiplier), "<=", 1e-3, "λ where the constraint x <= 3 does not bind")
        check(abs(free.point[0] - 2), "<=", 1e-3, "and x, free of it, from 2")
        check(unprojected, "<", -1, "E7.7: λ of the printed step, without max(0, .)")
        check(abs(point[0] - 2), ">", 0.5, "E7.7: which drives x to the edge of the constraint instead")


def test_dual_gradient_descent_finds_the_constrained_update(item):
    apart, off, away, tested = 0.0, 0.0, 0.0, 0
    for mdp, _, old in problems(12):
        best = kl_constrained_update(mdp, old, 0.01)
        if not best.multiplier > 0:
            continue
        tested += 1
        known = float(best.multiplier)
        end = dual_kl_update(mdp, old, 0.01, multiplier=known * (5, 0.2)[tested % 2], inner_steps=2, iterations=400)
        apart = max(apart, abs(end.multiplier / known - 1))
        off = max(off, abs(occupancy_kl(mdp, end.point, old) / 0.01 - 1))
        away = max(away, np.abs(end.point - best.policy).max())
    with item("7.19") as check:
        check(apart, "<=", 1e-3, "λ / known λ - 1, from 5 times or a fifth of it, 2 inner steps a round")
        check(off, "<=", 0.05, "|KL / ε - 1|")
        check(away, "<=", 1e-3, "policy against the exact update")
        check(tested, ">", 8, "problems")


def test_a_constraint_that_does_not_bind_costs_nothing(item):
    mdp, old = random_mdp(0, 3, 2), random_policy(0, 3, 2)
    end = dual_kl_update(mdp, old, 50.0, rate=0.1)
    with item("7.19") as check:
        check(end.multiplier, "==", 0, "λ with room for any policy")
        check(end.multipliers.min(), ">=", 0, "least λ on the way")


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda mdp, pi: lagrangian(mdp, pi, pi, -1.0, 0.1), r"multiplier is -1\.0 and must be"),
        (lambda mdp, pi: lagrangian(mdp, pi, pi, 1.0, -0.1), r"KL target is -0\.1"),
        (lambda mdp, pi: dual_kl_update(mdp, pi, 0.0), r"KL target is 0\.0"),
        (lambda mdp, pi: dual_kl_update(mdp, pi, 0.1, inner_steps=0), "inner_steps is 0"),
        (lambda mdp, pi: dual_kl_update(mdp, pi, 0.1, rate=-1.0), r"rate is -1\.0"),
        (lambda mdp, pi: lagrangian_gradient(mdp, np.zeros((3, 2)), np.eye(2)[[0, 0, 0]], 1.0), "give logits of -inf"),
        (lambda mdp, pi: dual_gradient_descent(lambda x, w: x, lambda x: np.inf, np.zeros(1)), "after 1 rounds"),
    ],
)
def test_bad_input_is_refused(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call(random_mdp(0, 3, 2), random_policy(0, 3, 2))
