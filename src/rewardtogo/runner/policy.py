"""A policy in two files, `policy.safetensors` and `policy.json`, and as an object: NumPy in, NumPy out. Nothing of the files is run."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from safetensors import SafetensorError

from ..catalogue import ALGORITHMS
from ..core import MASK, EnvSpec, Learner, Policy, Spec
from ..data.files import FORMAT, Damaged, load_tree, read_json, save_tree, write_json
from .config import build, describe, resolve


def save_policy(folder: Path, learner: Learner, state: Any, spec: EnvSpec, about: dict[str, Any]) -> None:
    """Write the policies that a learner's state holds, the one that explores and the one that does not."""
    folder.mkdir(parents=True, exist_ok=True)
    data = {
        "format": FORMAT,
        **about,
        "learner": describe(learner),
        "observation": spec.observation.to_json(),
        "action": spec.action.to_json(),
    }
    try:
        save_tree(folder / "policy.safetensors", policies(learner, state), {"content": "policy"})
        write_json(folder / "policy.json", data)
    except SafetensorError as error:
        raise OSError(f"the policy {folder / 'policy.safetensors'} could not be written: {error}") from error


def policies(learner: Learner, state: Any) -> dict[str, Policy]:
    """Both policies of a state; what they share is the same array."""
    return {"explore": learner.policy(state, explore=True), "greedy": learner.policy(state, explore=False)}


def read_policy_json(folder: Path) -> dict[str, Any]:
    """The description of a policy. Raises `Damaged` where it is missing, newer or no policy's."""
    path = folder / "policy.json"
    if not path.exists():
        raise Damaged(
            f"{folder} holds no policy.json: it is not a run folder, or its run has not finished its first evaluation"
        )
    data = read_json(path)
    if not isinstance(data, dict) or not isinstance(data.get("format"), int) or "learner" not in data:
        raise Damaged(f"{path} is not the description of a policy")
    if data["format"] > FORMAT:
        raise Damaged(
            f"{path} has format {data['format']}, which is newer than this library's {FORMAT}: install a newer rewardtogo"
        )
    return data


def learner_class(name: str, data: dict[str, Any]) -> type[Learner]:
    """The class of a learner that a file describes: one of ours, by the catalogue. A file never makes us import anything else."""
    ours = {row.path: row for row in ALGORITHMS.values()}
    if name not in ALGORITHMS and data.get("class") not in ours:
        raise ValueError(
            f"the run was made with {data.get('class')}, which is not part of rewardtogo, and a file is not allowed to "
            "name code to run: give the learner yourself (rtg.load(path, learner=...), or --learner-class module:Class)"
        )
    return resolve(ALGORITHMS[name].path if name in ALGORITHMS else data["class"])


def restore_learner(data: dict[str, Any], learner: Learner | None) -> Learner:
    """The learner that a file describes, or the one given instead."""
    if learner is not None:
        return learner
    return build(learner_class(data.get("algorithm", ""), data["learner"]), data["learner"])


class LoadedPolicy:
    """A trained policy: observations as NumPy arrays in, actions as NumPy arrays out, one or a batch of them.

    An action is always a valid element of `action_space`. A policy with a memory keeps it between calls, and `reset()` forgets it at
    the start of an episode; a batch has one memory each.
    """

    def __init__(self, policies: dict[str, Policy], spec: EnvSpec, about: dict[str, Any]):
        self.about, self.spec, self._policies = about, spec, policies
        self.observation_space, self.action_space = spec.observation.to_space(), spec.action.to_space()
        self._key = jax.random.key(0)
        self._carry: Any = None
        self._batch: int | None = None
        self._act = jax.jit(jax.vmap(self._choose, in_axes=(None, 0, 0, 0)))
        self._inspect = jax.jit(
            lambda policy, carry, observation: jax.vmap(lambda c, o: policy.inspect(c, o))(carry, observation)
        )

    def reset(self, seed: int | None = None) -> None:
        """Forget the episode; with `seed`, also start the random actions anew."""
        self._carry = None
        if seed is not None:
            self._key = jax.random.key(seed)

    def __call__(self, observation: Any, deterministic: bool = True) -> Any:
        """The action for an observation, or an array of actions for a batch of observations."""
        observation, batched = self._inward(observation)
        policy = self._policies["greedy" if deterministic else "explore"]
        size = len(jax.tree.leaves(observation)[0])
        self._key, key = jax.random.split(self._key)
        self._carry, action = self._act(policy, self._memory(policy, size), observation, jax.random.split(key, size))
        action = jax.device_get(action)
        return self._outward(action if batched else jax.tree.map(lambda x: x[0], action), batched)

    def _choose(self, policy: Policy, carry: Any, observation: Any, key: jax.Array) -> tuple[Any, Any]:
        carry, action, _ = policy(carry, observation, key)
        return carry, self.spec.action.clip(action)

    def policy(self, explore: bool = False) -> Policy:
        """The policy as loops and evaluations take it: one observation in the library's own form, without clipping."""
        return self._policies["explore" if explore else "greedy"]

    def inspect(self, observation: Any) -> dict[str, np.ndarray]:
        """What it thinks of an observation: `value`, `q_values`, `probabilities`, `mean`, `std`, whichever it has."""
        observation, batched = self._inward(observation)
        policy = self._policies["greedy"]
        size = len(jax.tree.leaves(observation)[0])
        thoughts = jax.device_get(self._inspect(policy, self._memory(policy, size), observation))
        return {name: value if batched else np.asarray(value[0]) for name, value in thoughts.items()}

    def _memory(self, policy: Policy, size: int) -> Any:
        if self._carry is None or self._batch != size:
            self._carry = jax.vmap(lambda k: policy.init(k))(jax.random.split(jax.random.key(0), size))
            self._batch = size
        return self._carry

    def _inward(self, observation: Any) -> tuple[Any, bool]:
        spec = self.spec.observation
        if spec.kind != "dict":
            value, batched = _element(spec, observation, "")
            return value if batched else value[None], batched
        flat = _flatten(observation)
        missing = [name for name, _ in spec.parts if name not in flat]
        if missing:
            hint = f" (a mask of the allowed actions: {MASK})" if MASK in missing else ""
            raise ValueError(
                f"the observation has no part {missing[0]!r}{hint}: this policy takes {', '.join(n for n, _ in spec.parts)}"
            )
        parts = {name: _element(part, flat[name], name) for name, part in spec.parts}
        batched = any(b for _, b in parts.values())
        return {name: value if batched else value[None] for name, (value, _) in parts.items()}, batched

    def _outward(self, action: Any, batched: bool) -> Any:
        spec = self.spec.action
        value = np.asarray(action)
        if spec.start:
            value = value + np.asarray(spec.start, value.dtype).reshape(spec.shape)
        if spec.kind in ("discrete", "multi_discrete"):
            value = value.astype(np.int64)
        return value if batched or spec.shape else value[()]


def _flatten(tree: Any, name: str = "") -> dict[str, Any]:
    if isinstance(tree, tuple):
        tree = {str(i): part for i, part in enumerate(tree)}
    if not isinstance(tree, dict):
        return {name: tree}
    return {
        k: v for key, part in tree.items() for k, v in _flatten(part, f"{name}.{key}" if name else str(key)).items()
    }


def _element(spec: Spec, value: Any, name: str) -> tuple[np.ndarray, bool]:
    array = np.asarray(value)
    what = f"the part {name!r} of the observation" if name else "the observation"
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{what} is not made of numbers: it has type {array.dtype}")
    if array.shape != spec.shape and array.shape[1:] != spec.shape:
        raise ValueError(
            f"{what} has shape {array.shape}, and this policy was trained on {spec.shape} (or a batch of these): "
            "it belongs to another environment"
        )
    if array.dtype.kind == "f" and not np.all(np.isfinite(array)):
        raise ValueError(f"{what} contains NaN or infinity")
    start = np.asarray(spec.start).reshape(spec.shape) if spec.start else 0
    return (array - start).astype(spec.dtype), array.shape != spec.shape


def load(path: str | Path, learner: Learner | None = None, checkpoint: str = "last") -> LoadedPolicy:
    """The policy of a run folder.

    - `learner`: needed for a run of a learner that is not part of the library (a file must not name code to run).
    - `checkpoint`: `"last"`, or `"best"` for the one with the best evaluation.

    Raises `Damaged`, a `ValueError`, saying which file cannot be used and why.
    """
    folder = Path(path)
    if not folder.exists():
        raise Damaged(f"there is no run folder {folder}")
    if checkpoint not in ("last", "best"):
        raise ValueError(f"a policy is the 'last' or the 'best' one, not {checkpoint!r}")
    folder = folder / "best" if checkpoint == "best" else folder
    data = read_policy_json(folder)
    try:
        spec = EnvSpec(Spec.from_json(data["observation"]), Spec.from_json(data["action"]))
    except (KeyError, TypeError, ValueError) as error:
        raise Damaged(f"{folder / 'policy.json'} does not describe the spaces of a policy: {error}") from error
    learner = restore_learner(data, learner)
    shapes = jax.eval_shape(lambda key: policies(learner, learner.init(spec, key)), jax.random.key(0))
    loaded = load_tree(folder / "policy.safetensors", shapes)
    about = {k: v for k, v in data.items() if k not in ("observation", "action")}
    return LoadedPolicy(loaded, spec, json.loads(json.dumps(about)))
