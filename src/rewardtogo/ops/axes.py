"""Functions of one step, mapped over steps."""

from collections.abc import Callable
from typing import Any

import jax


def over(axes: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one step mapped over `axes` leading axes."""
    for _ in range(axes):
        function = jax.vmap(function)
    return function
