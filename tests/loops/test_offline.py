"""`Offline`: what it draws, how it counts, what it refuses."""

import math
from typing import Literal

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewardtogo.core import Batch, EnvSpec, Learner, Number, Transition, from_space, number, setting
from rewardtogo.data import Dataset
from rewardtogo.loops import RandomPolicy
from rewardtogo.loops.offline import Offline, sample_batch
from rewardtogo.nn import GRU, MLP
from rewardtogo.ops.schedules import Linear
from rewardtogo.policy_gradient.ppo import PPO
from rewardtogo.value.dqn import DQN

LENGTHS = (3, 1, 4)
SPEC = EnvSpec(from_space(spaces.Box(-100.0, 100.0, (1,))), from_space(spaces.Discrete(2)))


def counting(lengths=LENGTHS) -> Dataset:
    """Episode e visits 10 e, 10 e + 1, ...: every observation says where it is."""
    place = np.concatenate([10.0 * e + np.arange(n) for e, n in enumerate(lengths)])[:, None]
    last = np.concatenate([np.arange(n) == n - 1 for n in lengths])
    size = len(place)
    fields = (place, np.arange(size, dtype=np.int32) % 2, np.arange(size), last, np.zeros(size, bool), place + 1)
    arrays = [jnp.asarray(x, jnp.float32) if x.dtype.kind == "f" else jnp.asarray(x) for x in fields]
    arrays[2] = arrays[2].astype(jnp.float32)
    return Dataset.of(Transition(*arrays, {}), SPEC)


class Tally(Learner):
    """Counts how often it was shown each step, and keeps the last batch."""

    wants: str = setting("transitions", "kind of batch", choices=("rollout", "transitions", "sequences"))
    rate: Number = number(Linear(1.0, 0.0), "a schedule, to see its horizon")

    @property
    def batch(self) -> Literal["rollout", "transitions", "sequences"]:
        return self.wants

    @property
    def action_kinds(self) -> tuple[str, ...]:
        return ("discrete",)

    def init(self, spec, key):
        del spec, key
        return jnp.zeros(sum(LENGTHS)), jnp.zeros((), jnp.int32)

    def policy(self, state, explore):
        del state, explore
        return RandomPolicy(SPEC)

    def update(self, state, batch: Batch, key):
        del key
        counts, updates = state
        seen = batch.transitions.reward.astype(jnp.int32)
        metrics = {"rate": self.at(updates).rate, "carry": jnp.asarray(len(jax.tree.leaves(batch.transitions.extras)))}
        return (counts.at[seen.ravel()].add(1.0), updates + 1), metrics, ()


@pytest.fixture(params=["transitions", "sequences"])
def algorithm(request) -> Offline:
    return Offline(counting(), Tally(wants=request.param), batch_size=7, updates=3, length=5).with_horizon(4)


def test_counts(algorithm, key):
    assert (algorithm.steps_per_iteration, algorithm.initial_steps, Offline.default_num_envs()) == (3, 0, 1)
    state, (metrics, episodes) = jax.jit(lambda a, k: a.step(a.init(k), k))(algorithm, key)
    assert float(episodes.count) == 0.0
    # 3 of 12 updates: the schedule's mean over them.
    assert float(metrics["rate"]) == pytest.approx(np.mean([1.0, 11 / 12, 10 / 12]), rel=1e-5)
    assert int(algorithm.learned(state)[1]) == 3


def test_draws_are_uniform(algorithm, key):
    step = jax.jit(lambda a, s, k: a.step(s, k)[0])
    state = algorithm.init(key)
    for k in jax.random.split(key, 100):
        state = step(algorithm, state, k)
    counts = np.asarray(state.learner[0])
    width = 5 if algorithm.learner.batch == "sequences" else 1
    share = counts / counts.sum()
    # Steps of a window come together, so that a window is one draw.
    error = np.sqrt((1 / 8) * (7 / 8) * width / counts.sum())
    assert np.abs(share - 1 / 8).max() < 4 * error


def drawn(algorithm, learner, key):
    a = algorithm
    return sample_batch(a.learner, learner, a.dataset.transitions, a.dataset.num_steps, a.batch_size, a.length, key)


def test_windows_are_consecutive_and_wrap(key):
    algorithm = Offline(counting(), Tally(wants="sequences"), batch_size=200, length=12).with_horizon(100)
    t = drawn(algorithm, algorithm.learner.init(SPEC, key), key).transitions
    place = np.asarray(t.reward, int)
    assert place.shape == (12, 200) and t.observation.shape == (12, 200, 1)
    assert np.array_equal(place[1:], (place[:-1] + 1) % 8)
    follows = np.asarray(t.observation[1:, :, 0] == t.next_observation[:-1, :, 0])
    assert np.array_equal(follows, ~np.asarray(t.done[:-1]))


def test_sequences_begin_with_a_fresh_memory(key):
    algorithm = Offline(counting(), DQN(network=GRU(4, MLP(3))), batch_size=6, length=5).with_horizon(100)
    state = algorithm.init(key)
    batch = drawn(algorithm, state.learner, key)
    carry = batch.transitions.extras["carry"]
    assert all(x.shape[:2] == (5, 6) and not np.any(x) for x in jax.tree.leaves(carry))
    new, (metrics, _) = jax.jit(lambda a, s, k: a.step(s, k))(algorithm, state, key)
    assert all(math.isfinite(float(v)) for v in metrics.values())
    assert jax.tree.structure(new) == jax.tree.structure(state)


def test_the_data_is_an_argument_of_the_program(key):
    algorithm = Offline(counting(), DQN(network=MLP(4)), batch_size=4, updates=2).with_horizon(100)
    state = algorithm.init(key)
    program = jax.make_jaxpr(lambda a, s, k: a.step(s, k))(algorithm, state, key)
    assert not [c for c in program.consts if np.size(c) >= algorithm.dataset.num_steps]


def test_seeds_share_the_data(key):
    algorithm = Offline(counting(), DQN(network=MLP(4)), batch_size=4, updates=2).with_horizon(100)
    keys = jax.random.split(key, 3)
    states = jax.vmap(lambda a, k: a.init(k), in_axes=(None, 0))(algorithm, keys)
    _, (metrics, _) = jax.jit(jax.vmap(lambda a, s, k: a.step(s, k), in_axes=(None, 0, 0)))(algorithm, states, keys)
    assert metrics["q_loss"].shape == (3,) and len(np.unique(metrics["q_loss"])) == 3


def test_every_leaf_of_the_state_is_an_array(key):
    state = Offline(counting(), DQN(network=MLP(4))).with_horizon(100).init(key)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(state))


def test_more_than_there_is_in_a_batch(key):
    algorithm = Offline(counting(), Tally(), batch_size=50).with_horizon(100)
    assert drawn(algorithm, None, key).transitions.reward.shape == (50,)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda d: Offline(d, PPO()), "PPO needs fresh rollouts of its own policy"),
        (lambda d: Offline(jax.tree.map(lambda x: x[:0], d), Tally()), "the dataset has no steps"),
        (lambda d: Offline(d, Tally(), batch_size=0), r"Offline.batch_size must be in \[1, inf\), not 0"),
    ],
)
def test_what_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make(counting())


def test_a_single_episode_of_one_step(key):
    dataset = counting((1,))
    learner = DQN(network=GRU(4, MLP(3)))
    algorithm = Offline(dataset, learner, batch_size=2, length=3).with_horizon(100)
    _, (metrics, _) = algorithm.step(algorithm.init(key), key)
    assert math.isfinite(float(metrics["q_loss"]))
    assert eqx.tree_equal(dataset.take([0]), dataset)
