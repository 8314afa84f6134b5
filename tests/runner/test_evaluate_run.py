"""`rtg eval`: exactly as many episodes as asked for, in the run's environment or another one of the same spaces."""

import gymnasium
import numpy as np
import pytest

from rewardtogo.envs.cartpole import CartPole
from rewardtogo.envs.registry import make
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.runner.config import as_builtin
from rewardtogo.runner.evaluate_run import evaluate_run

KEYS = {"episodes", "return_mean", "return_std", "return_ci95", "length_mean"}


def same(one, two):
    return all(np.allclose(one[name], two[name]) for name in KEYS)


def test_a_summary_of_exactly_as_many_episodes(trained):
    for episodes in (1, 7, 40):
        found = evaluate_run(trained / "ppo", episodes=episodes)
        assert set(found) == KEYS and found["episodes"] == episodes and found == as_builtin(found)
    assert found["return_ci95"][0] <= found["return_mean"] == found["length_mean"] <= found["return_ci95"][1]


def test_repeats_by_seed_and_checkpoint(trained):
    last = evaluate_run(trained / "ppo", episodes=20, seed=3)
    assert same(last, evaluate_run(str(trained / "ppo"), episodes=20, seed=3))
    assert same(last, evaluate_run(trained / "ppo", episodes=20, seed=3, checkpoint="16"))
    assert not same(last, evaluate_run(trained / "ppo", episodes=20, seed=4))
    assert not same(last, evaluate_run(trained / "ppo", episodes=20, seed=3, stochastic=True))
    assert evaluate_run(trained / "ppo", episodes=20, checkpoint="best")["episodes"] == 20


def test_a_numbered_checkpoint_of_one_seed_of_several(trained):
    by_number = evaluate_run(trained / "seeds" / "seed-1", episodes=10, checkpoint=16)
    assert same(by_number, evaluate_run(trained / "seeds" / "seed-1", episodes=10))


def test_gymnasiums_own_environment_agrees(trained):
    ours, theirs = (evaluate_run(trained / "ppo", episodes=40, backend=b, stochastic=True) for b in (None, "gymnasium"))
    error = np.hypot(ours["return_std"], theirs["return_std"]) / np.sqrt(40)
    assert abs(ours["return_mean"] - theirs["return_mean"]) < 5 * error


def test_an_environment_that_ends_after_five_steps(trained):
    short = TimeLimit(CartPole(), 5)
    for env in (short, make(short, 4), lambda: gymnasium.make("CartPole-v1", max_episode_steps=5)):
        assert evaluate_run(trained / "ppo", episodes=6, env=env) == {
            "episodes": 6,
            "return_mean": 5.0,
            "return_std": 0.0,
            "return_ci95": [5.0, 5.0],
            "length_mean": 5.0,
        }


def test_places_that_do_not_divide_the_episodes(trained):
    env = gymnasium.make_vec(
        "CartPole-v1", num_envs=3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": "SameStep"}
    )
    assert evaluate_run(trained / "ppo", episodes=4, env=env)["episodes"] == 4


def test_a_run_made_with_an_object_needs_one(untrained):
    run = untrained("ppo", TimeLimit(CartPole(), 5))
    with pytest.raises(ValueError, match=r"environment object \(TimeLimit\), which a file cannot hold"):
        evaluate_run(run, episodes=2)
    assert evaluate_run(run, episodes=2, env=TimeLimit(CartPole(), 5))["length_mean"] == 5


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"env": "Pendulum-v1"}, r"observes a float32 box of shape \[4\], and this environment has .* \[3\]"),
        ({"env": "MountainCar-v0"}, r"asks for another environment: it observes"),
        ({"env": "CartPole-v9"}, "no environment 'CartPole-v9': did you mean CartPole-v1"),
        ({"backend": "jaxx"}, "no backend 'jaxx'"),
        ({"episodes": 0}, "at least one episode, not 0"),
        ({"seed": -1}, "a seed is a whole number"),
        ({"checkpoint": "bst"}, r"no checkpoint 'bst': choose best, last, or the number .* has 16\)"),
        ({"checkpoint": 15}, "has no checkpoint 15: it has 16"),
    ],
)
def test_wrong_requests(trained, asked, sentence):
    with pytest.raises(ValueError, match=sentence):
        evaluate_run(trained / "ppo", **{"episodes": 2, **asked})


def test_other_actions_are_refused(untrained):
    run = untrained("ppo", "Pendulum-v1")
    with pytest.raises(ValueError, match=r"acts with a float32 box of shape \[1\] from -2 to 2, and .* from -1 to 1"):
        evaluate_run(
            run, episodes=1, env=lambda: gymnasium.wrappers.RescaleAction(gymnasium.make("Pendulum-v1"), -1, 1)
        )


def test_no_run(tmp_path):
    with pytest.raises(ValueError, match="there is no run folder"):
        evaluate_run(tmp_path / "nothing")


def test_values_are_compared_with_returns(untrained):
    """Reward 1 for ever is worth 1 / (1 - gamma), whatever an untrained network thinks of it; discounts that change are refused."""
    run = untrained("dqn", "TruncatedLoop", gamma=0.3)
    found = evaluate_run(run, episodes=2, values=True)
    assert found["value_true"] == pytest.approx(1 / 0.7, rel=0.01)
    assert abs(found["value_estimated"] - found["value_true"]) > 0.1
    assert found["value_states"] > 1000
    unknown = evaluate_run(untrained("dqn", "TruncatedLoop", gamma=0.999), episodes=2, values=True)
    assert (unknown["value_true"], unknown["value_states"]) == (None, 0)
    changing = untrained("dqn", "TruncatedLoop", gamma="linear:0.9:0.99")
    with pytest.raises(ValueError, match="without one fixed discount"):
        evaluate_run(changing, episodes=2, values=True)
