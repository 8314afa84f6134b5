"""Hyperparameters that are known to work, by algorithm and environment. Strings and numbers only; the sources stand beside them.

A preset is chosen by itself (`--preset none` leaves the defaults); whatever the user gives wins over it.
"""

from typing import Any

Preset = dict[str, Any]

PRESETS: dict[tuple[str, str], Preset] = {
    # Found here, starting from RL Zoo's settings (8 x 32, 20 epochs): longer rollouts make all seeds reach 500 within 100k steps.
    ("ppo", "CartPole-v1"): {
        "steps": 100_000,
        "num_envs": 8,
        "loop": {"unroll": 32},
        "learner": {
            "learning_rate": "linear:1e-3:0",
            "clip": "linear:0.2:0",
            "gamma": 0.98,
            "gae_lambda": 0.8,
            "epochs": 20,
            "minibatches": 1,
        },
    },
}
"""Keys are the algorithm's name and the environment's id."""


def preset(algorithm: str, env: str) -> Preset:
    """The preset of a pair, `{}` where there is none."""
    return PRESETS.get((algorithm, env), {})
