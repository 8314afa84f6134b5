"""Requests that cannot be met, from Python: a `ValueError` of one sentence before anything is compiled or written."""

from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from faulty import Leaner, files_under

import rewardtogo as rtg
from rewardtogo.ops.schedules import Exponential, Linear

CASES: dict[str, tuple[Callable[[], Any], str]] = {
    "an unknown algorithm": (lambda: rtg.train("ppoo", "CartPole-v1"), "'ppoo' ppo"),
    "an unknown option": (lambda: rtg.train("ppo", "CartPole-v1", learner={"gama": 0.9}), "'gama' gamma"),
    "an unknown sink": (lambda: rtg.train("ppo", "CartPole-v1", sinks=["tensorbord"]), "'tensorbord' tensorboard"),
    "an unknown backend": (lambda: rtg.train("ppo", "CartPole-v1", preset="nice"), "'nice' none"),
    "no steps": (lambda: rtg.train("ppo", "CartPole-v1", steps=0), "steps 0"),
    "no seeds": (lambda: rtg.train("ppo", "CartPole-v1", num_seeds=0), "seeds 0"),
    "a seed that is too large": (lambda: rtg.train("ppo", "CartPole-v1", seed=2**32), "2^32"),
    "no environments": (lambda: rtg.train("ppo", "CartPole-v1", num_envs=0), "environment 0"),
    "a learner against a space": (lambda: rtg.train(rtg.DQN(), "Pendulum-v1"), "DQN discrete box"),
    "options for a whole algorithm": (
        lambda: rtg.train(rtg.OnPolicy(rtg.make("CartPole-v1"), rtg.PPO()), learner={"gamma": 0.5}),
        "put together",
    ),
    "copies of a vector environment": (
        lambda: rtg.train("ppo", rtg.make("CartPole-v1", num_envs=4), num_envs=2),
        "4 copies 2",
    ),
    "copies of an environment": (
        lambda: rtg.train("ppo", gymnasium.make("CartPole-v1"), num_envs=2),
        "copied function",
    ),
    "gamma above 1": (lambda: rtg.PPO(gamma=1.5), "PPO.gamma [0, 1] 1.5"),
    "gamma NaN": (lambda: rtg.PPO(gamma=float("nan")), "PPO.gamma nan"),
    "gamma infinite": (lambda: rtg.PPO(gamma=float("inf")), "PPO.gamma inf"),
    "gamma an array with a bad entry": (lambda: rtg.PPO(gamma=jnp.asarray([0.9, 1.9])), "PPO.gamma 1.9"),
    "gamma a schedule that leaves": (lambda: rtg.PPO(gamma=Linear(0.9, 1.1)), "PPO.gamma 1.1"),
    "a rate of 0": (lambda: rtg.DQN(learning_rate=0.0), "DQN.learning_rate (0, inf) 0"),
    "epochs of 0": (lambda: rtg.PPO(epochs=0), "PPO.epochs [1, inf) 0"),
    "epochs beyond counting": (lambda: rtg.PPO(epochs=2**31), "PPO.epochs 2^31"),
    "epochs beyond floats": (lambda: rtg.PPO(epochs=10**400), "PPO.epochs 2^31"),
    "a schedule through 0": (lambda: Exponential(1.0, 0.0), "Exponential positive Linear"),
    "layers of 0": (lambda: rtg.MLP(64, 0), "MLP at least 1 0"),
    "an activation": (lambda: rtg.MLP(64, activation="sigmod"), "'sigmod' tanh"),
    "convolutions that do not match": (lambda: rtg.CNN(channels=(8, 8), kernels=(3,), strides=(1,)), "CNN 2, 1 1"),
    "a learner in the wrong loop": (lambda: rtg.OnPolicy(rtg.make("CartPole-v1"), rtg.DQN()), "DQN OffPolicy"),
    "the other way round": (lambda: rtg.OffPolicy(rtg.make("CartPole-v1"), rtg.PPO()), "PPO OnPolicy"),
    "a replay of nothing": (lambda: rtg.UniformReplay(capacity=0), "capacity 0"),
    "a replay that is too small": (
        lambda: rtg.OffPolicy(rtg.make("CartPole-v1", 8), rtg.DQN(), rtg.UniformReplay(16), unroll=4),
        "replay 16 at least 32",
    ),
    "no iterations": (
        lambda: rtg.run(rtg.OnPolicy(rtg.make("CartPole-v1"), Leaner()), jax.random.key(0), iterations=0),
        "at least one iteration 0",
    ),
    "nothing to load": (lambda: rtg.load("nowhere"), "nowhere"),
    "nothing to resume": (lambda: rtg.resume("nowhere"), "nowhere"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_bad_request_is_a_value_error_of_one_sentence(workplace, name):
    call, fragments = CASES[name]
    with pytest.raises(ValueError) as caught:
        call()
    sentence = str(caught.value)
    missing = [fragment for fragment in fragments.split() if fragment not in sentence]
    assert not missing, f"{missing} not in: {sentence}"
    assert "\n" not in sentence and not files_under(workplace)


OBSERVATIONS = {
    "of another environment": (np.zeros(3, np.float32), "(3,) (4,) another environment"),
    "a batch of another environment": (np.zeros((7, 3), np.float32), "(7, 3) (4,) another environment"),
    "with two batch axes": (np.zeros((2, 2, 4), np.float32), "(2, 2, 4) (4,)"),
    "a number": (0.5, "() (4,)"),
    "nothing": (None, "numbers"),
    "of words": (["left", "right", "up", "down"], "numbers"),
    "with NaN": (np.asarray([0, np.nan, 0, 0], np.float32), "NaN"),
    "with infinity": (np.asarray([0, np.inf, 0, 0], np.float32), "infinity"),
    "complex": (np.zeros(4, complex), "complex128"),
}


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_a_policy_refuses_what_it_cannot_see(small_leaner, name):
    observation, fragments = OBSERVATIONS[name]
    policy = rtg.load(small_leaner, Leaner())
    for ask in (policy, policy.inspect):
        with pytest.raises(ValueError) as caught:
            ask(observation)
        assert not [fragment for fragment in fragments.split() if fragment not in str(caught.value)], caught.value


def test_a_run_of_a_foreign_learner_needs_the_learner(small_leaner):
    with pytest.raises(ValueError, match="not part of rewardtogo"):
        rtg.load(small_leaner)
    with pytest.raises(ValueError, match="not part of rewardtogo"):
        rtg.resume(small_leaner, steps=64)
