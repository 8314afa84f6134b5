"""Pure maths without a batch axis (callers `vmap`): distributions, returns, advantages, targets, schedules."""

from .advantages import gae as gae
from .advantages import gae_weights as gae_weights
from .advantages import n_step_advantages as n_step_advantages
from .advantages import normalise as normalise
from .distributions import Bernoulli as Bernoulli
from .distributions import Categorical as Categorical
from .distributions import DiagGaussian as DiagGaussian
from .distributions import Distribution as Distribution
from .distributions import FullGaussian as FullGaussian
from .distributions import MultiCategorical as MultiCategorical
from .distributions import TanhGaussian as TanhGaussian
from .returns import lambda_returns as lambda_returns
from .returns import n_step_returns as n_step_returns
from .returns import reward_to_go as reward_to_go
from .returns import total_return as total_return
from .schedules import Constant as Constant
from .schedules import Cosine as Cosine
from .schedules import Exponential as Exponential
from .schedules import Linear as Linear
from .schedules import parse_schedule as parse_schedule
from .schedules import to_text as to_text
