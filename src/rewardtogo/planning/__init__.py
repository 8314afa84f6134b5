"""Optimal control and planning with a model, known or learned (chapter 8, sections 8.1 and 8.2).

Names are looked up when they are asked for, so that a planner costs the import of its own file only.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .cross_entropy import cem as cem
    from .cross_entropy import mppi as mppi
    from .distill import Distill as Distill
    from .guides import Belief as Belief
    from .guides import Guide as Guide
    from .guides import Guided as Guided
    from .guides import Rollouts as Rollouts
    from .identification import identify as identify
    from .iterated_lqr import ilqr as ilqr
    from .kl_constrained import StateLaws as StateLaws
    from .kl_constrained import adapted_step as adapted_step
    from .kl_constrained import expected_cost as expected_cost
    from .kl_constrained import kl_constrained_lqr as kl_constrained_lqr
    from .kl_constrained import state_laws as state_laws
    from .kl_constrained import trajectory_kl as trajectory_kl
    from .linear_quadratic import LinearController as LinearController
    from .linear_quadratic import LQProblem as LQProblem
    from .linear_quadratic import Regulator as Regulator
    from .linear_quadratic import lqr as lqr
    from .linear_quadratic import lqr_infinite as lqr_infinite
    from .linear_quadratic import riccati as riccati
    from .linear_quadratic_gaussian import Estimating as Estimating
    from .linear_quadratic_gaussian import lqg as lqg
    from .mpc import ILQR as ILQR
    from .mpc import MPC as MPC
    from .mpc import Collocation as Collocation
    from .mpc import CrossEntropy as CrossEntropy
    from .mpc import GradientShooting as GradientShooting
    from .mpc import NewtonShooting as NewtonShooting
    from .mpc import PathIntegral as PathIntegral
    from .mpc import Planner as Planner
    from .mpc import RandomShooting as RandomShooting
    from .open_loop import best_open_loop as best_open_loop
    from .open_loop import open_loop_return as open_loop_return
    from .open_loop import open_loop_returns as open_loop_returns
    from .problem import FunctionProblem as FunctionProblem
    from .problem import ModelProblem as ModelProblem
    from .problem import Plan as Plan
    from .problem import Problem as Problem
    from .problem import box as box
    from .problem import plan_of as plan_of
    from .problem import rollout as rollout
    from .problem import total_cost as total_cost
    from .problem import why as why
    from .self_play import AlphaZero as AlphaZero
    from .self_play import SelfPlay as SelfPlay
    from .shooting import gradient_shooting as gradient_shooting
    from .shooting import newton_shooting as newton_shooting
    from .shooting import random_shooting as random_shooting
    from .shooting import shooting_hessian as shooting_hessian
    from .sqp import collocation as collocation
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
    "cross_entropy": "cem mppi",
    "distill": "Distill",
    "guides": "Belief Guide Guided Rollouts",
    "identification": "identify",
    "iterated_lqr": "ilqr",
    "kl_constrained": "StateLaws adapted_step expected_cost kl_constrained_lqr state_laws trajectory_kl",
    "linear_quadratic": "LQProblem LinearController Regulator lqr lqr_infinite riccati",
    "linear_quadratic_gaussian": "Estimating lqg",
    "mpc": "Collocation CrossEntropy GradientShooting ILQR MPC NewtonShooting PathIntegral Planner RandomShooting",
    "open_loop": "best_open_loop open_loop_return open_loop_returns",
    "problem": "FunctionProblem ModelProblem Plan Problem box plan_of rollout total_cost why",
    "self_play": "AlphaZero SelfPlay",
    "shooting": "gradient_shooting newton_shooting random_shooting shooting_hessian",
    "sqp": "collocation",
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
