"""`--profile`: the three parts of an iteration, and whether they are all there is."""

import time

import pytest

from rewardtogo.runner.profile import anatomy, profile
from rewardtogo.runner.train import train


@pytest.mark.parametrize("name", ["ppo", "dqn"])
def test_the_parts_add_up(trained, item, name):
    # Of what this process gets of the machine, which others may be using as well.
    found = anatomy(trained / name, timer=time.process_time)
    assert min(found.collection, found.learning, found.evaluation, found.whole) > 0 and found.foreign is None
    with item("1.23") as check:
        check(found.ratio, ">=", 0.8, f"{name}: sum of the three parts over the whole")
        check(found.ratio, "<=", 1.2, f"{name}: sum of the three parts over the whole")


def test_a_foreign_environment_is_timed_inside_the_callback(tmp_path):
    train(
        "ppo",
        "CartPole-v1",
        steps=64,
        num_envs=2,
        backend="gymnasium",
        out=tmp_path / "run",
        quiet=True,
        preset="none",
        loop={"unroll": 16},
        learner={"epochs": 1, "minibatches": 1, "network": {"class": "mlp", "sizes": [8]}},
    )
    found = anatomy(tmp_path / "run", rounds=3)
    assert found.foreign is not None and 0 < found.foreign < found.collection


def test_the_report(trained, monkeypatch):
    before = {p: p.stat().st_mtime_ns for p in (trained / "ppo").rglob("*")}
    text = profile(trained / "ppo")
    assert before == {p: p.stat().st_mtime_ns for p in (trained / "ppo").rglob("*")}
    shares = [int(line.split()[-1].rstrip("%")) for line in text.splitlines()[1:4]]
    assert [line.split()[0] for line in text.splitlines()[1:4]] == ["collection", "learning", "evaluation"]
    assert 98 <= sum(shares) <= 102 and "of the whole" in text.splitlines()[-1]


def test_no_checkpoint(untrained):
    with pytest.raises(ValueError, match="has no checkpoint to time from"):
        profile(untrained("ppo", "CartPole-v1"))
