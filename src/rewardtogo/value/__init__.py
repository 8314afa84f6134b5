"""Values without a policy: dynamic programming, fitted iteration and Q-learning (chapters 5 and 6).

Names are looked up when they are asked for: a deep learner needs nothing of the exact solvers.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .bellman_errors import bellman_error as bellman_error
    from .bellman_errors import double_sample_error as double_sample_error
    from .bellman_errors import squared_td_error as squared_td_error
    from .dynamic_programming import Tables as Tables
    from .dynamic_programming import backward_induction as backward_induction
    from .dynamic_programming import gauss_seidel as gauss_seidel
    from .dynamic_programming import modified_policy_iteration as modified_policy_iteration
    from .dynamic_programming import policy_evaluation as policy_evaluation
    from .dynamic_programming import policy_iteration as policy_iteration
    from .dynamic_programming import value_iteration as value_iteration
    from .exploration import Boltzmann as Boltzmann
    from .exploration import EpsilonGreedy as EpsilonGreedy
    from .exploration import Exploration as Exploration
    from .exploration import Greedy as Greedy
    from .fitted import LinearValue as LinearValue
    from .fitted import LookaheadPolicy as LookaheadPolicy
    from .fitted import fitted_q_iteration as fitted_q_iteration
    from .fitted import fitted_value_iteration as fitted_value_iteration
    from .gpi import generalised_policy_iteration as generalised_policy_iteration
    from .operators import bellman_backup as bellman_backup
    from .operators import contraction_ratio as contraction_ratio
    from .operators import evaluation_backup as evaluation_backup
    from .operators import projection as projection
    from .operators import q_backup as q_backup
    from .sweeping import prioritised_sweeping as prioritised_sweeping

_HOMES = {
    "bellman_errors": "bellman_error double_sample_error squared_td_error",
    "dynamic_programming": "Tables backward_induction gauss_seidel "
    "modified_policy_iteration policy_evaluation policy_iteration value_iteration",
    "exploration": "Boltzmann EpsilonGreedy Exploration Greedy",
    "fitted": "LinearValue LookaheadPolicy fitted_q_iteration fitted_value_iteration",
    "gpi": "generalised_policy_iteration",
    "operators": "bellman_backup contraction_ratio evaluation_backup projection q_backup",
    "sweeping": "prioritised_sweeping",
}
_HOME = {name: home for home, names in _HOMES.items() for name in names.split()}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
