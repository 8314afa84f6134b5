"""A policy for use without this library: StableHLO, which JAX alone can read and run, or ONNX.

The file holds the deterministic policy, parameters included, as one function of a batch of N observations, as the environment gives
them, to N valid actions. Beside a StableHLO file a JSON file says how to call it.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export

from ..catalogue import nearest
from ..core import Learner, Policy, Spec
from ..data.files import FORMAT, write_json
from .config import as_builtin
from .export_onnx import write_onnx
from .policy import LoadedPolicy, load

PLATFORMS = ("cpu", "cuda", "tpu")
ENDINGS = {"stablehlo": ".stablehlo", "onnx": ".onnx"}


def export(
    run: str | Path,
    format: str = "stablehlo",
    out: str | Path | None = None,
    checkpoint: str = "last",
    learner: Learner | None = None,
) -> Path:
    """Write a run's deterministic policy to a file and return its name.

    - `format`: `"stablehlo"` (any policy; extra `export`) or `"onnx"` (dense networks; extra `onnx`).
    - `out`: by default `policy.stablehlo` or `policy.onnx` in the run's folder.
    - `learner`: needed for a run of a learner that is not part of the library.

    Raises `ValueError`, one sentence, where the format or the policy cannot be exported.
    """
    if format not in ENDINGS:
        raise ValueError(f"a policy cannot be exported as {format!r}: {nearest(format, ENDINGS)}")
    policy = load(run, learner, checkpoint)
    path = Path(out) if out is not None else Path(run) / f"policy{ENDINGS[format]}"
    path.parent.mkdir(parents=True, exist_ok=True)
    if format == "onnx":
        write_onnx(path, policy.policy(), policy.spec)
    else:
        _write_stablehlo(path, policy)
    return path


def _write_stablehlo(path: Path, loaded: LoadedPolicy) -> None:
    policy, spec = loaded.policy(), loaded.spec
    memory = jax.tree.leaves(policy.init(jax.random.key(0)))
    exported, batch = _exported(policy, spec.observation, spec.action, memory)
    try:
        data = exported.serialize()
    except ImportError as error:
        raise ValueError("writing StableHLO needs flatbuffers: pip install 'rewardtogo[export]'") from error
    path.write_bytes(data)
    write_json(Path(f"{path}.json"), _description(path, loaded, memory, exported, batch))


def _exported(
    policy: Policy, observation: Spec, action: Spec, memory: Sequence[jax.Array]
) -> tuple[jax_export.Exported, int | str]:
    """The policy for any number of observations on any platform, or for as much of both as its operations allow."""
    act = jax.jit(_function(policy, observation, action))
    here = (jax.default_backend().replace("gpu", "cuda"),)
    failed: Exception | None = None
    for batch, platforms in (("N", PLATFORMS), ("N", here), (1, here)):
        size = jax_export.symbolic_shape("N")[0] if batch == "N" else 1
        arguments = [_shapes(observation, size)]
        arguments += [[jax.ShapeDtypeStruct((size, *m.shape), m.dtype) for m in memory]] if memory else []
        try:
            return jax_export.export(act, platforms=platforms)(*arguments), batch
        except Exception as error:  # whatever an operation says that cannot be exported so
            failed = error
    first = str(failed).strip().splitlines()[0]
    raise ValueError(f"this policy has an operation that StableHLO cannot hold: {first}") from failed


def _function(policy: Policy, observation: Spec, action: Spec) -> Callable[..., Any]:
    """`observation -> action`, or with a memory `(observation, memory) -> (action, memory)`, memory a list of arrays."""
    structure = jax.tree.structure(policy.init(jax.random.key(0)))

    def one(seen: Any, memory: list[jax.Array]) -> tuple[Any, list[jax.Array]]:
        # What acts without exploring draws nothing that matters, so that one key does for all.
        carry, chosen, _ = policy(jax.tree.unflatten(structure, memory), seen, jax.random.key(0))
        return action.clip(chosen), jax.tree.leaves(carry)

    def act(seen: Any, memory: list[jax.Array]) -> tuple[Any, list[jax.Array]]:
        chosen, memory = jax.vmap(one)(_started(observation, seen, -1), memory)
        return _started(action, chosen, 1), memory

    return act if structure.num_leaves else lambda seen: act(seen, [])[0]


def _started(spec: Spec, value: Any, sign: int) -> Any:
    """Choices counted from where the environment begins (`sign` 1), or from 0 (`sign` -1)."""
    if spec.kind == "dict":
        return {name: _started(part, value[name], sign) for name, part in spec.parts}
    if not spec.start:
        return value
    return value + sign * jnp.asarray(spec.start, value.dtype).reshape((1, *spec.shape))


def _shapes(spec: Spec, batch: Any) -> Any:
    if spec.kind == "dict":
        return {name: _shapes(part, batch) for name, part in spec.parts}
    return jax.ShapeDtypeStruct((batch, *spec.shape), np.dtype(spec.dtype))


def _description(
    path: Path, loaded: LoadedPolicy, memory: Sequence[jax.Array], exported: jax_export.Exported, batch: int | str
) -> dict[str, Any]:
    """How to call the exported function."""
    call = "action, memory = call(observation, memory)" if memory else "action = call(observation)"
    leaf = lambda part: {"shape": [batch, *part.shape], "dtype": part.dtype}  # noqa: E731
    observation = loaded.spec.observation
    parts = {name: leaf(part) for name, part in observation.parts}
    return as_builtin(
        {
            "format": FORMAT,
            "algorithm": loaded.about.get("algorithm"),
            "env": loaded.about.get("env"),
            "platforms": list(exported.platforms),
            "how": [
                "import jax.export",
                f"call = jax.export.deserialize(open({path.name!r}, 'rb').read()).call",
                *(
                    [
                        "memory = [numpy.full(m.shape, m.initial, m.dtype) for each m of memory]  # when an episode starts"
                    ]
                    if memory
                    else []
                ),
                call,
            ],
            "observation": parts or leaf(observation),
            "action": leaf(loaded.spec.action),
            "memory": [{"shape": [batch, *m.shape], "dtype": str(m.dtype), "initial": _initial(m)} for m in memory],
        }
    )


def _initial(memory: jax.Array) -> Any:
    """Memory at the start of an episode: one number where all are the same."""
    value = np.asarray(memory)
    return value.ravel()[0].item() if value.size and np.all(value == value.ravel()[0]) else value.tolist()
