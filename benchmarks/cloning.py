"""Behavioural cloning on a hundred thousand transitions, ten times over, by this library; prints one JSON line.

`peers/run_imitation.py` does the same with the package `imitation`: the same data, network, batches and number of gradient steps.
"""

import argparse
import json
import time

import cloning_task as task
import jax
import jax.numpy as jnp
import numpy as np

import rewardtogo as rtg
from rewardtogo.core import EnvSpec, Spec, Transition
from rewardtogo.data import Dataset


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--batch-size", type=int, default=256)
    given = parser.parse_args()
    observations, actions = task.demonstrations(np)
    spec = EnvSpec(Spec("box", (task.OBSERVATION,)), Spec("box", (task.ACTION,), low=(-1.0,), high=(1.0,)))
    N = task.TRANSITIONS
    end = np.arange(1, N + 1) % task.EPISODE == 0
    # A dataset's episodes hold together: what follows a step is what the next one sees.
    following = np.roll(observations, -1, 0)
    data = Dataset.of(
        Transition(observations, actions, jnp.zeros(N), jnp.zeros(N, bool), jnp.asarray(end), following, {}), spec
    )
    steps = task.EPOCHS * N // given.batch_size
    updates = 100
    learner = rtg.BC(network=rtg.MLP(task.WIDTH, task.WIDTH, activation="tanh"), learning_rate=task.LEARNING_RATE)
    algorithm = rtg.Offline(data, learner, batch_size=given.batch_size, updates=updates)
    began = time.perf_counter()
    state, metrics = rtg.run(algorithm, jax.random.key(0), steps // updates)
    jax.block_until_ready(state)
    print(
        json.dumps({"seconds": time.perf_counter() - began, "loss": float(jnp.asarray(metrics["bc_loss"]).ravel()[-1])})
    )


if __name__ == "__main__":
    main()
