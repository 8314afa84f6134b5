"""Dense policies as ONNX graphs: one-hot, standardise, `Gemm` and activation a layer, then the likeliest action.

Written by hand from the parameters, node by node, so that no converter is needed; recurrent, convolutional and foreign networks are
refused, and StableHLO holds those.
"""

import importlib
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from ..core import MASK, EnvSpec, Policy, Spec
from ..nn import ActorCriticPolicy, RunningNorm
from ..nn.encoding import input_parts
from ..nn.heads import centre, half_width
from ..nn.network import Linear, MLPTorso, Torso
from ..value.outputs import Expectation
from ..value.q_network import GreedyPolicy

OPSET = 20
TYPES = {"float32": "FLOAT", "int32": "INT64", "int8": "INT8", "uint8": "UINT8"}
"""ONNX types of inputs and outputs by ours; choices are INT64, as Gymnasium has them."""


class _Graph:
    """Nodes and constants so far. Values are named, and a new name is given to each."""

    def __init__(self, onnx: Any):
        self.onnx, self.nodes, self.constants = onnx, [], []

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        """The name of a constant."""
        name = f"constant_{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, kind: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        """The name of a new node's output."""
        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def cast(self, value: str, kind: str) -> str:
        """`value` as another type."""
        return self.add("Cast", value, to=self.onnx.TensorProto.DataType.Value(kind))

    def linear(self, x: str, layer: Linear) -> str:
        """W x + b."""
        return self.add("Gemm", x, self.constant(layer.weight), self.constant(layer.bias), transB=1)

    def activation(self, x: str, name: str) -> str:
        """One of `nn.network.ACTIVATIONS`."""
        if name == "silu":
            return self.add("Mul", x, self.add("Sigmoid", x))
        if name == "gelu":
            return self.add("Gelu", x, approximate="tanh")
        return self.add({"tanh": "Tanh", "relu": "Relu", "elu": "Elu"}[name], x)


def write_onnx(path: Path, policy: Policy, spec: EnvSpec) -> None:
    """Write a policy of dense layers. Raises `ValueError` for others, and where `onnx` is not installed."""
    torso, head = _dense(policy)
    try:
        onnx = importlib.import_module("onnx")
        importlib.import_module("onnx.numpy_helper")
    except ImportError as error:
        raise ValueError("writing ONNX needs the package onnx: pip install 'rewardtogo[onnx]'") from error
    graph = _Graph(onnx)
    norm = policy.norm if isinstance(policy, (ActorCriticPolicy, GreedyPolicy)) else None
    x = _flat(graph, spec.observation, norm)
    for layer in torso.layers:
        x = graph.activation(graph.linear(x, layer), torso.activation)
    masked = any(name == MASK for name, _ in spec.observation.parts)
    _action(graph, spec.action, graph.linear(x, head), masked)
    parts = spec.observation.parts or (("observation", spec.observation),)
    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            "policy",
            [_value(onnx, name, part) for name, part in parts],
            [_value(onnx, "action", spec.action)],
            graph.constants,
        ),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=9,
        producer_name="rewardtogo",
    )
    onnx.checker.check_model(model)
    onnx.save(model, path)


def _value(onnx: Any, name: str, spec: Spec) -> Any:
    kind = onnx.TensorProto.DataType.Value(TYPES[spec.dtype])
    return onnx.helper.make_tensor_value_info(name, kind, ["N", *spec.shape])


def _dense(policy: Policy) -> tuple[MLPTorso, Linear]:
    """The dense layers that choose the action, and the last one."""
    torso, head = _network(policy)
    if not isinstance(torso, MLPTorso):
        raise ValueError(
            f"ONNX is written for networks of dense layers, not for a {type(torso).__name__}: use --format stablehlo"
        )
    return torso, head


def _network(policy: Policy) -> tuple[Torso, Linear]:
    """What chooses the action: features, and the last layer."""
    if isinstance(policy, ActorCriticPolicy):
        return policy.network.actor, policy.network.head.linear
    if isinstance(policy, GreedyPolicy):
        head = policy.network.head
        *hidden, last = head.layers
        if not isinstance(policy.outputs, Expectation) or head.value or hidden:
            raise ValueError(
                "ONNX is written for one Q value an action from one layer, not for dueling, deep or distributional heads: "
                "use --format stablehlo"
            )
        return policy.network.torso, last if isinstance(last, Linear) else last.mean
    raise ValueError(f"ONNX cannot be written for a {type(policy).__name__}: use --format stablehlo")


def _flat(graph: _Graph, spec: Spec, norm: RunningNorm | None) -> str:
    """The observation as `[N, F]`, as `nn.flatten_observation` makes it."""
    parts = []
    for name, part in input_parts(spec):
        x = name or "observation"
        if part.kind in ("discrete", "multi_discrete"):
            parts += _one_hot(graph, part, x)
            continue
        x = graph.cast(x, "FLOAT")
        if norm is not None and name in norm.mean:
            variance = np.where(norm.count > 1, norm.square[name] / np.maximum(norm.count, 1), 1.0)
            x = graph.add("Sub", x, graph.constant(norm.mean[name]))
            x = graph.add("Div", x, graph.constant(np.sqrt(variance + 1e-8)))
            x = graph.add("Clip", x, graph.constant(-norm.limit), graph.constant(norm.limit))
        x = graph.add("Reshape", x, graph.constant([-1, part.size], np.int64))
        parts.append(graph.add("Div", x, graph.constant(255.0)) if part.dtype == "uint8" else x)
    return parts[0] if len(parts) == 1 else graph.add("Concat", *parts, axis=1)


def _one_hot(graph: _Graph, spec: Spec, x: str) -> list[str]:
    """The entries of a choice, each as `[N, n]`."""
    starts = spec.start or (0,) * len(spec.counts)
    flat = graph.add("Reshape", x, graph.constant([-1, len(spec.counts)], np.int64))
    found = []
    for i, (count, start) in enumerate(zip(spec.counts, starts, strict=True)):
        digit = graph.add("Gather", flat, graph.constant(i, np.int64), axis=1)
        digit = graph.add("Sub", digit, graph.constant(start, np.int64))
        found.append(graph.add("OneHot", digit, graph.constant(count, np.int64), graph.constant([0, 1]), axis=-1))
    return found


def _action(graph: _Graph, spec: Spec, out: str, masked: bool) -> None:
    """The likeliest action, valid and counted from where the environment begins, under the name `action`."""
    if spec.kind == "box":
        shape = graph.constant([-1, *spec.shape], np.int64)
        x = graph.add("Mul", graph.add("Reshape", out, shape), graph.constant(half_width(spec)))
        x = graph.add("Add", x, graph.constant(centre(spec)))
        low, high = (np.nan_to_num(bound) for bound in spec.bounds())
        x = graph.add("Min", graph.add("Max", x, graph.constant(low)), graph.constant(high))
        graph.add("Cast", x, output="action", to=graph.onnx.TensorProto.DataType.Value(TYPES[spec.dtype]))
        return
    if spec.kind == "multi_binary":
        yes = graph.add("Greater", out, graph.constant(0.0))
        yes = graph.add("Reshape", yes, graph.constant([-1, *spec.shape], np.int64))
        graph.add("Cast", yes, output="action", to=graph.onnx.TensorProto.DataType.Value("INT8"))
        return
    if masked:
        allowed = graph.add("Greater", graph.cast(MASK, "FLOAT"), graph.constant(0.0))
        out = graph.add("Where", allowed, out, graph.constant(np.finfo(np.float32).min))
    edges = np.cumsum([0, *spec.counts])
    digits = []
    for first, last in itertools.pairwise(edges):
        span = [graph.constant([v], np.int64) for v in (first, last, 1)]
        digits.append(graph.add("ArgMax", graph.add("Slice", out, *span), axis=1, keepdims=1))
    digits = digits[0] if len(digits) == 1 else graph.add("Concat", *digits, axis=1)
    chosen = graph.add("Reshape", digits, graph.constant([-1, *spec.shape], np.int64))
    start = np.asarray(spec.start or 0).reshape(spec.shape if spec.start else ())
    graph.add("Add", chosen, graph.constant(start, np.int64), output="action")
