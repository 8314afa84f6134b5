"""Environments: compiled twins of Gymnasium's, tabular problems, probes, wrappers, and the door to every other one."""

from .acrobot import Acrobot as Acrobot
from .cartpole import CartPole as CartPole
from .check import check_env as check_env
from .gymnasium import EnvironmentFailure as EnvironmentFailure
from .gymnasium import GymnasiumEnv as GymnasiumEnv
from .mountain_car import MountainCar as MountainCar
from .mountain_car import MountainCarContinuous as MountainCarContinuous
from .pendulum import Pendulum as Pendulum
from .registry import make as make
from .reward_wrappers import NormalizeReward as NormalizeReward
from .reward_wrappers import RewardFunction as RewardFunction
from .reward_wrappers import ScaleReward as ScaleReward
from .tabular import MDP as MDP
from .tabular import POMDP as POMDP
from .tabular import TabularEnv as TabularEnv
from .tabular import TabularModel as TabularModel
from .time_limit import TimeLimit as TimeLimit
from .vectorize import Vectorized as Vectorized
from .vectorize import vectorize as vectorize
from .wrappers import ClipAction as ClipAction
from .wrappers import DelayObservation as DelayObservation
from .wrappers import FrameStack as FrameStack
from .wrappers import MaskObservation as MaskObservation
from .wrappers import NoisyObservation as NoisyObservation
from .wrappers import RescaleAction as RescaleAction
