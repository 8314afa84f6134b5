r"""Hyperparameters that change over training, as functions of the number of updates done so far.

With the progress $p = \min(1, \text{step} / (\text{fraction} \cdot \text{horizon}))$: `Linear` is $(1 - p) a + p b$,
`Cosine` $b + (a - b)(1 + \cos \pi p)/2$, `Exponential` $a (b/a)^p$. Start and end are traced, so a new value does not
recompile. A schedule without a horizon gets the length of the run when the runner starts it.

In text, as on a command line: `3e-4`, `linear:3e-4:0`, `linear:1:0.05:0.1` (over the first tenth), `cosine:3e-4:0@5000`
(over 5000 updates).

Source: notes 5.1 and 6.2.3 (exploration schedules), 4 (learning rates); Loshchilov and Hutter 2017 (cosine).
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from ..core import Schedule

FORMS = "0.1, constant:0.1, linear:1:0.05, linear:1:0.05:0.1, cosine:1:0.1, exponential:1:0.01 or cosine:1:0.1@5000"


def _field(**keywords: Any) -> Any:
    return eqx.field(converter=lambda x: float(x) if isinstance(x, (int, np.integer)) else x, **keywords)


def _progress(schedule: "Linear | Cosine | Exponential", step: Array | int, fraction: float | Array = 1.0) -> Array:
    if schedule.horizon is None:
        raise ValueError(
            f"{type(schedule).__name__} has no horizon yet, so it has no value at a step: "
            "the runner fixes it, or call with_horizon(number of updates)"
        )
    length = jnp.asarray(fraction, float) * schedule.horizon
    return jnp.clip(jnp.asarray(step).astype(length.dtype) / length, 0.0, 1.0)


def _check_horizon(schedule: "Linear | Cosine | Exponential") -> None:
    horizon = schedule.horizon
    if horizon is not None and (isinstance(horizon, bool) or not isinstance(horizon, (int, np.integer)) or horizon < 1):
        raise ValueError(
            f"{type(schedule).__name__} needs a horizon of at least 1 whole update, or None, not {horizon!r}"
        )


def _span(*values: float | Array) -> tuple[float, float]:
    flat = np.concatenate([np.ravel(np.asarray(value, np.float64)) for value in values])
    return float(flat.min()), float(flat.max())


class Constant(Schedule):
    """Always `value`."""

    value: float | Array = _field()

    def __call__(self, step: Array | int) -> Array:
        return jnp.asarray(self.value, float)

    def with_horizon(self, horizon: int) -> "Constant":
        return self

    def extremes(self) -> tuple[float, float]:
        return _span(self.value)


class Linear(Schedule):
    """A straight line from `start` to `end` over the first `fraction` of the `horizon`, then constant."""

    start: float | Array = _field()
    end: float | Array = _field()
    horizon: int | None = eqx.field(default=None, static=True)
    fraction: float | Array = _field(default=1.0)

    def __check_init__(self) -> None:
        _check_horizon(self)
        if not isinstance(self.fraction, Tracer):
            least, most = _span(self.fraction)
            if not (0.0 < least and most <= 1.0):
                raise ValueError(f"Linear needs a fraction of the horizon in (0, 1], not {self.fraction}")

    def __call__(self, step: Array | int) -> Array:
        progress = _progress(self, step, self.fraction)
        return (1.0 - progress) * jnp.asarray(self.start, float) + progress * jnp.asarray(self.end, float)

    def with_horizon(self, horizon: int) -> "Linear":
        return self if self.horizon is not None else Linear(self.start, self.end, horizon, self.fraction)

    def extremes(self) -> tuple[float, float]:
        return _span(self.start, self.end)


class Cosine(Schedule):
    """Half a cosine wave from `start` to `end` over the `horizon`, then constant."""

    start: float | Array = _field()
    end: float | Array = _field()
    horizon: int | None = eqx.field(default=None, static=True)

    def __check_init__(self) -> None:
        _check_horizon(self)

    def __call__(self, step: Array | int) -> Array:
        rest = 0.5 * (1.0 + jnp.cos(math.pi * _progress(self, step)))
        return rest * jnp.asarray(self.start, float) + (1.0 - rest) * jnp.asarray(self.end, float)

    def with_horizon(self, horizon: int) -> "Cosine":
        return self if self.horizon is not None else Cosine(self.start, self.end, horizon)

    def extremes(self) -> tuple[float, float]:
        return _span(self.start, self.end)


class Exponential(Schedule):
    """Times the same factor at each update, from `start` to `end` (both positive) over the `horizon`, then constant."""

    start: float | Array = _field()
    end: float | Array = _field()
    horizon: int | None = eqx.field(default=None, static=True)

    def __check_init__(self) -> None:
        _check_horizon(self)
        for value in (self.start, self.end):
            if not isinstance(value, Tracer) and not _span(value)[0] > 0.0:
                raise ValueError(
                    f"Exponential cannot pass through {value}: give a positive start and end, or use Linear"
                )

    def __call__(self, step: Array | int) -> Array:
        progress = _progress(self, step)
        logs = (1.0 - progress) * jnp.log(jnp.asarray(self.start, float)) + progress * jnp.log(
            jnp.asarray(self.end, float)
        )
        return jnp.exp(logs)

    def with_horizon(self, horizon: int) -> "Exponential":
        return self if self.horizon is not None else Exponential(self.start, self.end, horizon)

    def extremes(self) -> tuple[float, float]:
        return _span(self.start, self.end)


def parse_schedule(text: str) -> float | Schedule:
    """The number or schedule that a text stands for, such as `3e-4`, `linear:3e-4:0` or `linear:1:0.05:0.1@5000`.

    Raises `ValueError` where it stands for none.
    """
    body, at, horizon_text = text.strip().partition("@")
    name, *parts = body.split(":")
    try:
        numbers = [float(part) for part in (parts if parts else [name])]
        horizon = int(horizon_text) if at else None
    except ValueError:
        raise ValueError(f"{text!r} is neither a number nor a schedule: write it like {FORMS}") from None
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{text!r} has a number that is not finite in it: write it like {FORMS}")
    if not parts and not at:
        return numbers[0]
    kind, count = name.lower() if parts else "", len(numbers)
    if kind == "constant" and count == 1 and not at:
        return Constant(numbers[0])
    if kind == "linear" and count in (2, 3):
        return Linear(numbers[0], numbers[1], horizon, *numbers[2:])
    if kind in ("cosine", "exponential") and count == 2:
        return (Cosine if kind == "cosine" else Exponential)(numbers[0], numbers[1], horizon)
    raise ValueError(f"{text!r} is not a schedule with its numbers: write it like {FORMS}")


def to_text(schedule: float | Schedule) -> str:
    """The text that `parse_schedule` reads back as the same number or schedule."""
    if isinstance(schedule, Constant):
        return f"constant:{_short(schedule.value)}"
    if isinstance(schedule, (Linear, Cosine, Exponential)):
        fraction = schedule.fraction if isinstance(schedule, Linear) else 1.0
        parts = [type(schedule).__name__.lower(), _short(schedule.start), _short(schedule.end)]
        parts += [_short(fraction)] if float(fraction) != 1.0 else []
        return ":".join(parts) + (f"@{schedule.horizon}" if schedule.horizon is not None else "")
    if isinstance(schedule, Schedule):
        raise ValueError(f"a schedule of the class {type(schedule).__name__} has no text: use one of rewardtogo.ops")
    return _short(schedule)


def _short(value: float | Array) -> str:
    # The shortest digits that give the number back in its own precision: 0.05, where float32 is 0.05000000074505806.
    number = np.asarray(value)
    if number.shape != ():
        raise ValueError(f"a schedule over an array of shape {number.shape} has no text: write one for each number")
    return str(number[()]).removesuffix(".0")
