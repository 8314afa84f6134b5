"""Loops: they make a `Learner` an `Algorithm`."""

from .collect import RandomPolicy as RandomPolicy
from .collect import begin as begin
from .collect import collect as collect
from .devices import shard as shard
from .off_policy import OffPolicy as OffPolicy
from .offline import Offline as Offline
from .on_policy import OnPolicy as OnPolicy
