"""Behavioural cloning by the package `imitation` on the data of `cloning_task.py`; prints one JSON line."""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
from imitation.algorithms import bc
from imitation.data.types import Transitions
from imitation.util import logger
from stable_baselines3.common.policies import ActorCriticPolicy

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cloning_task as task


def main():
    """Measure."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--batch-size", type=int, default=256)
    given = parser.parse_args()
    observations, actions = task.demonstrations(np)
    n = task.TRANSITIONS
    ends = np.arange(1, n + 1) % task.EPISODE == 0
    data = Transitions(observations, actions, np.array([{}] * n), np.roll(observations, -1, 0), ends)
    seen = gym.spaces.Box(-np.inf, np.inf, (task.OBSERVATION,), np.float32)
    done = gym.spaces.Box(-1.0, 1.0, (task.ACTION,), np.float32)
    policy = ActorCriticPolicy(seen, done, lambda _: task.LEARNING_RATE, net_arch=[task.WIDTH, task.WIDTH])
    with tempfile.TemporaryDirectory() as folder:
        learner = bc.BC(
            observation_space=seen,
            action_space=done,
            rng=np.random.default_rng(0),
            policy=policy,
            demonstrations=data,
            batch_size=given.batch_size,
            optimizer_kwargs={"lr": task.LEARNING_RATE},
            custom_logger=logger.configure(folder, []),
        )
        began = time.perf_counter()
        learner.train(n_epochs=task.EPOCHS, progress_bar=False)
    print(json.dumps({"seconds": time.perf_counter() - began}))


if __name__ == "__main__":
    main()
