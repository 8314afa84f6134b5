"""`normalise_reward` by name: in `make`, in a run, and in what the run can be asked afterwards."""

from pathlib import Path

import pytest

import rewardtogo as rtg
from rewardtogo.envs.reward_wrappers import NormalizeReward


def test_rewards_are_scaled_and_returns_are_not(tmp_path: Path) -> None:
    run = rtg.train(
        "reinforce",
        "Pendulum-v1",
        steps=1600,
        num_envs=2,
        loop={"unroll": 400},
        learner={"network": {"sizes": [4]}, "value_updates": 1},
        env_kwargs={"normalise_reward": 0.9},
        preset="none",
        out=tmp_path / "run",
        quiet=True,
    )
    assert run.metrics["return_mean"][-1] < -300  # two hundred rewards of Pendulum's own size
    assert run.evaluation is not None and run.evaluation["return_mean"] < -300
    for backend in ("jax", "gymnasium"):
        env = rtg.make("Pendulum-v1", 2, backend=backend, normalise_reward=0.9)
        assert isinstance(env, NormalizeReward) and env.gamma == 0.9
    longer = rtg.resume(run.path, steps=2400, quiet=True)
    assert longer.metrics["env_steps"][-1] == 2400


@pytest.mark.parametrize(("gamma", "what"), [(True, "not True"), (1.5, "in .0, 1., not 1.5")])
def test_a_discount_that_is_none_is_refused(gamma: object, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        rtg.make("CartPole-v1", 2, normalise_reward=gamma)  # type: ignore[arg-type]
