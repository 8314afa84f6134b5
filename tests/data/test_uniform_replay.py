"""The uniform replay: what is kept, what is drawn, and what follows a step that was cut (notes 6.1, figure 6.1)."""

import jax
import jax.numpy as jnp
import numpy as np

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.envs.probes import CountingEnv
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.loops import RandomPolicy, begin

KEY = jax.random.key(0)
ENV = rtg.vectorize(TimeLimit(CountingEnv(7), 5), 2)


def test_ring_and_draws(item):
    replay, policy = rtg.UniformReplay(24), RandomPolicy(rtg.core.env_spec(ENV))

    def fill(key: jax.Array):
        def block(loop, key):
            actor, state = loop
            actor, rollout, _ = rtg.collect(ENV, policy, actor, key, 4)
            state = replay.add(state, rollout.transitions)
            return (actor, state), (rollout.transitions, state)

        actor = begin(ENV, policy, key)
        example = jax.eval_shape(lambda a, k: rtg.collect(ENV, policy, a, k, 4), actor, key)[1].transitions
        (_, state), seen = jax.lax.scan(block, (actor, replay.init(example, 4)), jax.random.split(key, 7))
        return state, seen, replay.sample(state, key, 24_000)

    state, (blocks, states), batch = jit(fill)(KEY)
    rows = jax.tree.map(lambda x: np.asarray(x).reshape(28, 2, *x.shape[3:]), blocks)
    with item("6.2") as check:
        check(max(int(filled) for filled in states.filled), "==", 12, "rows kept, of 28 written")
        wrong = 0
        for i in range(7):
            held = np.asarray(states.storage.observation)[i]
            last = rows.observation[max(0, 4 * i + 4 - 12) : 4 * i + 4]
            wrong += sorted(map(str, held[: len(last)])) != sorted(map(str, last))
        check(wrong, "==", 0, "moments at which it held anything but the newest")
        counts = np.bincount(np.asarray(batch.indices), minlength=24)
        statistic = ((counts - 1000) ** 2 / 1000).sum()
        check(statistic, "<", 49.7, "chi-square of 24000 draws over 24 steps, 0.999 quantile of 23 degrees")
        t = batch.transitions
        # A count goes up by one whatever ends: the reset comes after what is stored.
        check(
            np.abs(np.asarray(t.next_observation - t.observation) - 1).max(), "==", 0, "next observation, less one more"
        )
        check(int((t.truncated & ~t.terminated).sum()), ">", 1000, "truncated steps among them")
        check(int(t.terminated.sum()), "==", 0, "marked as ends of the episode")
    np.testing.assert_array_equal(
        jax.tree.leaves(t)[0], np.asarray(state.storage.observation)[batch.indices // 2, batch.indices % 2]
    )
    assert jnp.all(batch.weights == 1)
