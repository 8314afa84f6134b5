"""Hyperparameters as fields of a frozen module: default, range and meaning written once, beside each other.

A `number` is a traced float32 leaf, so that a new value never recompiles and a sweep is a `vmap`; a `setting` (an int, a bool, a
name, a function) is static and part of the compiled program.
"""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

Module = TypeVar("Module")


class Schedule(eqx.Module):
    """A hyperparameter that changes over training: a function of the number of updates done so far."""

    @abstractmethod
    def __call__(self, step: Array | int) -> Array:
        """The value after `step` updates."""

    @abstractmethod
    def with_horizon(self, horizon: int) -> "Schedule":
        """The same schedule over `horizon` updates, unless it has a horizon already."""

    @abstractmethod
    def extremes(self) -> tuple[float, float]:
        """The least and the greatest value it takes, for range checks."""


if TYPE_CHECKING:
    Number = Any
else:
    Number = float | Array | np.ndarray | Schedule
"""What a traced hyperparameter may be: a number, an array of numbers under `vmap`, or a schedule."""


def fix_horizon(tree: Any, horizon: int) -> Any:
    """`tree` with every schedule that has no horizon yet stretched over `horizon` updates."""
    is_schedule = lambda leaf: isinstance(leaf, Schedule)  # noqa: E731
    return jax.tree.map(lambda x: x.with_horizon(horizon) if is_schedule(x) else x, tree, is_leaf=is_schedule)


@dataclasses.dataclass(frozen=True)
class Range:
    """An interval that a number must lie in; `None` means open to that side."""

    at_least: float | None = None
    at_most: float | None = None
    above: float | None = None
    below: float | None = None

    def holds(self, value: float) -> bool:
        """Whether `value` is a finite number inside."""
        return (
            math.isfinite(value)
            and (self.at_least is None or value >= self.at_least)
            and (self.at_most is None or value <= self.at_most)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def closed(self) -> "Range":
        """The same interval with its ends, which a schedule may come to."""
        return Range(
            self.at_least if self.above is None else self.above, self.at_most if self.below is None else self.below
        )

    def __str__(self) -> str:
        low = (
            f"[{self.at_least:g}"
            if self.at_least is not None
            else f"({self.above:g}"
            if self.above is not None
            else "(-inf"
        )
        high = (
            f"{self.at_most:g}]"
            if self.at_most is not None
            else f"{self.below:g})"
            if self.below is not None
            else "inf)"
        )
        return f"{low}, {high}"


def number(
    default: float | Schedule,
    doc: str,
    *,
    at_least: float | None = None,
    at_most: float | None = None,
    above: float | None = None,
    below: float | None = None,
) -> Any:
    """A traced float hyperparameter: its default, what it means, and the interval it must lie in."""
    span = Range(at_least, at_most, above, below)
    return eqx.field(
        default=_as_number(default), converter=_as_number, metadata={"doc": doc, "range": span, "traced": True}
    )


def setting(
    default: Any,
    doc: str,
    *,
    at_least: int | None = None,
    at_most: int | None = None,
    choices: tuple[Any, ...] = (),
    converter: Callable[[Any], Any] | None = None,
) -> Any:
    """A static hyperparameter: its default, what it means, and what it may be."""
    metadata = {"doc": doc, "range": Range(at_least, at_most), "choices": choices, "traced": False}
    keywords: dict[str, Any] = {"default": default, "static": True, "metadata": metadata}
    if converter is not None:
        keywords["converter"] = converter
    return eqx.field(**keywords)


def part(default: Any, doc: str, *, converter: Callable[[Any], Any] | None = None) -> Any:
    """A hyperparameter that is itself a module with hyperparameters, such as a network recipe."""
    keywords: dict[str, Any] = {"default": default, "metadata": {"doc": doc, "part": True}}
    if converter is not None:
        keywords["converter"] = converter
    return eqx.field(**keywords)


def _as_number(value: Any) -> Any:
    return float(value) if isinstance(value, (int, np.integer)) and not isinstance(value, bool) else value


class Configured(eqx.Module):
    """Base of everything with hyperparameters: checks each against its declared range when it is built.

    Raises `ValueError` naming the field, the value and the range. Traced values cannot be looked at and are not checked.
    """

    def at(self: Module, step: Array | int) -> Module:
        """The same module with every schedule replaced by its value after `step` updates."""
        is_schedule = lambda leaf: isinstance(leaf, Schedule)  # noqa: E731
        return jax.tree.map(lambda x: x(step) if is_schedule(x) else x, self, is_leaf=is_schedule)

    def __check_init__(self) -> None:
        for field in dataclasses.fields(self):
            if "doc" in field.metadata:
                _check(type(self).__name__, field, getattr(self, field.name))


def _check(owner: str, field: dataclasses.Field, value: Any) -> None:
    meta = field.metadata
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value)) or meta.get("part"):
        return
    span = meta["range"]
    if meta["traced"]:
        if isinstance(value, Schedule):
            values, span = value.extremes(), span.closed()
        elif isinstance(value, float) or (
            isinstance(value, (jax.Array, np.ndarray, np.generic)) and np.issubdtype(value.dtype, np.number)
        ):
            values = tuple(np.asarray(value, np.float64).ravel().tolist())
        else:
            raise ValueError(f"{owner}.{field.name} must be a number in {span} or a schedule, not {value!r}")
    else:
        if meta["choices"] and value not in meta["choices"]:
            raise ValueError(
                f"{owner}.{field.name} must be one of {', '.join(map(str, meta['choices']))}, not {value!r}"
            )
        wants_int = field.type is int or field.type == "int"
        if wants_int and (isinstance(value, bool) or not isinstance(value, (int, np.integer))):
            raise ValueError(f"{owner}.{field.name} must be a whole number in {span}, not {value!r}")
        if wants_int and abs(value) >= 2**31:
            raise ValueError(f"{owner}.{field.name} must be in {span} and less than 2^31, not {value}")
        values = (value,) if wants_int else ()
    for item in values:
        if not span.holds(item):
            raise ValueError(f"{owner}.{field.name} must be in {span}, not {item:g}")
