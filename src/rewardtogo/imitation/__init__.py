"""Chapter 2: imitation learning."""

from .augment import augmented as augmented
from .bc import BC as BC
from .dagger import DAgger as DAgger
from .dagger import Queries as Queries
from .experts import Fallible as Fallible
from .experts import as_expert as as_expert
from .theory import ErrorBounds as ErrorBounds
from .theory import data_mismatch as data_mismatch
from .theory import error_bounds as error_bounds
from .theory import expected_mistakes as expected_mistakes
from .theory import log_likelihood_reward as log_likelihood_reward
from .theory import mistake_cost as mistake_cost
from .theory import mistake_mixture as mistake_mixture
from .theory import mistake_probability as mistake_probability
from .theory import mixture_weight as mixture_weight
from .theory import worst_mistake as worst_mistake
