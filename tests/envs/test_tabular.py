import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import env_spec
from rewardtogo.envs.reward_wrappers import RewardFunction
from rewardtogo.envs.tabular import MDP, POMDP, TabularEnv, TabularModel
from rewardtogo.envs.tabular_problems import MOVES, PACMAN_BOARD, aliased_corridor, pacman, random_mdp, random_policy
from rewardtogo.envs.tabular_rewards import TableReward
from rewardtogo.exact import (
    TablePolicy,
    best_deterministic_policy,
    expected_return,
    memoryless_policy,
    optimal_q_values,
    q_values,
    simulate,
    v_values,
)

P = np.array([[[0.5, 0.5], [0.2, 0.8]], [[1.0, 0.0], [0.3, 0.7]]])
R = np.array([[1.0, 0.0], [0.0, 2.0]])


def changed(place, value):
    table = P.copy()
    table[place] = value
    return table


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (dict(transitions=changed((0, 0, 0), 0.5 + 2e-12)), "sums to"),
        (dict(transitions=changed((0, 1), (-0.2, 1.2))), "at least 0"),
        (dict(transitions=changed((1, 0, 0), np.nan)), "at least 0"),
        (dict(discount=1.0), "no terminal state can be reached from state 0"),
        (dict(discount=1.5), "in [0, 1]"),
        (dict(discount=-0.1), "in [0, 1]"),
        (dict(horizon=0), "at least 1"),
        (dict(transitions=P[0]), "[S, A, S]"),
        (dict(rewards=R[0]), "rewards has shape"),
        (dict(rewards=R + np.inf), "not finite"),
        (dict(initial=2), "from 0 to 1"),
        (dict(initial=[0.5, 0.6]), "sums to"),
        (dict(initial=[1.0]), "one probability for each state"),
        (dict(terminal=[True]), "one flag for each state"),
        (dict(terminal=[True, False]), "terminal state 0"),
    ],
)
def test_what_is_no_mdp_is_refused(item, arguments, sentence):
    given = dict(transitions=P, rewards=R, initial=0, discount=0.9) | arguments
    with item("1.1") as check:
        with np.errstate(invalid="ignore"), pytest.raises(ValueError) as caught:
            MDP(**given)
        check(sentence in str(caught.value), "==", True, f"refused with '{sentence}'")


def test_mdp_keeps_what_it_was_given(item):
    with item("1.1") as check:
        mdp = MDP(P, R, 0, 0.9)
        check(np.abs(mdp.transitions - P).max(), "==", 0)
        check(np.abs(mdp.transitions.sum(-1) - 1).max(), "<=", 1e-12, "row sums")
        check(MDP(P.astype(np.float32), R, 0, 0.9).transitions.dtype == np.float32, "==", True, "precision kept")
        ended = MDP(P, R, 0, 1.0, terminal=[False, True])
        check(
            np.abs(np.asarray(ended.transitions)[1] - [0, 1]).max() + np.abs(ended.rewards[1]).max(),
            "==",
            0,
            "absorbing",
        )
        check(MDP(P, R, 0, 1.0, horizon=3).horizon, "==", 3, "discount 1 with a horizon")


def test_emissions_are_checked():
    with pytest.raises(ValueError, match="sums to"):
        POMDP(MDP(P, R, 0, 0.9), [[0.5, 0.4], [1.0, 0.0]])
    with pytest.raises(ValueError, match="for each state a distribution"):
        POMDP(MDP(P, R, 0, 0.9), np.ones((3, 1)))


def frequencies(mdp, steps=1000, num_envs=100):
    """Counts of (s, a, s') in `steps` x `num_envs` steps of the compiled environment under uniform actions."""

    def episode(env, key):
        def step(state, keys):
            action = jax.random.randint(keys[0], (), 0, mdp.num_actions)
            following, timestep = env.step(state, action, keys[1])
            fresh, _ = env.reset(keys[2])
            after = jax.tree.map(lambda x, y: jnp.where(timestep.done, x, y), fresh, following)
            flags = (timestep.terminated, timestep.truncated, jnp.asarray(mdp.terminal)[following.state])
            return after, (state.state, action, following.state, timestep.final_observation, timestep.reward, *flags)

        first, rest = jax.random.split(key)
        return jax.lax.scan(step, env.reset(first)[0], jax.random.split(rest, (steps, 3)))[1]

    keys = jax.random.split(jax.random.key(1), num_envs)
    return [np.asarray(x).ravel() for x in jax.jit(jax.vmap(episode, (None, 0)))(TabularEnv(mdp), keys)]


def test_the_environment_has_the_transitions_of_its_mdp(item):
    mdp = random_mdp(3, 5, 3, num_terminal=1)
    s, a, after, seen, reward, terminated, truncated, ends = frequencies(mdp)
    counts = np.zeros((5, 3, 5))
    np.add.at(counts, (s, a, after), 1)
    visits = counts.sum(-1, keepdims=True)
    live = visits[..., 0] > 0
    expected = np.asarray(mdp.transitions)
    errors = np.sqrt(expected * (1 - expected) / np.maximum(visits, 1))
    with item("1.3") as check:
        check(len(s), "==", 1e5, "steps")
        z = (np.abs(counts / np.maximum(visits, 1) - expected) / np.maximum(errors, 1e-12))[live]
        check(z.max(), "<=", 4, "standard errors from P")
        check(live.sum(), "==", 12, "pairs visited")
        check((terminated != ends).sum() + truncated.sum(), "==", 0, "E1.5: terminated where terminal, never truncated")
        check((seen != after).sum(), "==", 0, "final observation is where the step led")
        check(np.abs(reward - np.asarray(mdp.rewards, np.float32)[s, a]).max(), "==", 0, "rewards")


def test_a_horizon_terminates_and_an_endless_loop_does_not(item):
    loop = np.ones((1, 1, 1))
    policy, key = TablePolicy(jnp.ones((1, 1))), jax.random.key(0)
    with item("1.3") as check:
        finite = simulate(TabularEnv(MDP(loop, [[1.0]], horizon=10)), policy, key, 1, 15)
        check(finite.terminated[0] & ~finite.truncated[0], "==", True, "E1.2: a horizon is a true end")
        check(finite.rewards.sum(), "==", 10)
        endless = simulate(TabularEnv(MDP(loop, [[1.0]], discount=0.99)), policy, key, 1, 15)
        check(~endless.terminated[0] & endless.truncated[0], "==", True, "E1.5: cut, not ended")
        one_step = MDP([[[0.0, 1.0]], [[0.0, 1.0]]], [[1.0], [5.0]], terminal=[False, True])
        single = simulate(
            TabularEnv(one_step), policy=TablePolicy(jnp.ones((2, 1))), key=key, num_episodes=1, horizon=5
        )
        check(
            single.terminated[0] & (single.lengths[0] == 1) & (single.rewards.sum() == 1), "==", True, "1-step episode"
        )


def test_spaces():
    spec = env_spec(TabularEnv(random_mdp(0, 4, 3)))
    assert spec.observation.counts == (4,) and spec.action.counts == (3,)
    assert env_spec(TabularEnv(POMDP(random_mdp(0, 4, 3), np.full((4, 2), 0.5)))).observation.counts == (2,)


def test_identity_emissions_change_nothing(item):
    mdp = random_mdp(5, 4, 2, num_terminal=1)
    policy = TablePolicy(jnp.asarray(random_policy(6, 4, 2), jnp.float32))
    seen, hidden = (
        simulate(TabularEnv(problem), policy, jax.random.key(2), 200, 12) for problem in (mdp, POMDP(mdp, np.eye(4)))
    )
    with item("1.2") as check:
        differences = jax.tree.map(lambda x, y: (x != y).sum(), seen, hidden)
        check(sum(jax.tree.leaves(differences)), "==", 0, "bits that differ with O = identity")


def test_emissions_have_their_distribution(item):
    pomdp = POMDP(random_mdp(7, 3, 2), np.random.default_rng(0).dirichlet(np.ones(4), 3))

    def two(env, key):
        keys = jax.random.split(key)
        state, first = env.reset(keys[0])
        after, timestep = env.step(state, jnp.ones((), jnp.int32), keys[1])
        return jnp.stack([state.state, after.state]), jnp.stack([first, timestep.observation])

    keys = jax.random.split(jax.random.key(3), 20_000)
    states, seen = jax.jit(jax.vmap(two, (None, 0)))(TabularEnv(pomdp), keys)
    with item("1.2") as check:
        for time, name in enumerate(("reset", "step")):
            counts = np.zeros((3, 4))
            np.add.at(counts, (np.asarray(states[:, time]), np.asarray(seen[:, time])), 1)
            visits = counts.sum(1, keepdims=True)
            errors = np.sqrt(pomdp.emissions * (1 - pomdp.emissions) / visits)
            check(
                (np.abs(counts / visits - pomdp.emissions) / errors).max(), "<=", 4, f"standard errors from O, {name}"
            )


def test_the_model_is_a_distribution(item):
    with item("1.7") as check, jax.enable_x64(True):
        mdp = random_mdp(8, 5, 3, num_terminal=1)
        model = TabularModel(mdp)
        index = jnp.arange(5)
        log_probs = jnp.stack(
            [jnp.stack([jax.vmap(lambda x, s=s, a=a: model.log_prob(jnp.asarray(s), jnp.asarray(a), x))(index)
                        for a in range(3)]) for s in range(5)]
        )  # fmt: skip
        check(np.abs(np.exp(log_probs).sum(-1) - 1).max(), "<=", 1e-12, "tabular p(s'|s,a) sums to 1")
        check(bool(model.terminal(jnp.asarray(4))) and not bool(model.terminal(jnp.asarray(0))), "==", True)
    keys = jax.random.split(jax.random.key(0), 20_000)
    model = TabularModel(mdp)
    sampled = jax.jit(jax.vmap(lambda k: model.transition(model.encode(jnp.asarray(1)), jnp.asarray(2), k)))(keys)
    expected = np.asarray(mdp.transitions)[1, 2]
    found = np.bincount(np.asarray(sampled), minlength=5) / len(keys)
    with item("1.7") as check:
        z = np.abs(found - expected) / np.sqrt(expected * (1 - expected) / len(keys))
        check(z.max(), "<=", 4, "standard errors of samples")


def test_outcome_rewards_reduce_to_their_mean(item):
    worst = 0.0
    for seed in range(50):
        base = random_mdp(seed, 4, 3, num_terminal=seed % 2)
        outcome = np.random.default_rng(seed).normal(size=(4, 3, 4)) * ~np.asarray(base.terminal)[:, None, None]
        mdp = MDP(base.transitions, outcome, base.initial, 0.9, base.terminal)
        policy = random_policy(seed + 1, 4, 3)
        value, reduced = np.zeros(4), MDP(base.transitions, mdp.rewards, base.initial, 0.9, base.terminal)
        for _ in range(400):  # the definition, with r(s, a, s') in place
            future = outcome + 0.9 * value * ~np.asarray(base.terminal)
            value = np.einsum("sa,sax,sax->s", policy, mdp.transitions, future)
        worst = max(worst, np.abs(value - v_values(mdp, policy)).max(), np.abs(value - v_values(reduced, policy)).max())
    with item("1.9") as check:
        check(worst, "<=", 1e-12, "V with r(s,a,s') against V with r(s,a)")


def test_the_environment_gives_the_outcome_reward():
    mdp = MDP(P, np.arange(8.0).reshape(2, 2, 2), 0, 0.9)
    batch = simulate(TabularEnv(mdp), TablePolicy(jnp.full((2, 2), 0.5)), jax.random.key(0), 20, 5)
    states, actions = np.asarray(batch.observations), np.asarray(batch.actions)
    assert mdp.outcome_rewards is not None
    assert (np.asarray(batch.rewards) == mdp.outcome_rewards[states[:, :-1], actions, states[:, 1:]]).all()


def test_swapping_in_the_true_reward_changes_nothing(item, key):
    mdp = random_mdp(9, 4, 3, num_terminal=1)
    env, policy = TabularEnv(mdp), TablePolicy(jnp.asarray(random_policy(10, 4, 3), jnp.float32))
    plain = simulate(env, policy, key, 100, 20)
    swapped = simulate(RewardFunction(env, TableReward(jnp.asarray(mdp.rewards, jnp.float32))), policy, key, 100, 20)
    other = simulate(RewardFunction(env, TableReward(jnp.ones((4, 3)))), policy, key, 100, 20)
    with item("1.10") as check:
        check(np.abs(plain.returns(0.9) - swapped.returns(0.9)).max(), "==", 0, "returns under the true reward")
        check(np.abs(other.rewards.sum(1) - other.lengths).max(), "==", 0, "a reward of 1 counts the steps")
        check((plain.observations != other.observations).sum(), "==", 0, "the episodes stay")


def brute_force(board, discount):
    """The best discounted return, by trying every sequence of moves; a branch that cannot win any more is cut."""
    width, start = len(board[0]), next((r, row.index("P")) for r, row in enumerate(board) if "P" in row)
    dots = frozenset((r, c) for r, row in enumerate(board) for c in range(width) if row[c] == ".")
    best = 0.0

    def search(place, left, gained, weight):
        nonlocal best
        best = max(best, gained)
        if not left or gained + weight * len(left) <= best:
            return
        for dy, dx in MOVES:
            y, x = place[0] + dy, place[1] + dx
            if not (0 <= y < len(board) and 0 <= x < width) or board[y][x] == "#":
                continue
            if board[y][x] == "G":
                best = max(best, gained - 100 * weight)
                continue
            search((y, x), left - {(y, x)}, gained + weight * ((y, x) in left), weight * discount)

    search(start, dots, 0.0, 1.0)
    return best


def test_pacman_value_is_that_of_brute_force(item):
    with item("1.11") as check:
        for discount in (0.5, 0.7):
            mdp = pacman(discount=discount)
            iterated = optimal_q_values(mdp, horizon=200)[0].max(-1)
            check(
                abs(mdp.initial @ iterated - brute_force(PACMAN_BOARD, discount)), "<=", 1e-12, "value iteration, 5x5"
            )
            check(np.abs(iterated - optimal_q_values(mdp).max(-1)).max(), "<=", 1e-12, "against policy iteration")
        check(
            set(np.unique(np.asarray(pacman().outcome_rewards))) == {-100.0, 0.0, 1.0}, "==", True, "+1 dot, -100 ghost"
        )
        safe, slippery = (q_values(m, np.full((m.num_states, 4), 0.25)) for m in (pacman(), pacman(slip=1.0)))
        check(np.abs(slippery.mean(1) - safe.mean(1)).max(), "<=", 1e-9, "slip 1 is the uniform policy")


def test_a_board_must_make_sense():
    for board in (("P.", "."), ("P ",), ("..",), ("P.x",)):
        with pytest.raises(ValueError, match="board"):
            pacman(board)


def test_the_aliased_corridor_hides_its_state(item):
    pomdp = aliased_corridor(discount=0.9)
    batch = simulate(TabularEnv(pomdp), TablePolicy(jnp.full((1, 2), 0.5)), jax.random.key(0), 50, 30)
    with item("1.6") as check:
        check(np.abs(batch.observations).max(), "==", 0, "all that is ever observed")
        check(set(batch.extras) == {"log_prob"}, "==", True, "nothing leaks through extras")
        _, memoryless = best_deterministic_policy(pomdp)
        check(abs(memoryless + 10), "<=", 1e-12, "best deterministic memoryless return is -1/(1-γ)")
        _, full = best_deterministic_policy(pomdp.mdp)
        check(abs(full + 1 + 0.9 + 0.81), "<=", 1e-12, "with the state in view")


def test_the_corridor_wants_a_stochastic_policy(item):
    pomdp = aliased_corridor()
    right = np.linspace(0.3, 0.9, 601)
    returns = [expected_return(pomdp.mdp, memoryless_policy(pomdp, np.array([[1 - p, p]]))) for p in right]
    with item("1.6") as check:
        check(np.abs(np.array(returns) + 2 * (2 - right) / (right * (1 - right))).max(), "<=", 1e-9, "closed form")
        check(abs(right[np.argmax(returns)] - (2 - np.sqrt(2))), "<=", 1e-3, "best probability of right")
        check(abs(max(returns) + 6 + 4 * np.sqrt(2)), "<=", 1e-4, "best memoryless return")
        check(best_deterministic_policy(pomdp)[1], "==", -np.inf, "every deterministic memoryless policy loops")
