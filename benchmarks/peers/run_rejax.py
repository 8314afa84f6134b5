"""One run of rejax; prints one JSON line.

rejax learns after every step of all its environments, so that "a batch every 4 steps" is 4 environments to it (`dqn4`); with one
environment (`dqn`) it learns from a batch in every step.
"""

import argparse
import json
import time

import jax
import jax.numpy as jnp
from rejax import DQN, PPO

COMMON = {"env": "CartPole-v1", "skip_initial_evaluation": True}


def make_algorithm(task: str, steps: int):
    """The algorithm with the settings of the others."""
    budget = {"total_timesteps": steps, "eval_freq": steps}
    if task == "ppo":
        return PPO.create(
            num_envs=8, num_steps=128, num_epochs=4, num_minibatches=4, learning_rate=3e-4, max_grad_norm=0.5, ent_coef=0.0,
            agent_kwargs={"activation": "tanh", "hidden_layer_sizes": (64, 64)}, **budget, **COMMON,
        )  # fmt: skip
    return DQN.create(
        num_envs=4 if task == "dqn4" else 1, batch_size=64, buffer_size=100_000, fill_buffer=1000, learning_rate=1e-3,
        max_grad_norm=10.0, ddqn=False, target_update_freq=1000, polyak=0.0, exploration_fraction=0.2,
        agent_kwargs={"activation": "relu"}, **budget, **COMMON,
    )  # fmt: skip


def main() -> None:
    """Compile, train, measure, evaluate."""
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=["ppo", "dqn", "dqn4"])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    algorithm = make_algorithm(given.task, given.steps)
    evaluate = algorithm.eval_callback
    # Its own evaluations inside the training program would count against its speed.
    quick = algorithm.replace(eval_callback=lambda algorithm, state, key: jnp.zeros(()))
    key = jax.random.key(given.seed)
    train = jax.jit(lambda algorithm, key: algorithm.train(key)[0]).lower(quick, key).compile()
    started = time.perf_counter()
    state = jax.block_until_ready(train(quick, key))
    seconds = time.perf_counter() - started
    _, returns = evaluate(algorithm, state, jax.random.key(given.seed + 1))
    print(json.dumps({"rate": int(state.global_step) / seconds, "return": float(returns.mean())}))


if __name__ == "__main__":
    main()
