"""A car that is steered by pictures (items 2.32 and 2.33): data from the middle of the lane, and three ways to get the way back into it."""

import dataclasses
from functools import partial

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imitating import run, spec_of, steps

from rewardtogo.core import env_spec
from rewardtogo.data.noise import EXPERT
from rewardtogo.envs.imitation_problems import Lane, side_view, steer_by_picture
from rewardtogo.envs.registry import make
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.imitation import BC, DAgger, as_expert, augmented
from rewardtogo.loops.offline import Offline
from rewardtogo.nn import CNN
from rewardtogo.runner.collect import Recorded, play
from rewardtogo.runner.evaluate import Evaluator

LEARNER = BC(network=CNN((8, 16), (4, 3), (2, 2), (32,)), learning_rate=2e-3)
CALM = vectorize(TimeLimit(Lane(0.0003, picture=True), 100), 4)
"""Where the expert's data comes from: hardly any wind, so that it never has to steer back."""
EXPERT_DRIVER = as_expert(steer_by_picture, env_spec(CALM))


@pytest.fixture(scope="module")
def survival():
    """Steps in the lane, of 1,000 at most, in each of 20 windy drives."""
    evaluate = Evaluator(make("Steering", 20), 20)
    return lambda policy: np.asarray(evaluate(policy, jax.random.key(1))[0])


def demonstrations(key, noise: float = 0.0):
    return play(CALM, Recorded(EXPERT_DRIVER, env_spec(CALM), noise), 8, key)


def cloned(data, key):
    algorithm = Offline(data, LEARNER, batch_size=128, updates=50)
    return algorithm.policy(run(algorithm, key, 20)[0])


def seen_from(offset: float, action: int, picture, label):
    """A side camera, and the steering that leads back from where it is."""
    del label
    return side_view(picture, offset), jnp.asarray(action, jnp.int32)


def test_data_of_the_middle_alone(survival, key, item):
    data = demonstrations(key)
    assert set(np.asarray(data.transitions.action)) == {1}
    drives = survival(cloned(data, key))
    with item("2.32") as check:
        check(survival(EXPERT_DRIVER).min(), "==", 1000, "steps that the expert drives, of 1,000")
        check(
            np.median(drives), "<", 200, "steps that BC survives, data from the middle of the lane only, median of 20"
        )


def test_dagger_keeps_the_lane(survival, key, item):
    algorithm = DAgger(make("Steering", 4), LEARNER, EXPERT_DRIVER, unroll=250, updates=200)
    state, metrics = run(algorithm, key, 5)
    with item("2.32") as check:
        check(survival(algorithm.policy(state)).min(), ">=", 1000, "steps that DAgger survives, least of 20 drives")
        check(metrics["labels"][-1], "==", 5000, "labels that it asked for")


def test_side_cameras(survival, key, item):
    data = augmented(demonstrations(key), partial(seen_from, -0.4, 2), partial(seen_from, 0.4, 0))
    with item("2.33") as check:
        check(
            survival(cloned(data, key)).min(), ">=", 1000, "steps that BC survives with two side cameras, least of 20"
        )


def test_noise_on_the_demonstrator(survival, key, item):
    data = demonstrations(key, noise=0.5)
    assert set(np.asarray(data.transitions.extras[EXPERT])) == {0, 1, 2}
    with item("2.33") as check:
        check(
            survival(cloned(data, key)).min(),
            ">=",
            1000,
            "steps that BC survives, from a demonstrator with noise (DART)",
        )


@pytest.mark.slow
def test_more_demonstrations_help_until_they_do_not(key, item):
    """Return against the number of demonstrations (item 2.31), in drives of at most 300 steps; five seeds, each with data of its own."""
    counts, gusty = (1, 2, 5, 10, 50), vectorize(TimeLimit(Lane(picture=True), 20), 10)
    evaluate = Evaluator(vectorize(TimeLimit(Lane(picture=True), 300), 20), 20)
    lengths = np.zeros((5, len(counts)))
    for seed in range(5):
        mine = jax.random.fold_in(key, seed)
        everything = play(gusty, Recorded(EXPERT_DRIVER, env_spec(gusty)), 50, mine)
        for j, n in enumerate(counts):
            # The first n episodes, so often that there are 50: the same batches on average, and one program for all n.
            rows = np.tile(np.arange(n * 20), 50 // n)
            data = dataclasses.replace(
                everything, transitions=jax.tree.map(lambda x, r=rows: x[r], everything.transitions)
            )
            lengths[seed, j] = np.mean(evaluate(cloned(data, mine), jax.random.fold_in(mine, 1))[0])
    median, error = np.median(lengths, 0), lengths.std(0, ddof=1) / np.sqrt(5)
    falls = np.array([median[j] - median[j + 1] - np.hypot(error[j], error[j + 1]) for j in range(4)])
    with item("2.31") as check:
        check(
            falls.max(),
            "<=",
            0,
            "fall of the median return from one number of demonstrations to the next, beyond a standard error",
        )
        check(median[0] / median[-1], "<", 0.8, "return of one demonstration, in that of 50")
        check(median[-2] / median[-1], ">=", 0.95, "return of 10, in that of 50: it saturates")


# --- the augmentation itself -------------------------------------------------------------------------------------------


def test_augmented_episodes_follow_the_others(key):
    spec = spec_of(spaces.Box(-10.0, 10.0, (1,)), spaces.Discrete(3))
    x = jnp.arange(6.0)[:, None]
    data = steps(x, jnp.asarray([0, 1, 2, 0, 1, 2]), spec, length=3)
    more = augmented(data, lambda o, a: (o + 1.0, a), lambda o, a: (-o, (a + 1) % 3))
    t = more.transitions
    assert more.num_episodes == 3 * data.num_episodes and np.array_equal(more.lengths, [3] * 6)
    assert np.array_equal(t.observation[:, 0], np.concatenate([x[:, 0], x[:, 0] + 1, -x[:, 0]]))
    assert np.array_equal(t.action, [0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 1, 2, 0, 1, 2, 0])
    assert np.array_equal(t.next_observation[6:12], data.transitions.next_observation + 1.0)
    noisy = steps(x, jnp.asarray([0, 1, 2, 0, 1, 2]), spec, length=3, extras={EXPERT: jnp.full(6, 2)})
    label = augmented(noisy, lambda o, a: (o, (a + 1) % 3)).transitions.extras[EXPERT]
    assert np.array_equal(label, [2] * 6 + [0] * 6)
    assert augmented(data).num_steps == 6
    with pytest.raises(ValueError, match="action"):
        augmented(data, lambda o, a: (o, a + 3))
