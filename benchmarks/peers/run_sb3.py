"""One run of Stable-Baselines3, or of SBX, which has the same interface; prints one JSON line."""

import argparse
import json
import time


def activation(library: str, name: str):
    """The function in the library's own framework."""
    if library == "sbx":
        import jax

        return {"tanh": jax.numpy.tanh, "relu": jax.nn.relu}[name]
    import torch

    return {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[name]


def no_velocities(env):
    """CartPole that shows positions only."""
    import gymnasium
    import numpy as np

    space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    return gymnasium.wrappers.TransformObservation(env, lambda o: o[[0, 2]], space)


def decay(start: float):
    """A schedule that falls to 0."""
    return lambda left: start * left


def make_model(library: str, task: str, seed: int):
    """The model, and the steps of it that are not measured: compilation, warm-up of the replay."""
    from stable_baselines3.common.env_util import make_vec_env

    common = {"seed": seed, "device": "cpu"}
    envs = lambda number, env="CartPole-v1", **more: make_vec_env(env, number, seed=seed, **more)  # noqa: E731
    layers = {"net_arch": [64, 64], "activation_fn": activation(library, "relu" if task == "dqn" else "tanh")}
    if task == "a2c":
        from stable_baselines3 import A2C

        return A2C("MlpPolicy", envs(8), policy_kwargs=layers, **common), 2_000
    if task == "trpo":
        from sb3_contrib import TRPO

        model = TRPO("MlpPolicy", envs(8), n_steps=256, batch_size=128, policy_kwargs=layers, **common)
        return model, 2 * 2048
    if task == "recurrent":
        from sb3_contrib import RecurrentPPO

        model = RecurrentPPO(
            "MlpLstmPolicy", envs(8, wrapper_class=no_velocities), n_steps=128, n_epochs=4, batch_size=256,
            policy_kwargs={"lstm_hidden_size": 64, "net_arch": [64]}, **common,
        )  # fmt: skip
        return model, 2 * 1024
    if library == "sbx":
        from sbx import DQN, PPO
    else:
        from stable_baselines3 import DQN, PPO
    if task in ("sac", "td3"):
        from stable_baselines3 import SAC, TD3

        # TD3 has a delay of 2 by default.
        model = {"sac": SAC, "td3": TD3}[task](
            "MlpPolicy", envs(1, "Pendulum-v1"), buffer_size=100_000, batch_size=256, train_freq=1, gradient_steps=1,
            learning_starts=1000, policy_kwargs={"net_arch": [256, 256]}, **common,
        )  # fmt: skip
        return model, 1300
    if task == "ppo":
        model = PPO(
            "MlpPolicy", envs(8), n_steps=128, n_epochs=4, batch_size=256, learning_rate=3e-4, ent_coef=0.0,
            policy_kwargs=layers, **common,
        )  # fmt: skip
        return model, 2 * 1024
    if task == "zoo":
        model = PPO(
            "MlpPolicy", envs(8), n_steps=32, n_epochs=20, batch_size=256, gamma=0.98, gae_lambda=0.8, ent_coef=0.0,
            learning_rate=decay(0.001), clip_range=decay(0.2), policy_kwargs=layers, **common,
        )  # fmt: skip
        return model, 0
    if task == "cheetah":
        model = PPO(
            "MlpPolicy", envs(8, "HalfCheetah-v5"), n_steps=256, n_epochs=10, batch_size=64, learning_rate=3e-4,
            policy_kwargs=layers, **common,
        )  # fmt: skip
        return model, 0
    model = DQN(
        "MlpPolicy", envs(1), buffer_size=100_000, batch_size=64, train_freq=4, gradient_steps=1, learning_starts=1000,
        learning_rate=1e-3, target_update_interval=1000, exploration_fraction=0.2, exploration_final_eps=0.05,
        policy_kwargs=layers, **common,
    )  # fmt: skip
    return model, 1200


def choose_threads(model, steps: int) -> int:
    """PyTorch's number of threads, whichever of one and all is faster here: networks this small seldom gain from more."""
    import torch

    times = {}
    for number in (1, torch.get_num_threads()):
        torch.set_num_threads(number)
        started = time.perf_counter()
        model.learn(steps)
        times[number] = time.perf_counter() - started
    best = min(times, key=lambda number: times[number])
    torch.set_num_threads(best)
    return best


def main() -> None:
    """Train, measure, evaluate."""
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=["ppo", "dqn", "zoo", "a2c", "trpo", "recurrent", "cheetah", "sac", "td3"])
    parser.add_argument("--library", choices=["sb3", "sbx"], default="sb3")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--began", type=float, help="when the process was started, in seconds since the epoch")
    parser.add_argument("--save", help="where the model is saved")
    given = parser.parse_args()
    model, before = make_model(given.library, given.task, given.seed)
    threads = 1
    if before and given.library == "sb3":
        threads = choose_threads(model, before)
    elif before:
        model.learn(before)
    elif given.library == "sb3":
        import torch

        # There is no time to try within a whole process that is measured.
        torch.set_num_threads(threads)
    first, started = model.num_timesteps, time.perf_counter()
    model.learn(given.steps, reset_num_timesteps=not before)
    seconds = time.perf_counter() - started
    if given.save:
        model.save(given.save)
    # Evaluation comes after the clock of the whole process has stopped.
    whole = time.time() - given.began if given.began else None
    from stable_baselines3.common.evaluation import evaluate_policy

    mean, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=20, deterministic=True)
    rate = (model.num_timesteps - (first if before else 0)) / seconds
    print(json.dumps({"rate": rate, "return": float(mean), "process_seconds": whole, "threads": threads}))


if __name__ == "__main__":
    main()
