import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from rewardtogo.envs.tabular import POMDP, TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import (
    TablePolicy,
    chain_distributions,
    chi_square_tail,
    discounted_occupancy,
    induced_chain,
    markov_test,
    simulate,
    simulate_chain,
    state_distributions,
    stationary_distribution,
)
from rewardtogo.figures import markov_chain


def test_simulated_chains_follow_the_powers_of_p(item):
    rng = np.random.default_rng(0)
    matrix, initial = rng.dirichlet(np.ones(4), 4), rng.dirichlet(np.ones(4))
    exact = chain_distributions(matrix, initial, 8)
    states = np.asarray(simulate_chain(matrix, initial, jax.random.key(0), 100_000, 8))
    found = np.stack([np.bincount(states[:, t], minlength=4) / 1e5 for t in range(9)])
    with item("1.13") as check:
        check(
            (np.abs(found - exact) / np.sqrt(exact * (1 - exact) / 1e5)).max(), "<=", 4, "standard errors from d_0 P^t"
        )
        powers = np.stack([initial @ np.linalg.matrix_power(matrix, t) for t in range(9)])
        check(np.abs(exact - powers).max(), "<=", 1e-12, "recursion against matrix powers")


def test_stationary_distribution(item):
    residual, unlike = 0.0, 0.0
    for seed in range(30):
        matrix = np.random.default_rng(seed).dirichlet(np.full(5, 0.3), 5)
        d = stationary_distribution(matrix)
        residual, unlike = max(residual, np.abs(d @ matrix - d).max()), max(unlike, abs(d.sum() - 1), -d.min())
    absorbing = np.array([[0.5, 0.5], [0.0, 1.0]])
    with item("1.13") as check:
        check(residual, "<=", 1e-12, "residual of d = d P, 30 chains")
        check(unlike, "<=", 1e-12, "from being a distribution")
        check(np.abs(stationary_distribution(absorbing) - [0, 1]).max(), "==", 0, "transient states get 0")
    with pytest.raises(ValueError, match="several closed classes"):
        stationary_distribution(np.eye(2))


def test_distributions_of_a_policy():
    mdp, policy = random_mdp(0, 4, 2, num_terminal=1), random_policy(1, 4, 2)
    chain, _ = induced_chain(mdp, policy)
    assert np.allclose(state_distributions(mdp, policy, 6), chain_distributions(chain, mdp.initial, 6), atol=1e-14)
    assert np.allclose(discounted_occupancy(mdp, policy), discounted_occupancy(mdp, policy, 400), atol=1e-12)
    endless = random_mdp(2, 3, 2)
    assert discounted_occupancy(endless, random_policy(3, 3, 2)).sum() == pytest.approx(10, abs=1e-12)
    with pytest.raises(ValueError, match="give a horizon"):
        state_distributions(mdp, policy)


ALIASED = POMDP(random_mdp(4, 4, 2, concentration=0.3), np.eye(2)[[0, 0, 1, 1]])


def observed(problem, size, seed):
    policy = TablePolicy(jnp.full((size, 2), 0.5))
    batch = simulate(TabularEnv(problem), policy, jax.random.key(seed), 600, 50)
    return markov_test(batch.observations, batch.actions, batch.lengths)


def test_the_markov_property_is_accepted_and_rejected(item):
    with item("1.12") as check:
        accepted = observed(ALIASED.mdp, 4, 0)
        check(
            accepted.p_value, ">", 0.01, f"states of the MDP, χ² {accepted.statistic:.0f}/{accepted.degrees_of_freedom}"
        )
        rejected = observed(ALIASED, 2, 0)
        check(rejected.p_value, "<", 1e-6, f"aliased, χ² {rejected.statistic:.0f}/{rejected.degrees_of_freedom}")


def test_p_values_are_uniform_where_the_property_holds(item):
    """Otherwise accepting would say nothing: under the null p-values must be uniform, whatever the chain."""
    mdps = [random_mdp(seed, 4, 2, num_terminal=seed % 2) for seed in range(5)]
    ps = [observed(mdp, 4, seed).p_value for mdp in mdps for seed in range(12)]
    with item("1.12") as check:
        check(scipy.stats.kstest(ps, "uniform").pvalue, ">", 0.001, "Kolmogorov-Smirnov p of 60 p-values")


def test_too_few_data_are_refused():
    with pytest.raises(ValueError, match="too few"):
        markov_test(np.zeros((2, 4), int), np.zeros((2, 3), int))


def test_the_tail_of_chi_square():
    for statistic, freedom in [(3.0, 2), (60.0, 40), (400.0, 60), (900.0, 30)]:
        expected = scipy.stats.chi2.sf(statistic, freedom)
        assert chi_square_tail(statistic, freedom) == pytest.approx(expected, rel=1e-9)


def test_figure_1_1_shows_simulation_and_theory_together(item):
    figure = markov_chain.draw(seed=3, num_chains=1000)
    lines = figure.axes[-1].get_lines()
    exact = np.array([line.get_ydata() for line in lines[1::3]])
    dots = np.array([line.get_ydata() for line in lines[2::3]])
    dashes = np.array([np.asarray(line.get_ydata())[0] for line in lines[0::3]])
    with item("1.13") as check:
        errors = np.sqrt(exact * (1 - exact) / 1000)
        check((np.abs(dots - exact) - 4 * errors).max(), "<=", 1e-9, "figure: dots beyond 4 standard errors of d_0 P^t")
        check(np.abs(exact[:, -1] - dashes).max(), "<=", 0.01, "figure: d_t settles at the stationary d")
        figure.canvas.draw()
