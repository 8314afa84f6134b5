import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.envs.tabular import MDP, TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import (
    TablePolicy,
    discounted_occupancy,
    expected_return,
    induced_chain,
    monte_carlo_return,
    optimal_policy,
    optimal_q_values,
    q_values,
    v_values,
)

CASES = [(seed, 2 + seed % 4, 1 + seed % 3) for seed in range(100)]


def test_reward_one_counts_the_steps(item):
    one = MDP(np.ones((1, 1, 1)), [[1.0]], horizon=5)
    two = MDP(np.ones((1, 1, 1)), [[1.0]], discount=0.9)
    always = np.ones((1, 1))
    with item("1.20") as check:
        check(np.abs(v_values(one, always)[:, 0] - [5, 4, 3, 2, 1, 0]).max(), "==", 0, "V_t = T - t (E1.2)")
        check(v_values(one, always).shape == (6, 1) and q_values(one, always).shape == (5, 1, 1), "==", True, "shapes")
        worst = max(abs(expected_return(two, always, n) - (1 - 0.9**n) / 0.1) for n in range(1, 50))
        check(worst, "<=", 1e-12, "(1 - γ^n) / (1 - γ)")
        check(abs(expected_return(two, always) - 10), "<=", 1e-12, "(I - γ P)^-1 r")


def test_discounted_values_solve_the_bellman_equation(item):
    worst_q, worst_v = 0.0, 0.0
    for seed, states, actions in CASES:
        mdp = random_mdp(seed, states, actions, num_terminal=seed % 2)
        policy = random_policy(seed + 1, states, actions)
        q, iterated = q_values(mdp, policy), q_values(mdp, policy, horizon=350)[0]
        worst_q = max(worst_q, np.abs(q - iterated).max())
        live = ~np.asarray(mdp.terminal)
        chain, reward = induced_chain(mdp, policy)
        value = np.linalg.inv(np.eye(states)[live][:, live] - 0.9 * chain[live][:, live]) @ reward[live]
        worst_v = max(worst_v, np.abs(v_values(mdp, policy)[live] - value).max(), *np.abs(v_values(mdp, policy)[~live]))
    with item("1.19") as check:
        check(worst_q, "<=", 1e-10, "350 Bellman backups against the matrix solve")
    with item("1.20") as check:
        check(worst_v, "<=", 1e-12, "(I - γ P_π)^-1 r_π over the states that go on")


@pytest.mark.parametrize("horizon", [4, None])
def test_q_is_the_mean_of_sampled_returns(item, horizon):
    mdp = random_mdp(11, 4, 2, num_terminal=1, horizon=horizon, discount=0.8)
    policy = random_policy(12, 4, 2)
    q = q_values(mdp, policy).reshape(-1, 4, 2)[0]
    cut = horizon or 60  # 0.8^60 = 1e-6, far below a standard error

    def sample(start, first, key):
        # The first action is fixed; from then on the policy acts.
        table = jnp.concatenate([first[None], jnp.broadcast_to(jnp.asarray(policy, jnp.float32), (cut - 1, 4, 2))])
        env = eqx.tree_at(lambda e: e.start_table, TabularEnv(mdp), start)
        return monte_carlo_return(env, TablePolicy(table), key, 10_000, cut, 0.8)

    starts = jnp.cumsum(jnp.repeat(jnp.eye(4)[:3], 2, 0), 1)
    firsts = jnp.tile(jnp.broadcast_to(jnp.eye(2)[:, None], (2, 4, 2)), (3, 1, 1))
    found = jax.vmap(sample)(starts, firsts, jax.random.split(jax.random.key(4), 6))
    with item("1.19") as check:
        z = np.abs(found.mean - q[:3].ravel()) / found.standard_error
        check(z.max(), "<=", 4, f"standard errors from Q, {'discounted' if horizon is None else 'finite'}")


def test_total_expectation(item):
    worst = dict.fromkeys(("V", "J", "occupancy"), 0.0)
    for seed, states, actions in CASES:
        mdp = random_mdp(seed, states, actions, num_terminal=seed % 2)
        for horizon in (None, 4):
            policy = random_policy(seed + 7, states, actions, horizon)
            q, v = q_values(mdp, policy, horizon), v_values(mdp, policy, horizon)
            first = v if horizon is None else v[0]
            worst["V"] = max(worst["V"], np.abs((policy * q).sum(-1) - (v if horizon is None else v[:-1])).max())
            j = expected_return(mdp, policy, horizon)
            worst["J"] = max(worst["J"], abs(j - sum(p * x for p, x in zip(mdp.initial, first, strict=True))))
            weighted = (discounted_occupancy(mdp, policy, horizon) * mdp.rewards).sum()
            worst["occupancy"] = max(worst["occupancy"], abs(j - weighted))
    with item("1.21") as check:
        check(worst["V"], "<=", 1e-12, "V = E_a[Q], 100 MDPs, finite and discounted")
        check(worst["J"], "<=", 1e-12, "J = E_{s0}[V(s0)], an expectation (E1.3)")
        check(worst["occupancy"], "<=", 1e-12, "J = Σ ρ r")


def test_the_sum_over_initial_states_is_not_j(item):
    """As the notes' words have it, 'sum the value function over all possible initial states' (erratum E1.3)."""
    mdp, policy = random_mdp(1, 4, 2), random_policy(2, 4, 2)
    with item("1.21") as check:
        check(abs(v_values(mdp, policy).sum() - expected_return(mdp, policy)), ">", 0.1, "a sum in place of a mean")


def test_undiscounted_optimum_of_a_maze_that_pays_at_the_end():
    """Every action ties in value where the goal pays 1 whenever it is reached; the policy must still get there."""
    transitions = np.zeros((6, 2, 6))
    for s in range(6):
        transitions[s, 0, max(s - 1, 0)] = transitions[s, 1, min(s + 1, 5)] = 1
    rewards = np.zeros((6, 2))
    rewards[4, 1] = 1
    mdp = MDP(transitions, rewards, terminal=np.arange(6) == 5)
    assert np.allclose(optimal_q_values(mdp)[:5], 1)
    assert expected_return(mdp, optimal_policy(mdp)) == pytest.approx(1)


def test_what_has_no_value_is_refused():
    transitions = np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]])
    mdp = MDP(transitions, np.ones((2, 2)), terminal=[False, True])
    with pytest.raises(ValueError, match="never reaches a terminal state"):
        v_values(mdp, np.array([[1.0, 0.0], [1.0, 0.0]]))
    with pytest.raises(ValueError, match="never reaches a terminal state"):
        optimal_q_values(mdp)  # the loop pays 1 for ever
    with pytest.raises(ValueError, match="must be"):
        v_values(mdp, np.ones((3, 2)) / 2)
    with pytest.raises(ValueError, match="not a distribution"):
        v_values(mdp, np.ones((2, 2)))
    with pytest.raises(ValueError, match="at least 1"):
        v_values(mdp, np.ones((2, 2)) / 2, horizon=0)
