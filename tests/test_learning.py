"""Learning thresholds: five seeds with the preset, each evaluated over 100 episodes. Slow; `make slow` stores the results.

Compiled environments train five seeds in one program and are evaluated in Gymnasium's own environment where there is one.
"""

import dataclasses
from pathlib import Path

import gymnasium
import pytest

import rewardtogo as rtg
from rewardtogo.envs.registry import COMPILED
from rewardtogo.runner.evaluate_run import evaluate_run

pytestmark = pytest.mark.slow
SEEDS = 5


@dataclasses.dataclass
class Claim:
    """At least `seeds` of five reach `score` within `steps` environment steps."""

    algorithm: str
    env: str
    steps: int
    score: float
    seeds: int = 5
    backend: str = "auto"

    def __str__(self) -> str:
        return f"{self.algorithm}-{self.env}-{self.backend}"


CLAIMS = [
    Claim("ppo", "CartPole-v1", 100_000, 475),
    Claim("ppo", "CartPole-v1", 100_000, 475, backend="gymnasium"),
    Claim("dqn", "CartPole-v1", 100_000, 475, seeds=4),
    Claim("reinforce", "CartPole-v1", 300_000, 475, seeds=4),
    Claim("ppo", "Acrobot-v1", 500_000, -90, seeds=4),
    Claim("ppo", "Pendulum-v1", 100_000, -250, seeds=4),
    Claim("ppo", "InvertedPendulum-v5", 100_000, 950, seeds=4),
    Claim("ppo", "CartPoleNoVel-v1", 300_000, 475, seeds=4),
]


@pytest.mark.parametrize("claim", CLAIMS, ids=str)
def test_score(claim: Claim, tmp_path: Path) -> None:
    runs = rtg.train(
        claim.algorithm,
        claim.env,
        steps=claim.steps,
        num_seeds=SEEDS,
        backend=claim.backend,
        out=tmp_path / "run",
        quiet=True,
    )
    backend = "gymnasium" if claim.env in gymnasium.registry and claim.env in COMPILED else None
    scores = [evaluate_run(str(run.path), episodes=100, backend=backend)["return_mean"] for run in runs]
    print(f"\n{claim}: {claim.steps} steps, returns {', '.join(f'{s:.1f}' for s in sorted(scores))}")
    assert sum(score >= claim.score for score in scores) >= claim.seeds, scores
