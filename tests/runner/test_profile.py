"""`--profile`: the three parts of an iteration, and whether they are all there is."""

import time

import pytest

from rewardtogo.nn import MLP
from rewardtogo.runner import profile as module
from rewardtogo.runner.profile import Anatomy, anatomy, profile


@pytest.mark.parametrize("name", ["ppo", "dqn", "async_ac"])
def test_the_parts_add_up(untrained, item, name):
    loop = {"unroll": 8, "warm_up": 200, "batch_size": 128, "updates": 2} if name == "dqn" else {"unroll": 32}
    options = {"num_envs": 4, "loop": loop, "steps": 20_000}
    run = untrained(name, "CartPole-v1", checkpoint=True, options=options, network=MLP(64, 64))
    before = {p: p.stat().st_mtime_ns for p in run.rglob("*")}
    # Of what this process gets of the machine, which others may be using as well: a disturbed measurement is taken again.
    for _ in range(3):
        found = anatomy(run, rounds=9, timer=time.process_time)
        if 0.8 <= found.ratio <= 1.2:
            break
    assert min(found.collection, found.learning, found.evaluation, found.whole) > 0 and found.foreign is None
    assert before == {p: p.stat().st_mtime_ns for p in run.rglob("*")}
    with item("1.23") as check:
        check(found.ratio, ">=", 0.8, f"{name}: sum of the three parts over the whole")
        check(found.ratio, "<=", 1.2, f"{name}: sum of the three parts over the whole")


def test_a_foreign_environment_is_timed_inside_the_callback(untrained):
    options = {"num_envs": 2, "backend": "gymnasium", "loop": {"unroll": 16}, "eval_episodes": 2}
    found = anatomy(untrained("ppo", "CartPole-v1", checkpoint=True, options=options, epochs=1), rounds=3)
    assert found.foreign is not None and 0 < found.foreign < found.collection


def test_the_report(untrained, monkeypatch):
    monkeypatch.setattr(module, "anatomy", lambda *_, **__: Anatomy(0.003, 6e-3, 1e-3, 0.0099, 0.0015))
    assert profile(untrained("ppo", "CartPole-v1")).splitlines() == [
        "where the time of an iteration goes (ppo in CartPole-v1):",
        "  collection      3 ms    30%",
        "  learning        6 ms    60%",
        "  evaluation      1 ms    10%",
        "  of collection, 50% are inside the environment's own code",
        "  together 101% of the whole, 9.9 ms",
    ]


def test_no_checkpoint(untrained):
    with pytest.raises(ValueError, match="has no checkpoint to time from"):
        profile(untrained("ppo", "CartPole-v1"))
