"""`rtg export`: the same actions without this library."""

import json
import subprocess
import sys

import gymnasium
import gymnasium.spaces as spaces
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from rewardtogo.nn import GRU, MLP
from rewardtogo.runner.export import export
from rewardtogo.runner.policy import load

READER = """
import json, sys
import numpy as np
import jax.export
for path in sys.argv[1:]:
    about = json.load(open(path + ".json"))
    data = dict(np.load(path + ".npz"))
    size = len(next(iter(data.values())))
    observation = data["observation"] if list(data) == ["observation"] else data
    call = jax.export.deserialize(open(path, "rb").read()).call
    memory = [np.full([size, *m["shape"][1:]], m["initial"], m["dtype"]) for m in about["memory"]]
    actions = []
    for _ in range(3):
        action, memory = call(observation, memory) if memory else (call(observation), memory)
        actions.append(np.asarray(action))
    np.save(path + ".npy", np.stack(actions))
assert "rewardtogo" not in sys.modules and "equinox" not in sys.modules
"""


class Strange(gymnasium.Env):
    """Every kind of part in one observation; `kind` chooses the action."""

    def __init__(self, kind):
        self.observation_space = spaces.Dict(
            {
                "choice": spaces.Discrete(3, start=5),
                "grid": spaces.MultiDiscrete([2, 4]),
                "numbers": spaces.Box(-np.inf, np.inf, (2, 2), np.float32),
                "pixels": spaces.Box(0, 255, (3,), np.uint8),
                "switches": spaces.MultiBinary(3),
            }
        )
        self.action_space = {
            "discrete": spaces.Discrete(4, start=-1),
            "multi_discrete": spaces.MultiDiscrete([3, 2]),
            "multi_binary": spaces.MultiBinary(3),
            "box": spaces.Box(np.array([-1, 0], np.float32), np.array([1, np.inf], np.float32)),
        }[kind]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, True, False, {}


def observations(space, count=100, seed=0):
    """A batch of elements of a space, as arrays by name."""
    space.seed(seed)
    items = [space.sample() for _ in range(count)]
    if isinstance(space, spaces.Dict):
        return {name: np.stack([item[name] for item in items]) for name in items[0]}
    return {"observation": np.stack(items)}


def lively(run, scale=30.0):
    """The same folder with larger parameters, so that actions are not all alike."""
    path = run / "policy.safetensors"
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
    arrays = load_file(path)
    heads = {k: scale * v for k, v in arrays.items() if "head" in k and "weight" in k}
    arrays |= heads
    save_file(arrays, path, metadata)
    return run


def test_stablehlo_without_this_library(untrained, tmp_path):
    pytest.importorskip("flatbuffers", reason="StableHLO needs the extra export")
    runs = {
        "dense": untrained("ppo", "CartPole-v1", normalise_observations=True),
        "box": untrained("ppo", "Pendulum-v1"),
        "greedy": untrained("dqn", "CartPole-v1"),
        "memory": untrained("ppo", "CartPole-v1", network=GRU(8, MLP(8))),
        "parts": untrained("ppo", lambda: Strange("discrete")),
    }
    batches, paths = {}, {}
    for name, run in runs.items():
        space = load(lively(run)).observation_space
        batches[name] = observations(space if name == "parts" else spaces.Box(-3, 3, space.shape, np.float32))
        paths[name] = export(run)
        assert paths[name] == run / "policy.stablehlo"
        about = json.loads((run / "policy.stablehlo.json").read_text())
        assert about["platforms"] == ["cpu", "cuda", "tpu"] and bool(about["memory"]) == (name == "memory")
        assert (about["observation"]["choice"] if name == "parts" else about["observation"])["shape"][0] == "N"
        np.savez(f"{paths[name]}.npz", **batches[name])
    subprocess.run([sys.executable, "-c", READER, *map(str, paths.values())], check=True, cwd=tmp_path)
    for name, run in runs.items():
        policy, batch = load(run), batches[name]
        seen = batch["observation"] if list(batch) == ["observation"] else batch
        wanted = np.stack([policy(seen) for _ in range(3)])
        np.testing.assert_allclose(np.load(f"{paths[name]}.npy"), wanted, atol=1e-6, err_msg=name)
        assert len(np.unique(wanted)) > 1 and (name != "parts" or wanted.min() < 0)


KINDS = [(kind, "tanh") for kind in ("discrete", "multi_discrete", "multi_binary", "box")]
ACTIVATIONS = [("box", activation) for activation in ("relu", "silu", "gelu", "elu")]


@pytest.mark.parametrize(("kind", "activation"), KINDS + ACTIVATIONS)
def test_onnx_gives_the_same_actions(untrained, kind, activation):
    run = lively(
        untrained("ppo", lambda: Strange(kind), network=MLP(8, 8, activation=activation), normalise_observations=True)
    )
    policy = load(run)
    batch = observations(policy.observation_space)
    found = evaluated(export(run, "onnx"), batch)
    wanted = policy(batch)
    assert found.shape == wanted.shape
    np.testing.assert_allclose(found, wanted, atol=2e-5)
    assert len(np.unique(wanted)) > 1


def evaluated(path, batch):
    pytest.importorskip("onnx", reason="ONNX needs the extra onnx")
    from onnx.reference import ReferenceEvaluator

    wide = {k: v.astype(np.int64) if v.dtype == np.int32 else v for k, v in batch.items()}
    return ReferenceEvaluator(str(path)).run(["action"], wide)[0]


class Masked(Strange):
    """Two numbers, and a mask of four actions."""

    def __init__(self):
        numbers = spaces.Box(-3, 3, (2,), np.float32)
        self.observation_space = spaces.Dict({"numbers": numbers, "action_mask": spaces.MultiBinary(4)})
        self.action_space = spaces.Discrete(4)


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_onnx_masks_forbidden_actions(untrained, algorithm):
    run = lively(untrained(algorithm, Masked))
    policy = load(run)
    batch = observations(policy.observation_space)
    batch["action_mask"][:, 1] |= ~batch["action_mask"].any(1)
    batch["action_mask"] = batch["action_mask"].astype(np.int8)
    found = evaluated(export(run, "onnx"), batch)
    np.testing.assert_array_equal(found, policy(batch))
    assert np.all(batch["action_mask"][np.arange(100), found]) and len(np.unique(found)) > 1


def test_wrong_requests(untrained, tmp_path, monkeypatch):
    run = untrained("ppo", "CartPole-v1")
    with pytest.raises(ValueError, match="cannot be exported as 'onx': did you mean onnx"):
        export(run, "onx")
    with pytest.raises(ValueError, match="there is no run folder"):
        export(tmp_path / "nothing")
    recurrent = untrained("ppo", "CartPole-v1", network=GRU(4, MLP(4)))
    with pytest.raises(ValueError, match="not for a RecurrentTorso: use --format stablehlo"):
        export(recurrent, "onnx")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"pip install 'rewardtogo\[onnx\]'"):
        export(run, "onnx")
    assert not (run / "policy.onnx").exists()
