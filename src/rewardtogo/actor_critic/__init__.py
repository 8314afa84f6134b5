"""Chapter 4: values as critics. The learners of Algorithms 3 to 5 are settings of `policy_gradient.vanilla`."""

from .asynchronous import Asynchronous as Asynchronous
from .tabular_values import learn_n_step as learn_n_step
from .tabular_values import learn_td_lambda as learn_td_lambda
from .tabular_values import monte_carlo_values as monte_carlo_values
from .tabular_values import normal_equations as normal_equations
from .tabular_values import td_fixed_point as td_fixed_point
from .tabular_values import td_values as td_values
from .value_fitting import ValueNetwork as ValueNetwork
from .value_fitting import ValueTable as ValueTable
from .value_fitting import fit_value as fit_value
from .value_fitting import value_loss as value_loss
from .value_fitting import value_targets as value_targets
