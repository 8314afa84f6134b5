"""Optimal control and planning with a model, known or learned (chapter 8, sections 8.1 and 8.2).

Names are looked up when they are asked for, so that a planner costs the import of its own file only.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .linear_quadratic import LinearController as LinearController
    from .linear_quadratic import LQProblem as LQProblem
    from .linear_quadratic import Regulator as Regulator
    from .linear_quadratic import lqr as lqr
    from .linear_quadratic import lqr_infinite as lqr_infinite
    from .linear_quadratic import riccati as riccati
    from .problem import FunctionProblem as FunctionProblem
    from .problem import ModelProblem as ModelProblem
    from .problem import Plan as Plan
    from .problem import Problem as Problem
    from .problem import box as box
    from .problem import plan_of as plan_of
    from .problem import rollout as rollout
    from .problem import total_cost as total_cost
    from .problem import why as why
    from .problem import with_horizon as with_horizon

_HOMES = {
    "linear_quadratic": "LQProblem LinearController Regulator lqr lqr_infinite riccati",
    "problem": "FunctionProblem ModelProblem Plan Problem box plan_of rollout total_cost why with_horizon",
}
_HOME = {name: home for home, names in _HOMES.items() for name in names.split()}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
