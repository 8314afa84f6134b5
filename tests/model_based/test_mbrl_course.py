"""The course's tasks for version 1.5, an ensemble and replanning: what is learned, beside planning in the true dynamics (`make slow`).

The course asks for returns of -25 to -20 among obstacles after 12 iterations and of -300 to -250 with its arm after 15. The environments
here are our own, so that the score is (return - random) / (planning in the true dynamics - random), with the same planner and horizon. The
processor's time of a seed is held against a tenth of what the course says its own takes: 40 minutes, and two hours.
"""

import statistics
import time
from pathlib import Path

import jax
import pytest

import rewardtogo as rtg
from rewardtogo.core import Policy, env_spec
from rewardtogo.envs import KnownModel, Obstacles, Reacher
from rewardtogo.loops.collect import RandomPolicy, begin
from rewardtogo.planning import MPC, ModelProblem
from rewardtogo.runner.folder import RunFolder
from rewardtogo.runner.plan import plan

pytestmark = pytest.mark.slow
SEEDS, EPISODES = 5, 50


def mean_return(name: str, policy: Policy, steps: int) -> float:
    """Of episodes with a policy."""
    env = rtg.make(name, EPISODES)

    def play(key: jax.Array) -> jax.Array:
        _, _, episodes = rtg.collect(env, policy, begin(env, policy, key), key, steps)
        return episodes.return_sum / episodes.count

    return float(jax.jit(play)(jax.random.key(0)))


@pytest.mark.parametrize(
    ("env", "dynamics", "length", "iterations", "minutes"),
    [("Obstacles", Obstacles(), 100, 12, 40), ("Reacher", Reacher(), 50, 15, 120)],
)
def test_what_is_learned_is_nearly_as_good_as_the_truth(
    item, tmp_path: Path, env, dynamics, length, iterations, minutes
):
    learner, spec = plan("mbrl_v15", env).learner, env_spec(rtg.make(env))
    assert isinstance(learner, rtg.ModelBased)
    known = ModelProblem(KnownModel(dynamics), learner.horizon, spec.action)
    best = mean_return(env, MPC(known, learner.planner), length)
    random = mean_return(env, RandomPolicy(spec), length)
    began = time.process_time()
    runs = rtg.train("mbrl_v15", env, num_seeds=SEEDS, out=tmp_path / "run", quiet=True)
    seconds = (time.process_time() - began) / SEEDS
    assert all(RunFolder(run.path).config()["iterations"] <= iterations for run in runs)
    returns = [run.evaluation["return_mean"] for run in runs]
    scores = sorted((found - random) / (best - random) for found in returns)
    print(
        f"\n{env}: random {random:.1f}, true dynamics {best:.1f}, learned {[round(r, 1) for r in sorted(returns)]}, {seconds:.0f} s a seed"
    )
    with item("8.44") as check:
        check(
            statistics.median(scores), ">=", 0.9, f"mbrl_v15, {env}: median score, {iterations} iterations, five seeds"
        )
        check(sum(score >= 0.9 for score in scores), ">=", 4, f"{env}: seeds that reach it")
        check(seconds, "<=", 6 * minutes, f"{env}: processor seconds of a seed; the course's {minutes} minutes by ten")
