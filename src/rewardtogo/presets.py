"""Hyperparameters that are known to work, by algorithm and environment. Strings and numbers only; the sources stand beside them.

A preset is chosen by itself (`--preset none` leaves the defaults); whatever the user gives wins over it.
"""

from typing import Any

Preset = dict[str, Any]

_PPO = {"learning_rate": "linear:1e-3:0", "epochs": 10, "minibatches": 8, "max_grad_norm": 5.0}
_SMALL = {"class": "mlp", "sizes": [64, 64], "activation": "relu"}
_SMALL_LOOP = {"unroll": 1, "updates": 1, "batch_size": 128, "warm_up": 500, "replay": {"capacity": 20_000}}

_SAC_RATES = {"learning_rate": 1e-3, "actor_learning_rate": 1e-3, "temperature_learning_rate": 1e-3}
_THREE_MODELS = {"members": 3, "posterior": {"class": "bootstrap", "resample": True}}
_COURSE_LOOP = {"unroll": 1000, "updates": 1000, "warm_up": 5000, "replay": {"capacity": 20_000}}

# Eight-step targets carry the end of an episode back in time: with one step fewer than half of the seeds got there.
_DQN_CARTPOLE: Preset = {
    "steps": 50_000,
    "num_envs": 1,
    "loop": {"unroll": 4, "updates": 4, "batch_size": 128, "length": 8},
    "learner": {
        "learning_rate": "linear:1e-3:1e-4",
        "network": {"class": "mlp", "sizes": [64, 64], "activation": "tanh"},
        "epsilon": "linear:1:0.1:0.12",
        "n_step": 8,
        "target_period": 400,
        "double": True,
        "huber": 10.0,
        "max_grad_norm": 100.0,
    },
}
# What Tianshou publishes for MuJoCo: many short rollouts, observations and rewards normalised, a first deviation of exp(-1/2). With 16
# rollouts of 128 steps and a deviation of 1 the half-cheetah slid on its back at 1,700; with 4 of 512, advantages normalised, the hopper
# ended at 1,340.
_PPO_MUJOCO: Preset = {
    "steps": 1_000_000,
    "num_envs": 64,
    "env": {"normalise_reward": 0.99},
    "loop": {"unroll": 32},
    "learner": {
        "learning_rate": "linear:3e-4:0",
        "epochs": 10,
        "minibatches": 32,
        "value_cost": 0.25,
        "log_std": -0.5,
        "normalise_advantages": False,
        "normalise_observations": True,
    },
}
_CLONE: Preset = {
    "steps": 20_000,
    "learner": {
        "learning_rate": "linear:1e-3:0",
        "network": {"class": "mlp", "sizes": [256, 256]},
        "normalise_observations": True,
    },
}
# Twenty rounds of a thousand steps: as many gradient steps as for BC, and twice ten trajectories of labels.
_DAGGER: Preset = {**_CLONE, "num_envs": 4, "loop": {"unroll": 250, "updates": 1000, "batch_size": 256}}
_TANH_64 = {"class": "mlp", "sizes": [64], "activation": "tanh"}


def _dqn_cartpole(**learner: Any) -> Preset:
    """DQN's preset with some of the learner's values replaced."""
    return {**_DQN_CARTPOLE, "learner": {**_DQN_CARTPOLE["learner"], **learner}}


PRESETS: dict[tuple[str, str], Preset] = {
    # Every one was found here; scores over seeds are in docs/results.md.
    ("bc", "HalfCheetah-v5"): _CLONE,
    ("bc", "Hopper-v5"): _CLONE,
    ("dagger", "HalfCheetah-v5"): _DAGGER,
    ("dagger", "Hopper-v5"): _DAGGER,
    ("ppo", "CartPole-v1"): {"steps": 100_000, "num_envs": 8, "loop": {"unroll": 128}, "learner": _PPO},
    # The decoder after the memory matters: without it no seed in three reached 500 while sampling its actions.
    ("ppo", "CartPoleNoVel-v1"): {
        "steps": 300_000,
        "num_envs": 8,
        "loop": {"unroll": 128},
        "learner": {
            "learning_rate": "linear:1e-3:0",
            "epochs": 10,
            "minibatches": 8,
            "max_grad_norm": 1.0,
            "normalise_observations": True,
            "network": {"class": "gru", "size": 64},
        },
    },
    # Long sequences and many environments: with 4, pieces of 32 steps and a rate of 1e-3 the median was -283.
    ("ppo", "PendulumNoVel-v1"): {
        "steps": 500_000,
        "num_envs": 16,
        "loop": {"unroll": 200},
        "learner": {
            "learning_rate": "linear:5e-4:0",
            "gamma": 0.9,
            "epochs": 10,
            "minibatches": 16,
            "bptt": 50,
            "network": {"class": "gru", "size": 64},
        },
    },
    ("ppo", "Acrobot-v1"): {
        "steps": 500_000,
        "num_envs": 16,
        "loop": {"unroll": 128},
        "learner": {**_PPO, "normalise_observations": True},
    },
    # gamma 0.9 as in RL Zoo. With a constant step size seeds ended between -184 and -538, with longer gradients between -168 and -248.
    ("ppo", "Pendulum-v1"): {
        "steps": 100_000,
        "num_envs": 4,
        "loop": {"unroll": 256},
        "learner": {
            "learning_rate": "linear:1e-3:0",
            "gamma": 0.9,
            "epochs": 10,
            "minibatches": 16,
            "max_grad_norm": 0.5,
        },
    },
    # RL Zoo's, with 16 environments.
    ("ppo", "LunarLander-v3"): {
        "steps": 1_000_000,
        "num_envs": 16,
        "loop": {"unroll": 1024},
        "learner": {
            "learning_rate": 3e-4,
            "gamma": 0.999,
            "gae_lambda": 0.98,
            "epochs": 4,
            "minibatches": 256,
            "entropy_cost": 0.01,
        },
    },
    ("ppo", "HalfCheetah-v5"): _PPO_MUJOCO,
    ("ppo", "Hopper-v5"): _PPO_MUJOCO,
    ("ppo", "InvertedPendulum-v5"): {
        "steps": 100_000,
        "num_envs": 8,
        "loop": {"unroll": 128},
        "learner": {**_PPO, "normalise_observations": True},
    },
    # Eight-step targets carry the end of an episode back in time: with one step fewer than half of the seeds got there.
    ("dqn", "CartPole-v1"): _DQN_CARTPOLE,
    # RL Zoo's. Its four updates every four steps are what makes the difference: with two, and 64x64, the median was -88.
    ("dqn", "Acrobot-v1"): {
        "steps": 100_000,
        "num_envs": 1,
        "loop": {"unroll": 4, "updates": 4, "batch_size": 128, "replay": {"capacity": 50_000}},
        "learner": {
            "learning_rate": 6.3e-4,
            "network": {"class": "mlp", "sizes": [256, 256]},
            "epsilon": "linear:1:0.1:0.12",
            "target_period": 250,
        },
    },
    # RL Zoo's, double, with a learning rate that falls and a larger replay.
    ("dqn", "LunarLander-v3"): {
        "steps": 350_000,
        "num_envs": 1,
        "loop": {"unroll": 4, "updates": 4, "batch_size": 128, "replay": {"capacity": 100_000}},
        "learner": {
            "learning_rate": "linear:6.3e-4:1e-4",
            "network": {"class": "mlp", "sizes": [256, 256]},
            "epsilon": "linear:1:0.05:0.12",
            "target_period": 250,
            "double": True,
        },
    },
    # RL Zoo's sizes and rates, with eight-step targets, standardised observations, and a replay that forgets nothing. With one step and
    # 10,000 transitions, as in RL Zoo, seeds ended between -102 and -143.
    ("dqn", "MountainCar-v0"): {
        "steps": 120_000,
        "num_envs": 1,
        "loop": {
            "unroll": 16,
            "updates": 8,
            "batch_size": 128,
            "length": 8,
            "replay": {"capacity": 120_000},
        },
        "learner": {
            "learning_rate": 1e-3,
            "network": {"class": "mlp", "sizes": [256, 256]},
            "gamma": 0.98,
            "epsilon": "linear:1:0.07:0.2",
            "target_period": 300,
            "n_step": 8,
            "normalise_observations": True,
        },
    },
    # The same settings as DQN's, whose preset is double and moves its target by Algorithm 12 already.
    ("double_dqn", "CartPole-v1"): _DQN_CARTPOLE,
    ("dueling_dqn", "CartPole-v1"): _dqn_cartpole(network=_TANH_64, head_sizes=[64]),
    # Whole distributions cost more an update; C51 needs fewer of them. Quantiles with half as many reached 475 in three seeds of five.
    ("c51", "CartPole-v1"): {
        **_dqn_cartpole(outputs={"class": "c51", "least": 0.0, "most": 100.0}, target_period=200),
        "loop": {"unroll": 4, "updates": 2, "batch_size": 64, "length": 8},
    },
    ("qr_dqn", "CartPole-v1"): {
        **_dqn_cartpole(outputs={"class": "quantiles", "count": 32}, huber=1.0, learning_rate="linear:1e-3:5e-5"),
        "loop": {"unroll": 4, "updates": 4, "batch_size": 64, "length": 8},
    },
    ("target_q", "CartPole-v1"): _DQN_CARTPOLE,
    ("per_dqn", "CartPole-v1"): _DQN_CARTPOLE,
    # The settings that published code shares (batches of 32 every 4 steps, a target every 1000, Adam at 1e-4), with a replay that most
    # machines can hold: 0.8 GB. Two cores are too slow to train a game to its end, so that no score of ours stands behind it.
    ("dqn", "ALE/*"): {
        "steps": 2_500_000,
        "num_envs": 8,
        "loop": {
            "unroll": 4,
            "updates": 8,
            "batch_size": 32,
            "warm_up": 20_000,
            "replay": {"capacity": 100_000, "frames": 4},
        },
        "learner": {
            "learning_rate": 1e-4,
            "network": {"class": "cnn"},
            "epsilon": "linear:1:0.01:0.1",
            "target_period": 250,
            "double": True,
        },
    },
    ("dqn", "Catch"): {
        "steps": 40_000,
        "num_envs": 8,
        "loop": {"unroll": 4, "updates": 8, "batch_size": 32, "warm_up": 1000, "replay": {"capacity": 10_000}},
        "learner": {
            "learning_rate": "linear:1e-3:1e-4",
            "network": {"class": "cnn", "channels": [8, 8], "kernels": [3, 3], "strides": [1, 1], "sizes": [64]},
            "target_period": 100,
            "double": True,
        },
    },
    # Undiscounted returns are what counts here: on the lake it takes a discount near 1.
    ("q_learning", "FrozenLake-v1"): {
        "steps": 1_000_000,
        "learner": {
            "gamma": 0.999,
            "exploration": {"class": "epsilongreedy", "epsilon": "linear:1:0.1:0.5", "ties": "uniform"},
        },
    },
    ("q_learning", "CliffWalking-v1"): {"steps": 100_000},
    ("q_learning", "Taxi-v4"): {"steps": 500_000},
    # A small network and a batch of 128 do as well as 256x256 and 256 here, in an eighth of the time.
    ("ddpg", "Pendulum-v1"): {"steps": 20_000, "num_envs": 1, "loop": _SMALL_LOOP, "learner": {"network": _SMALL}},
    # Noise that keeps its direction gets the car out of the valley, as in RL Zoo; four cars, and an update for every eighth step.
    ("ddpg", "MountainCarContinuous-v0"): {
        "steps": 300_000,
        "num_envs": 4,
        "loop": {"unroll": 16, "updates": 8, "batch_size": 128, "warm_up": 1000, "replay": {"capacity": 300_000}},
        "learner": {"network": _SMALL, "noise": {"class": "ou", "sigma": 0.5}},
    },
    ("td3", "Pendulum-v1"): {"steps": 20_000, "num_envs": 1, "loop": _SMALL_LOOP, "learner": {"network": _SMALL}},
    ("sac", "Pendulum-v1"): {
        "steps": 20_000,
        "num_envs": 1,
        "loop": _SMALL_LOOP,
        "learner": {"network": _SMALL, **_SAC_RATES},
    },
    # With outputs in units of 1 reward, three seeds of five ended at a bound.
    ("naf", "Pendulum-v1"): {
        "steps": 20_000,
        "num_envs": 1,
        "loop": _SMALL_LOOP,
        "learner": {"network": _SMALL, "value_scale": 30.0},
    },
    # One critic and a short search: a search in every target is what costs here.
    ("cem_q", "Pendulum-v1"): {
        "steps": 20_000,
        "num_envs": 1,
        "loop": {**_SMALL_LOOP, "batch_size": 64},
        "learner": {
            "network": _SMALL,
            "critics": 1,
            "maximiser": {"class": "cem", "iterations": 2, "samples": 16, "elites": 3},
        },
    },
    # The usual settings for MuJoCo's tasks (the papers', RL Zoo's); the defaults of the learners are the rest of them.
    ("ddpg", "HalfCheetah-v5"): {"steps": 1_000_000, "num_envs": 1, "loop": {"warm_up": 10_000}},
    ("td3", "HalfCheetah-v5"): {"steps": 1_000_000, "num_envs": 1, "loop": {"warm_up": 10_000}},
    ("sac", "HalfCheetah-v5"): {"steps": 1_000_000, "num_envs": 1, "loop": {"warm_up": 10_000}},
    # RL Zoo's, rewards normalised: without that one seed of two stayed at 1,500.
    ("trpo", "Hopper-v5"): {
        "steps": 1_000_000,
        "num_envs": 2,
        "env": {"normalise_reward": 0.99},
        "loop": {"unroll": 1024},
        "learner": {
            "target_kl": 0.04,
            "cg_iterations": 25,
            "value_epochs": 20,
            "minibatches": 16,
            "normalise_observations": True,
        },
    },
    # Tianshou's step: 0.1 times the natural gradient. Steps of a fixed divergence of 0.1 stayed at 1,600.
    ("npg", "HalfCheetah-v5"): {
        "steps": 1_000_000,
        "num_envs": 16,
        "env": {"normalise_reward": 0.99},
        "loop": {"unroll": 64},
        "learner": {
            "step_by": "rate",
            "learning_rate": 0.1,
            "value_epochs": 20,
            "minibatches": 1,
            "log_std": -0.5,
            "normalise_observations": True,
        },
    },
    # The course's budgets: 5,000 random steps and 12 iterations of 1,000; with the arm its 15 iterations, of 1,000 steps in place of 5,000.
    ("mbrl_v15", "Obstacles"): {"steps": 17_000, "loop": _COURSE_LOOP, "learner": _THREE_MODELS | {"horizon": 10}},
    ("mbrl_v15", "Reacher"): {"steps": 20_000, "loop": _COURSE_LOOP, "learner": _THREE_MODELS | {"horizon": 10}},
    # A fall has to lie within a plan: with 15 or 25 steps the true dynamics keep the pole for 360 or 380 steps, with 50 for 470.
    ("mbrl_v15", "CartPole-v1"): {"steps": 5_000, "learner": {"horizon": 50}},
    # The rise of the pole has to lie within a plan: with 15 steps even the true dynamics leave it hanging.
    ("mbrl_v15", "CartPoleSwingUp"): {
        "steps": 4_000,
        "loop": {"unroll": 100, "updates": 200, "warm_up": 500},
        "learner": _THREE_MODELS | {"horizon": 25},
    },
    ("sac", "CartPoleSwingUp"): {
        "steps": 80_000,
        "num_envs": 1,
        "loop": {**_SMALL_LOOP, "replay": {"capacity": 80_000}},
        "learner": {"network": _SMALL, **_SAC_RATES},
    },
    # Three minutes on two cores.
    ("latent_mbrl", "PixelPendulum"): {"steps": 8_000},
    ("e2c", "PlanarNavigation"): {"steps": 6_000},
    ("solar", "PixelDoubleIntegrator"): {
        "steps": 10_560,
        "learner": {
            "network": {"class": "featurepoints", "channels": [16], "kernels": [3], "strides": [1]},
        },
    },
    ("planet", "PixelPendulumOneFrame"): {"steps": 4_000},
    ("planet", "PixelPendulum"): {"steps": 4_000},
    ("trpo", "CartPole-v1"): {"steps": 200_000, "num_envs": 8, "loop": {"unroll": 128}},
    ("trpo", "Pendulum-v1"): {
        "steps": 300_000,
        "num_envs": 4,
        "loop": {"unroll": 256},
        "learner": {"gamma": 0.9, "target_kl": 0.02, "value_epochs": 20},
    },
    ("npg", "CartPole-v1"): {"steps": 300_000, "num_envs": 8, "loop": {"unroll": 128}},
    ("npg", "Pendulum-v1"): {
        "steps": 200_000,
        "num_envs": 4,
        "loop": {"unroll": 256},
        "learner": {"gamma": 0.9, "kl_step": 0.02, "value_epochs": 20},
    },
    ("offpolicy_pg", "CartPole-v1"): {"steps": 200_000},
    # A hundred iterations of 40,000 steps, as in the course.
    ("vpg", "LunarLanderContinuous-v3"): {
        "steps": 4_000_000,
        "num_envs": 16,
        "loop": {"unroll": 2500},
        "learner": {"learning_rate": "linear:0.005:0", "value_learning_rate": 0.005, "value_updates": 40},
    },
    ("vpg", "CartPole-v1"): {"steps": 200_000, "num_envs": 8, "loop": {"unroll": 128}},
    ("batch_ac", "CartPole-v1"): {"steps": 300_000, "num_envs": 8, "loop": {"unroll": 128}},
    ("online_ac", "CartPole-v1"): {"steps": 300_000},
    ("a2c", "CartPole-v1"): {"steps": 300_000},
    ("async_ac", "CartPole-v1"): {"steps": 300_000},
    # A hundred iterations of 5,000 steps. At a constant rate 1000 came within ten, and went again: 631 to 1000 in the end.
    ("reinforce", "InvertedPendulum-v5"): {
        "steps": 500_000,
        "num_envs": 5,
        "loop": {"unroll": 1000},
        "learner": {
            "gamma": 0.95,
            "learning_rate": "linear:0.01:0",
            "log_std": -1.0,
            "normalise_observations": True,
        },
    },
    ("reinforce", "CartPole-v1"): {"steps": 300_000, "num_envs": 8, "loop": {"unroll": 128}},
}
"""Keys are the algorithm's name and the environment's id, or `NAMESPACE/*` for all of a namespace that have none of their own."""


def preset(algorithm: str, env: str) -> Preset:
    """The preset of a pair, `{}` where there is none."""
    return PRESETS.get((algorithm, env)) or PRESETS.get((algorithm, f"{env.split('/')[0]}/*"), {})
