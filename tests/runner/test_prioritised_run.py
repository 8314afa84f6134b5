"""A run with a prioritised replay: described in its folder, stopped, resumed, and equal to the one that was left alone."""

import json
from typing import Any

import numpy as np
from safetensors.numpy import load_file

import rewardtogo as rtg

SMALL: dict[str, Any] = {
    "steps": 160,
    "seed": 3,
    "num_envs": 2,
    "preset": "none",
    "learner": {"network": {"class": "mlp", "sizes": [4]}},
    "loop": {"unroll": 4, "warm_up": 32, "batch_size": 8, "replay": {"capacity": 64, "alpha": 0.7}},
    "quiet": True,
}


def test_a_stopped_run_goes_on_to_the_same_bits(tmp_path):
    whole = rtg.train("per_dqn", "TruncatedLoop", out=tmp_path / "whole", **SMALL)
    stop = rtg.Every(5, lambda moment: True)
    rtg.train("per_dqn", "TruncatedLoop", out=tmp_path / "parts", callbacks=[stop], **SMALL)
    parts = rtg.resume(tmp_path / "parts", quiet=True)
    described = json.loads((whole.path / "config.json").read_text())["loop"]["replay"]
    assert described["class"] == "PrioritisedReplay" and described["beta"].startswith("linear:0.4:1")
    assert (described["capacity"], described["alpha"]) == (64, 0.7)
    assert len((tmp_path / "parts" / "metrics.csv").read_text().splitlines()) > 6  # it did go on
    last = [sorted((run.path / "checkpoints").iterdir())[-1] for run in (whole, parts)]
    assert last[0].name == last[1].name
    one, other = (load_file(next(folder.glob("*.safetensors"))) for folder in last)
    assert one.keys() == other.keys() and any("tree" in name for name in one)
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name])
