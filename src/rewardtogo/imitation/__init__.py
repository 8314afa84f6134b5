"""Chapter 2: imitation learning."""

from .bc import BC as BC
from .dagger import DAgger as DAgger
from .dagger import Queries as Queries
from .experts import Fallible as Fallible
from .experts import as_expert as as_expert
