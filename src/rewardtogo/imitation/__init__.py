"""Chapter 2: imitation learning."""

from .augment import augmented as augmented
from .bc import BC as BC
from .causal import GraphChoice as GraphChoice
from .causal import GraphPolicy as GraphPolicy
from .causal import choose_graph_by_queries as choose_graph_by_queries
from .causal import choose_graph_by_return as choose_graph_by_return
from .causal import with_random_graphs as with_random_graphs
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
