"""Between Gymnasium's batches and the library's: plain NumPy, no JAX, so that a callback may use it.

Outside, an element is shaped as its Gymnasium space says: nested dictionaries and tuples, discrete values counted from
`start`, 64-bit numbers. Inside, it is what `core.Spec` says: one array or one flat dictionary with dotted names,
discrete values counted from 0, 32-bit numbers, 8-bit pictures left as they are. A `Translation` turns one into the
other, with any leading axes.
"""

import dataclasses
from typing import Any

import gymnasium.spaces as spaces
import numpy as np

from ..core import Spec, from_space

Parts = dict[str, np.ndarray]
"""The arrays of an element by their dotted names; `""` names the array of a space that is not nested."""


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One array of an element: the way to it outside, its name inside (`""` for the only one), and how it is stored."""

    path: tuple[str | int, ...]
    name: str
    spec: Spec
    space: spaces.Space
    start: np.ndarray | None
    """What is added on the way out, where a discrete space does not count from 0."""
    bounds: tuple[np.ndarray, np.ndarray] | None
    """Bounds that the 32-bit value may miss by a rounding, where the space is a 64-bit box."""

    @property
    def inner_dtype(self) -> np.dtype:
        """The type inside the library."""
        return np.dtype(self.spec.dtype)


def _leaf(space: spaces.Space, path: tuple[str | int, ...]) -> Leaf:
    spec = from_space(space)
    start = np.asarray(spec.start, np.int32).reshape(spec.shape) if spec.start else None
    bounds = (space.low, space.high) if isinstance(space, spaces.Box) and space.dtype == np.float64 else None
    return Leaf(path, ".".join(map(str, path)), spec, space, start, bounds)


def _leaves(space: spaces.Space, path: tuple[str | int, ...] = ()) -> list[Leaf]:
    if isinstance(space, spaces.Dict):
        children = list(space.spaces.items())
    elif isinstance(space, spaces.Tuple):
        children = list(enumerate(space.spaces))
    else:
        return [_leaf(space, path)]
    return [leaf for key, child in children for leaf in _leaves(child, (*path, key))]


def _rebuild(
    space: spaces.Space, value: dict[tuple[str | int, ...], np.ndarray], path: tuple[str | int, ...] = ()
) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _rebuild(child, value, (*path, key)) for key, child in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_rebuild(child, value, (*path, i)) for i, child in enumerate(space.spaces))
    return value[path]


class Translation:
    """Both ways for one Gymnasium space.

    Raises `ValueError` where the space has no fixed shape.
    """

    def __init__(self, space: spaces.Space) -> None:
        self.space = space
        self.spec = from_space(space)
        self.nested = self.spec.kind == "dict"
        self.leaves = sorted(_leaves(space), key=lambda leaf: leaf.name)

    def inward(self, value: Any, lead: tuple[int, ...] = ()) -> Parts:
        """What Gymnasium gives, as the arrays the library wants. Those that need no change are not copied.

        Raises `ValueError` where a shape is not `lead` and what the space says, or a type would lose something.
        """
        return {leaf.name: self._inward(leaf, value, lead) for leaf in self.leaves}

    def _inward(self, leaf: Leaf, value: Any, lead: tuple[int, ...]) -> np.ndarray:
        for key in leaf.path:
            value = value[key]
        array = np.asarray(value)
        if array.shape != lead + leaf.spec.shape:
            raise ValueError(
                f"the observation{_named(leaf)} has shape {array.shape[len(lead) :]}, and its space says "
                f"{leaf.spec.shape}"
            )
        if array.dtype.kind not in "biuf" or (array.dtype.kind == "f" and leaf.inner_dtype.kind != "f"):
            raise ValueError(f"the observation{_named(leaf)} is {array.dtype}, and its space says {leaf.space.dtype}")
        if leaf.start is not None:
            array = np.asarray(array - leaf.start)
        if array.dtype == leaf.inner_dtype:
            return array
        with np.errstate(over="ignore"):  # too large for float32 becomes infinity, which whoever checks for it reports
            return array.astype(leaf.inner_dtype)

    def unpacked(self, words: np.ndarray, size: int) -> Parts:
        """The arrays of `size` elements that were laid end to end as 32-bit words, part after part."""
        parts, at = {}, 0
        for leaf in self.leaves:
            end = at + size * leaf.spec.size
            array = words[at:end].view(np.float32 if leaf.inner_dtype.kind == "f" else np.int32)
            parts[leaf.name], at = array.reshape((size, *leaf.spec.shape)), end
        return parts

    def outward(self, parts: Parts) -> Any:
        """What the library gives, as Gymnasium wants it: copies, which an environment may write to."""
        return _rebuild(self.space, {leaf.path: self._outward(leaf, parts[leaf.name]) for leaf in self.leaves})

    def _outward(self, leaf: Leaf, value: Any) -> np.ndarray:
        array = np.array(value, leaf.space.dtype)
        if leaf.start is not None:
            array += leaf.start.astype(array.dtype)
        # A bound such as 0.1 is larger in float32 than in float64, and some environments insist on theirs.
        return array if leaf.bounds is None else np.clip(array, *leaf.bounds)

    def not_finite(self, parts: Parts) -> str | None:
        """The name of a part that holds NaN or infinity, or None."""
        for leaf in self.leaves:
            if leaf.inner_dtype.kind == "f" and not np.isfinite(parts[leaf.name]).all():
                return leaf.name
        return None


def _named(leaf: Leaf) -> str:
    return f" part {leaf.name!r}" if leaf.name else ""
