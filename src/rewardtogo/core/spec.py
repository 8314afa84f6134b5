"""What an observation or an action looks like: `Spec`, the small hashable twin of a Gymnasium space.

Gymnasium's spaces are mutable and not hashable, so they cannot be static parts of a compiled program; a `Spec` can. Inside the
library discrete actions always count from 0, tuples and nested dictionaries are flat dictionaries with dotted names, and 64-bit
numbers are 32-bit ones. `from_space` and `to_space` translate at the door.
"""

import dataclasses
from typing import Any, Literal

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

MASK = "action_mask"
"""The name of the part of a dictionary observation that says which discrete actions are allowed (1) or forbidden (0)."""


@dataclasses.dataclass(frozen=True)
class Spec:
    """Shape, type and bounds of one space. Hashable, so usable as a static field.

    - `kind`: which family of spaces it is.
    - `shape`, `dtype`: of one element. A discrete element is an int32 scalar counted from 0.
    - `low`, `high`: bounds of a box, flattened; a single number where all entries agree.
    - `counts`: `(n,)` for a discrete space, the number of choices of each entry (flattened) for a multi-discrete one.
    - `start`: what Gymnasium calls the first choice of each entry; added at the door, never inside the library.
    - `parts`: names and specs of a dictionary's leaves, sorted by name.
    """

    kind: Literal["box", "discrete", "multi_discrete", "multi_binary", "dict"]
    shape: tuple[int, ...] = ()
    dtype: str = "float32"
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    counts: tuple[int, ...] = ()
    start: tuple[int, ...] = ()
    parts: tuple[tuple[str, "Spec"], ...] = ()

    @property
    def size(self) -> int:
        """How many numbers one element is (a dictionary: all its parts)."""
        return sum(part.size for _, part in self.parts) if self.kind == "dict" else int(np.prod(self.shape, dtype=int))

    @property
    def is_image(self) -> bool:
        """Whether it is a stack of 8-bit pictures, `[height, width, channels]`."""
        return self.kind == "box" and self.dtype == "uint8" and len(self.shape) == 3

    @property
    def is_bounded(self) -> bool:
        """Whether every bound of a box is finite."""
        return self.kind == "box" and bool(np.all(np.isfinite(self.low)) and np.all(np.isfinite(self.high)))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bound of a box, in its shape."""
        return tuple(
            np.broadcast_to(np.asarray(b, self.dtype).reshape(self.shape if len(b) > 1 else ()), self.shape)
            for b in (self.low, self.high)
        )  # type: ignore[return-value]

    def zeros(self) -> PyTree[Array]:
        """An element-shaped tree of zeros."""
        if self.kind == "dict":
            return {name: part.zeros() for name, part in self.parts}
        return jnp.zeros(self.shape, self.dtype)

    def sample(self, key: Key[Array, ""]) -> PyTree[Array]:
        """A uniformly random element; a standard normal or exponential one where a box has no bounds, as Gymnasium does."""
        if self.kind == "dict":
            keys = jax.random.split(key, len(self.parts))
            return {name: part.sample(k) for (name, part), k in zip(self.parts, keys, strict=True)}
        if self.kind in ("discrete", "multi_discrete"):
            counts = jnp.asarray(self.counts, jnp.int32).reshape(self.shape)
            return jax.random.randint(key, self.shape, 0, counts)
        if self.kind == "multi_binary":
            return jax.random.bernoulli(key, 0.5, self.shape).astype(self.dtype)
        low, high = self.bounds()
        if np.issubdtype(np.dtype(self.dtype), np.integer):
            least, most = np.iinfo(np.int32).min, np.iinfo(np.int32).max
            low, high = np.clip(np.float64(low), least, most), np.clip(np.float64(high) + 1, least, most)
            return jax.random.randint(key, self.shape, low.astype(np.int32), high.astype(np.int32)).astype(self.dtype)
        below, above = np.isfinite(low), np.isfinite(high)
        if np.all(below & above):
            return jax.random.uniform(key, self.shape, minval=jnp.asarray(low), maxval=jnp.asarray(high))
        one, two, three = jax.random.split(key, 3)
        tail = jax.random.exponential(one, self.shape)
        uniform = jax.random.uniform(
            two, self.shape, minval=np.where(below, low, 0.0), maxval=np.where(above, high, 1.0)
        )
        free = jax.random.normal(three, self.shape)
        value = jnp.where(
            below,
            jnp.where(above, uniform, np.where(below, low, 0.0) + tail),
            jnp.where(above, np.where(above, high, 0.0) - tail, free),
        )
        return value.astype(self.dtype)

    def clip(self, value: PyTree[Array]) -> PyTree[Array]:
        """The nearest valid element (or batch of them): boxes are clipped to their bounds, the rest is valid already."""
        if self.kind == "dict":
            return {name: part.clip(value[name]) for name, part in self.parts}
        if self.kind != "box" or (np.all(np.isinf(self.low)) and np.all(np.isinf(self.high))):
            return value
        low, high = (bound.reshape((1,) * (value.ndim - bound.ndim) + bound.shape) for bound in self.bounds())
        return jnp.clip(value, jnp.asarray(low), jnp.asarray(high))

    def to_space(self) -> spaces.Space:
        """The Gymnasium space it stands for (tuples and nesting stay flat)."""
        if self.kind == "dict":
            return spaces.Dict({name: part.to_space() for name, part in self.parts})
        if self.kind == "discrete":
            return spaces.Discrete(self.counts[0], start=self.start[0] if self.start else 0)
        if self.kind == "multi_discrete":
            start = np.asarray(self.start).reshape(self.shape) if self.start else None
            return spaces.MultiDiscrete(np.asarray(self.counts).reshape(self.shape), start=start)
        if self.kind == "multi_binary":
            return spaces.MultiBinary(self.size if len(self.shape) == 1 else self.shape)
        low, high = self.bounds()
        return spaces.Box(low, high, self.shape, np.dtype(self.dtype).type)

    def to_json(self) -> dict:
        """Plain data for a file."""
        data = {k: v for k, v in dataclasses.asdict(self).items() if v not in ((), "float32") or k == "shape"}
        return {**data, "parts": {name: part.to_json() for name, part in self.parts}} if self.parts else data

    @staticmethod
    def from_json(data: dict) -> "Spec":
        """The inverse of `to_json`. Raises `ValueError` where the data is no spec."""
        known = {field.name for field in dataclasses.fields(Spec)}
        if not isinstance(data, dict) or "kind" not in data or set(data) - known:
            raise ValueError("that is not the description of a space")
        parts = tuple((name, Spec.from_json(part)) for name, part in data.get("parts", {}).items())
        plain: Any = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items() if k != "parts"}
        return Spec(**plain, parts=parts)


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """The two spaces of an environment, as a learner sees them. Hashable."""

    observation: Spec
    action: Spec


def _short(bound: np.ndarray) -> tuple[float, ...]:
    flat = np.asarray(bound, np.float64).ravel()
    return (float(flat[0]),) if flat.size and np.all(flat == flat[0]) else tuple(float(v) for v in flat)


def _flat(space: spaces.Space, name: str) -> list[tuple[str, Spec]]:
    children = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)  # type: ignore[attr-defined]
    found: list[tuple[str, Spec]] = []
    for key, child in children:
        path = f"{name}.{key}" if name else str(key)
        nested = isinstance(child, (spaces.Dict, spaces.Tuple))
        found += _flat(child, path) if nested else [(path, from_space(child))]
    return found


def from_space(space: spaces.Space) -> Spec:
    """The spec of a Gymnasium space.

    Raises `ValueError` for spaces that have no fixed shape (Text, Graph, Sequence, OneOf).
    """
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        parts = tuple(sorted(_flat(space, "")))
        if not parts:
            raise ValueError("the environment has an empty dictionary as a space: give it at least one part")
        return Spec("dict", dtype="", parts=parts)
    if isinstance(space, spaces.Discrete):
        return Spec("discrete", (), "int32", counts=(int(space.n),), start=(int(space.start),) if space.start else ())
    if isinstance(space, spaces.MultiDiscrete):
        start = np.asarray(space.start).ravel()
        return Spec(
            "multi_discrete",
            tuple(space.nvec.shape),
            "int32",
            counts=tuple(int(n) for n in space.nvec.ravel()),
            start=tuple(int(s) for s in start) if np.any(start) else (),
        )
    if isinstance(space, spaces.MultiBinary):
        return Spec("multi_binary", tuple(space.shape), "int8")
    if isinstance(space, spaces.Box):
        dtype = {"f": "float32", "i": "int32", "u": "int32", "b": "int8"}[space.dtype.kind]
        dtype = str(space.dtype) if space.dtype in (np.uint8, np.int8) else dtype
        return Spec("box", tuple(space.shape), dtype, low=_short(space.low), high=_short(space.high))
    raise ValueError(
        f"a {type(space).__name__} space has no fixed shape, so no learner here can use it: "
        "wrap the environment so that it gives Box, Discrete, MultiDiscrete, MultiBinary, Dict or Tuple"
    )
