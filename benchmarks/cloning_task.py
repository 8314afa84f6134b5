"""What is cloned in the `cloning` group: a smooth expert of HalfCheetah's sizes. No library but NumPy is needed here."""

from typing import Any

TRANSITIONS, EPISODE, OBSERVATION, ACTION = 100_000, 1_000, 17, 6
EPOCHS, WIDTH, LEARNING_RATE = 10, 256, 1e-3


def demonstrations(np: Any) -> tuple[Any, Any]:
    """Observations and the expert's actions, with a little noise on them."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(TRANSITIONS, OBSERVATION)).astype(np.float32)
    actions = np.tanh(observations @ rng.normal(size=(OBSERVATION, ACTION)) * 0.3)
    return observations, np.clip(actions + 0.1 * rng.normal(size=actions.shape), -1, 1).astype(np.float32)
