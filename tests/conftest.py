"""Shared fixtures. `item` ties a check to a numbered item of the inventory and records what was required and what came out."""

import contextlib
import json
import math
import operator
import os
from collections.abc import Callable, Iterator
from pathlib import Path

# Two devices, to test sharding. Little optimisation: tests compile much and compute little.
os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")

OPERATORS = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}


@pytest.fixture
def item(request: pytest.FixtureRequest) -> Callable[[str], contextlib.AbstractContextManager]:
    """`with item("4.33") as check: check(error, "<=", 1e-12)`: asserts, and writes a line for the coverage report."""

    @contextlib.contextmanager
    def record(name: str) -> Iterator[Callable[..., None]]:
        def check(value: float, comparison: str, bound: float, what: str = "") -> None:
            value, bound = float(value), float(bound)
            passed = not math.isnan(value) and OPERATORS[comparison](value, bound)
            folder = os.environ.get("RTG_COVERAGE")
            if folder:
                row = {
                    "item": name,
                    "test": request.node.nodeid,
                    "value": value,
                    "comparison": comparison,
                    "bound": bound,
                    "what": what,
                    "passed": bool(passed),
                    "slow": request.node.get_closest_marker("slow") is not None,
                }
                with Path(folder, f"{os.getpid()}.jsonl").open("a") as file:
                    file.write(json.dumps(row) + "\n")
            assert passed, f"item {name}: {what or 'measured'} {value:g}, required {comparison} {bound:g}"

        yield check

    return record


@pytest.fixture
def x64() -> Iterator[None]:
    """Double precision for one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(autouse=True, scope="module")
def forget_programs() -> Iterator[None]:
    """Compiled programs of one file are of no use to the next, and together they fill the memory."""
    yield
    jax.clear_caches()


@pytest.fixture
def key() -> jax.Array:
    """A fixed key."""
    return jax.random.key(0)
