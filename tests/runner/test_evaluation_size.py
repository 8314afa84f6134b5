"""Evaluations are as large as suits where the environment lives: outside of the compiled program they must not outweigh the training."""

from typing import Any

import gymnasium
import pytest

from rewardtogo.runner.plan import EVAL_EPISODES, HOSTED_LEAST, HOSTED_SHARE, plan


def size(algorithm: str = "ppo", env: Any = "Acrobot-v1", backend: Any = "gymnasium", **options: Any) -> int:
    made = plan(algorithm, env, backend=backend, preset="none", **options)
    return made.config["eval_episodes"]


def test_a_foreign_environment_is_evaluated_by_the_budget() -> None:
    assert size(steps=1_000_000) == EVAL_EPISODES
    assert size(steps=500_000) == 10  # 10 evaluations x 2 policies x 10 episodes x 500 steps: a fifth of them
    assert size(steps=1_000) == HOSTED_LEAST


@pytest.mark.parametrize("steps", [40_000, 102_400, 500_000, 3_000_000])
def test_evaluations_on_the_way_play_a_fifth_of_the_steps_at_most(steps: int) -> None:
    config = plan("ppo", "Acrobot-v1", backend="gymnasium", preset="none", steps=steps).config
    evaluations = -(-config["iterations"] // config["eval_every"])
    assert 2 <= evaluations <= 11
    played = evaluations * 2 * config["eval_episodes"] * 500
    assert played <= 1.2 * HOSTED_SHARE * steps  # rounding to whole rows of metrics


def test_it_says_how_long_its_episodes_are() -> None:
    short = lambda: gymnasium.make("CartPole-v1", max_episode_steps=50)  # noqa: E731
    assert size(env=short, steps=200_000) == EVAL_EPISODES
    unlimited = lambda: gymnasium.make("CartPole-v1").unwrapped  # noqa: E731
    assert size(env=unlimited, steps=200_000) <= 4


@pytest.mark.parametrize("options", [{"backend": "jax"}, {"eval_episodes": 20}, {"algorithm": "dagger", "expert": str}])
def test_it_is_the_usual_number_where_acting_is_cheap_or_one_is_asked_for(options: dict[str, Any]) -> None:
    if options.get("expert") is str:
        options = {**options, "expert": lambda observation: 0}
    assert size(steps=1_000, **options) == EVAL_EPISODES
