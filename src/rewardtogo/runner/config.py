"""Learners, loops and networks as plain data and back: for `config.json`, for presets, and for the command line.

A module is described by its hyperparameters (the fields made by `core.number`, `core.setting` and `core.part`); a recipe of a network
by its fields and the name of its class. Reading runs nothing that the data names: only classes listed here are built.
"""

import dataclasses
import importlib
import inspect
import math
import types
import typing
from typing import Any, TypeVar

import numpy as np

from ..catalogue import nearest
from ..core import Schedule
from ..data.prioritised import PrioritisedReplay
from ..data.replay import UniformReplay
from ..envs.simulator import Simulator
from ..model_based.posteriors import Bootstrap, Dropout, MeanField
from ..nn import (
    CNN,
    GRU,
    LSTM,
    MLP,
    Autoregressive,
    Entries,
    FeaturePoints,
    Latent,
    Mixture,
    Network,
    Stacked,
    Standard,
)
from ..ops.schedules import parse_schedule, to_text
from ..planning.mpc import (
    ILQR,
    Collocation,
    CrossEntropy,
    GradientShooting,
    NewtonShooting,
    PathIntegral,
    RandomShooting,
)
from ..value.exploration import Boltzmann, EpsilonGreedy, Greedy
from ..value.maximisers import CEM, Ascent, Sampled
from ..value.noise import OU, Gaussian
from ..value.outputs import C51, Expectation, Quantiles

Module = TypeVar("Module")

_NETWORKS = (MLP, CNN, GRU, LSTM, Stacked, Entries, FeaturePoints)
_HEADS = (Standard, Mixture, Autoregressive, Latent)
_MEMORIES = (UniformReplay, PrioritisedReplay)
_CHOICES = (Expectation, C51, Quantiles, EpsilonGreedy, Boltzmann, Greedy, Gaussian, OU, Sampled, Ascent, CEM)
_POSTERIORS = (Bootstrap, MeanField, Dropout)
_PLANNERS = (RandomShooting, CrossEntropy, PathIntegral, GradientShooting, NewtonShooting, ILQR, Collocation)
PARTS: dict[str, type] = {
    c.__name__.lower(): c for c in (*_NETWORKS, *_HEADS, *_MEMORIES, *_CHOICES, *_POSTERIORS, *_PLANNERS, Simulator)
}
PARTS |= {"uniform": UniformReplay, "prioritised": PrioritisedReplay, "mean_field": MeanField}


KINDS: dict[Any, str] = {bool: "true or false", int: "a whole number", str: "a name"}


def resolve(path: str) -> Any:
    """The object that `module:name` names. Raises `ValueError` where there is none."""
    module, _, name = path.partition(":")
    if not module or not name:
        raise ValueError(f"{path!r} is not of the form module:Class")
    try:
        found: Any = importlib.import_module(module)
    except Exception as error:
        raise ValueError(f"the module {module!r} of {path!r} cannot be imported: {error}") from error
    for step in name.split("."):
        inside = vars(found) if isinstance(found, (types.ModuleType, type)) else {}
        if step not in inside:
            raise ValueError(
                f"the module {module!r} has no {name!r}: {nearest(name, [k for k in inside if not k.startswith('_')])}"
            )
        found = inside[step]
    return found


def options(cls: type) -> dict[str, dataclasses.Field]:
    """What can be set on a class: its declared hyperparameters, or all fields of a recipe."""
    fields = {f.name: f for f in dataclasses.fields(cls)}
    declared = {name: f for name, f in fields.items() if "doc" in f.metadata}
    return declared or ({} if cls not in PARTS.values() else fields)


def describe(module: Any) -> dict[str, Any]:
    """The hyperparameters of a learner, loop or recipe as plain data."""
    name = type(module).__name__
    data: dict[str, Any] = {"class": name if type(module) in PARTS.values() else f"{type(module).__module__}:{name}"}
    for name, field in options(type(module)).items():
        data[name] = _plain(getattr(module, field.name))
    return data


def _plain(value: Any) -> Any:
    if isinstance(value, Schedule):
        return to_text(value)
    if dataclasses.is_dataclass(value):
        return describe(value)
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if hasattr(value, "ndim") and value.ndim == 0:
        return float(value)
    return f"{getattr(value, '__module__', '?')}:{getattr(value, '__qualname__', type(value).__name__)}"


def build(cls: type, data: dict[str, Any], **fixed: Any) -> Any:
    """An instance of `cls` from plain data or text; what is not mentioned keeps its default. `fixed` are fields given as they are.

    Raises `ValueError`, naming the nearest option, for one that the class does not have or a value that it cannot take.
    """
    values = _values(cls, data) | fixed
    splat = [p.name for p in inspect.signature(cls).parameters.values() if p.kind is p.VAR_POSITIONAL]
    several = values.pop(splat[0], ()) if splat else ()
    if not isinstance(several, tuple):
        raise ValueError(f"{cls.__name__}.{splat[0]} must be a list, such as [64, 64], not {several!r}")
    try:
        return cls(*several, **values)
    except TypeError as error:
        raise ValueError(
            f"{cls.__name__} cannot be made from the options {', '.join(values) or '(none)'}: {error}"
        ) from error


def override(module: Module, data: dict[str, Any]) -> Module:
    """The same module with some hyperparameters replaced; raises as `build` does."""
    return dataclasses.replace(module, **_values(type(module), data)) if data else module  # type: ignore[type-var]


def _values(cls: type, data: dict[str, Any]) -> dict[str, Any]:
    known = options(cls)
    unknown = [name for name in data if name != "class" and name not in known]
    if unknown:
        raise ValueError(f"{cls.__name__} has no option {unknown[0]!r}: {nearest(unknown[0], known)}")
    return {name: _value(cls, known[name], value) for name, value in data.items() if name != "class"}


def _value(cls: type, field: dataclasses.Field, value: Any) -> Any:
    where = f"{cls.__name__}.{field.name}"
    hint = _hint(cls, field)
    if field.metadata.get("part") or hint in (Network, Network | None):
        return part_of(where, field, value)
    if isinstance(value, dict):
        raise ValueError(f"{where} is one value and has no options of its own, such as {next(iter(value), '')!r}")
    if field.metadata.get("traced"):
        if isinstance(value, str):
            return _schedule(where, value)
        return value
    value = _from_text(where, hint, value) if isinstance(value, str) else value
    value = tuple(value) if isinstance(value, list) else value
    choices = field.metadata.get("choices")
    if choices and value not in choices:
        raise ValueError(f"{where} must be one of {', '.join(map(str, choices))}, not {value!r}")
    if hint in KINDS and not (isinstance(value, hint) and isinstance(value, bool) == (hint is bool)):
        raise ValueError(f"{where} must be {KINDS[hint]}, not {value!r}")
    if isinstance(value, tuple) and any(isinstance(n, int) and abs(n) >= 2**31 for n in value):
        raise ValueError(f"{where} must be whole numbers less than 2^31, not {' '.join(map(str, value))}")
    return value


def _schedule(where: str, text: str) -> float | Schedule:
    try:
        return parse_schedule(text)
    except ValueError as error:
        raise ValueError(f"{where} cannot be that: {error}") from None


def _hint(cls: type, field: dataclasses.Field) -> Any:
    return field.type if not isinstance(field.type, str) else typing.get_type_hints(cls)[field.name]


def part_of(where: str, field: dataclasses.Field, value: Any) -> Any:
    """A part (a network, a replay) from plain data, or as it is. Raises `ValueError` for a class that it cannot be."""
    if isinstance(value, str):
        value = {"class": value}
    if not isinstance(value, dict):
        return value
    default = field.default if field.default is not dataclasses.MISSING else MLP(64)
    name = str(value.get("class", type(default).__name__)).lower()
    kind = type(default).__mro__[1]  # what a part of another class must be too: a network, or a replay
    known = [name for name, cls in PARTS.items() if issubclass(cls, kind)]
    if name not in known:
        hint = nearest(name, known)
        raise ValueError(
            f"{where} cannot be {value['class']!r} by name: {hint}{'' if hint.endswith('?') else '.'} Others are given from Python."
        )
    base = describe(default) if PARTS[name] is type(default) else {}
    return build(PARTS[name], base | value)


def _from_text(where: str, hint: Any, text: str) -> Any:
    plain = typing.get_origin(hint) or hint
    try:
        if plain is bool:
            return {"true": True, "false": False, "yes": True, "no": False, "1": True, "0": False}[text.lower()]
        if plain is int:
            return int(text.replace("_", "")) if "e" not in text.lower() else _whole(float(text))
        if plain is float:
            return float(text)
        if plain is tuple:
            return tuple(int(item) for item in text.replace(",", " ").split())
    except (ValueError, KeyError):
        kinds = KINDS | {float: "a number", tuple: "whole numbers such as 64 64"}
        raise ValueError(f"{where} must be {kinds[plain]}, not {text!r}") from None
    return text


def _whole(value: float) -> int:
    if not math.isfinite(value) or value != int(value):
        raise ValueError
    return int(value)


def merge(*layers: dict[str, Any]) -> dict[str, Any]:
    """Nested dictionaries laid over each other; later ones win. A part of another class replaces the whole part."""
    result: dict[str, Any] = {}
    for layer in layers:
        for name, value in layer.items():
            old = result.get(name)
            if isinstance(value, dict) and isinstance(old, str):
                old = {"class": old}
            fresh = isinstance(value, dict) and "class" in value
            result[name] = (
                merge(old, value) if isinstance(old, dict) and isinstance(value, dict) and not fresh else value
            )
    return result


def as_builtin(value: Any) -> Any:
    """NumPy numbers and arrays as Python ones, NaN and infinities as None: what JSON can hold."""
    if isinstance(value, dict):
        return {k: as_builtin(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_builtin(v) for v in value]
    if isinstance(value, np.ndarray):
        return as_builtin(value.tolist())
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
