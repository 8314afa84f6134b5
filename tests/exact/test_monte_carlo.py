import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from rewardtogo.envs.tabular import TabularEnv
from rewardtogo.envs.tabular_problems import random_mdp, random_policy
from rewardtogo.exact import (
    TablePolicy,
    expected_return,
    join_episodes,
    monte_carlo_return,
    one_hot_policy,
    simulate,
    split_episodes,
)

MDP = random_mdp(21, 4, 3, num_terminal=1, horizon=6)
TABLE = random_policy(22, 4, 3)
ENV, POLICY = TabularEnv(MDP), TablePolicy(jnp.asarray(TABLE, jnp.float32))


def test_intervals_cover_the_exact_return(item):
    keys = jax.random.split(jax.random.key(5), 500)
    found = jax.vmap(lambda k: monte_carlo_return(ENV, POLICY, k, 200, 6, 0.9))(keys)
    error = np.abs(found.mean - expected_return(MDP, TABLE))
    coverage = (error <= 1.96 * np.asarray(found.standard_error)).mean()
    with item("1.16") as check:
        check(abs(100 * coverage - 95), "<=", 3, f"points from 95 % over 500 repetitions ({100 * coverage:.1f} %)")
        overall = found.mean.mean() - expected_return(MDP, TABLE)
        check(abs(overall) / (found.mean.std() / np.sqrt(500)), "<=", 3, "E1.3: standard errors of the grand mean")


def test_deterministic_tables_repeat_themselves(item):
    policy = TablePolicy(jnp.asarray(one_hot_policy(np.array([2, 0, 1, 1]), 3), jnp.float32))
    observations = jnp.tile(jnp.arange(4), 50)
    keys = jax.random.split(jax.random.key(0), 200)
    zero = jnp.zeros((), jnp.int32)
    batched = jax.vmap(lambda o, k: policy(zero, o, k)[1])(observations, keys)
    looped = jnp.stack([policy(zero, o, k)[1] for o, k in zip(observations[:20], keys[:20], strict=True)])
    with item("1.4") as check:
        check(
            (batched != jnp.tile(jnp.array([2, 0, 1, 1]), 50)).sum(), "==", 0, "same observation, same action (table)"
        )
        check((batched[:20] != looped).sum(), "==", 0, "batch = loop (table)")


def test_stochastic_tables_sample_their_row(item):
    policy, keys = TablePolicy(jnp.asarray(TABLE, jnp.float32)), jax.random.split(jax.random.key(1), 20_000)
    act = jax.jit(jax.vmap(lambda k, o: policy(jnp.zeros((), jnp.int32), o, k), (0, None)))
    with item("1.5") as check:
        for observation in range(4):
            _, actions, extras = act(keys, jnp.asarray(observation))
            counts = np.bincount(np.asarray(actions), minlength=3)
            p = scipy.stats.chisquare(counts, TABLE[observation] * len(keys)).pvalue
            check(p, ">", 0.001, "χ² p of sampled frequencies (table)")
            expected = np.log(TABLE[observation])[np.asarray(actions)]
            check(np.abs(extras["log_prob"] - expected).max(), "<=", 1e-5, "log_prob (table)")


def test_tables_may_vary_with_time():
    table = np.stack([one_hot_policy(np.full(4, a), 3) for a in (2, 0, 1)])
    batch = simulate(TabularEnv(random_mdp(0, 4, 3)), TablePolicy(jnp.asarray(table)), jax.random.key(0), 5, 5)
    assert (batch.actions == jnp.array([[2, 0, 1, 1, 1]])).all()
    assert POLICY.inspect(jnp.zeros((), jnp.int32), jnp.asarray(1))["probabilities"].shape == (3,)


def test_trajectories_have_one_more_observation(item):
    batch = simulate(ENV, POLICY, jax.random.key(2), 30, 4)
    lengths, observations = np.asarray(batch.lengths), np.asarray(batch.observations)
    with item("1.8") as check:
        shapes = (batch.observations.shape, batch.actions.shape, batch.rewards.shape, batch.extras["log_prob"].shape)
        check(shapes == ((30, 5), (30, 4), (30, 4), (30, 4)), "==", True, "T actions, T + 1 observations (E1.1)")
        check((batch.terminated == batch.truncated).sum(), "==", 0, "each ended one way (E1.5)")
        ends = np.asarray(MDP.terminal)[observations[np.arange(30), lengths]]
        check((ends != np.asarray(batch.terminated)).sum(), "==", 0, "final observation kept, terminal where it ended")
        stream = join_episodes(batch)
        cumulative = np.concatenate([[0], np.cumsum(np.asarray(stream.reward, np.float64))])
        stops = np.cumsum(lengths)
        sums = cumulative[stops] - cumulative[stops - lengths]
        check(np.abs(np.asarray(batch.returns()) - sums).max(), "<=", 1e-5, "return = Σ r")


def test_splitting_and_joining_are_inverse(item):
    batch = simulate(ENV, POLICY, jax.random.key(3), 30, 4)
    stream = join_episodes(batch)
    again = join_episodes(split_episodes(stream))
    unfinished = jax.tree.map(lambda x: x[: int(batch.lengths[:-1].sum()) + 1], stream)
    with item("1.8") as check:
        check(len(stream.reward) == batch.lengths.sum(), "==", True, "no padding in the stream")
        differences = jax.tree.map(lambda x, y: int((x != y).sum()) + (x.dtype != y.dtype), stream, again)
        check(sum(jax.tree.leaves(differences)), "==", 0, "join(split(x)) = x, bit for bit")
        parts = split_episodes(stream)
        check((parts.lengths != np.asarray(batch.lengths)).sum(), "==", 0, "the same episodes")
        check((parts.truncated != np.asarray(batch.truncated)).sum(), "==", 0, "truncation kept apart")
        round_trip = join_episodes(split_episodes(unfinished))
        differences = jax.tree.map(lambda x, y: int((x != y).sum()), unfinished, round_trip)
        check(sum(jax.tree.leaves(differences)), "==", 0, "with an unfinished last episode")
