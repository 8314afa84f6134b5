"""Optimal control and planning with a model, known or learned (chapter 8, sections 8.1 and 8.2).

Names are looked up when they are asked for, so that a planner costs the import of its own file only.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .distill import Distill as Distill
    from .guides import Belief as Belief
    from .guides import Guide as Guide
    from .guides import Guided as Guided
    from .guides import Rollouts as Rollouts
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
    from .self_play import AlphaZero as AlphaZero
    from .self_play import SelfPlay as SelfPlay
    from .tree import Tree as Tree
    from .tree_policies import PUCT as PUCT
    from .tree_policies import UCT as UCT
    from .tree_policies import Edges as Edges
    from .tree_policies import TreePolicy as TreePolicy
    from .tree_search import Decision as Decision
    from .tree_search import Numbered as Numbered
    from .tree_search import SearchPolicy as SearchPolicy
    from .tree_search import TreeSearch as TreeSearch
    from .tree_search import mcts as mcts

_HOMES = {
    "distill": "Distill",
    "guides": "Belief Guide Guided Rollouts",
    "problem": "FunctionProblem ModelProblem Plan Problem box plan_of rollout total_cost why with_horizon",
    "self_play": "AlphaZero SelfPlay",
    "tree": "Tree",
    "tree_policies": "Edges PUCT TreePolicy UCT",
    "tree_search": "Decision Numbered SearchPolicy TreeSearch mcts",
}
_HOME = {name: home for home, names in _HOMES.items() for name in names.split()}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
