"""rewardtogo: deep reinforcement learning on JAX, one API from CartPole to control as inference.

    import rewardtogo as rtg
    run = rtg.train("ppo", "CartPole-v1", steps=100_000, seed=0)
    policy = rtg.load(run.path)

Names are imported when they are first used, so that `import rewardtogo` alone does not load JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .actor_critic.asynchronous import Asynchronous as Asynchronous
    from .core import Algorithm as Algorithm
    from .core import Batch as Batch
    from .core import Configured as Configured
    from .core import Drawn as Drawn
    from .core import Environment as Environment
    from .core import EnvSpec as EnvSpec
    from .core import Learner as Learner
    from .core import Model as Model
    from .core import Policy as Policy
    from .core import Rollout as Rollout
    from .core import Solution as Solution
    from .core import Spec as Spec
    from .core import Timestep as Timestep
    from .core import Transition as Transition
    from .core import VectorEnv as VectorEnv
    from .core import number as number
    from .core import part as part
    from .core import setting as setting
    from .data.prioritised import PrioritisedReplay as PrioritisedReplay
    from .data.replay import Replay as Replay
    from .data.replay import UniformReplay as UniformReplay
    from .envs.gymnasium import EnvironmentFailure as EnvironmentFailure
    from .envs.gymnasium import GymnasiumEnv as GymnasiumEnv
    from .envs.registry import make as make
    from .envs.vectorize import vectorize as vectorize
    from .imitation.bc import BC as BC
    from .imitation.dagger import DAgger as DAgger
    from .imitation.experts import Fallible as Fallible
    from .imitation.experts import as_expert as as_expert
    from .loops.collect import collect as collect
    from .loops.off_policy import OffPolicy as OffPolicy
    from .loops.offline import Offline as Offline
    from .loops.on_policy import OnPolicy as OnPolicy
    from .model_based.e2c import E2C as E2C
    from .model_based.latent import LatentMBRL as LatentMBRL
    from .model_based.mbrl import ModelBased as ModelBased
    from .model_based.planet import PlaNet as PlaNet
    from .model_based.solar import SOLAR as SOLAR
    from .nn.autoregressive import Autoregressive as Autoregressive
    from .nn.entries import Entries as Entries
    from .nn.feature_points import FeaturePoints as FeaturePoints
    from .nn.heads import Standard as Standard
    from .nn.latent import Latent as Latent
    from .nn.mixture import Mixture as Mixture
    from .nn.network import CNN as CNN
    from .nn.network import MLP as MLP
    from .nn.recurrent import GRU as GRU
    from .nn.recurrent import LSTM as LSTM
    from .nn.stacked import Stacked as Stacked
    from .policy_gradient.npg import NPG as NPG
    from .policy_gradient.off_policy import OffPolicyPG as OffPolicyPG
    from .policy_gradient.ppo import PPO as PPO
    from .policy_gradient.trpo import TRPO as TRPO
    from .policy_gradient.vanilla import PolicyGradient as PolicyGradient
    from .runner.engine import Every as Every
    from .runner.engine import Moment as Moment
    from .runner.engine import NonFinite as NonFinite
    from .runner.engine import run as run
    from .runner.policy import load as load
    from .runner.threads import use_threads as use_threads
    from .runner.train import Run as Run
    from .runner.train import resume as resume
    from .runner.train import train as train
    from .value.cem_q import CEMQ as CEMQ
    from .value.ddpg import DDPG as DDPG
    from .value.dqn import DQN as DQN
    from .value.fvi import FVI as FVI
    from .value.maximisers import CEM as CEM
    from .value.maximisers import Ascent as Ascent
    from .value.maximisers import Sampled as Sampled
    from .value.naf import NAF as NAF
    from .value.noise import OU as OU
    from .value.noise import Gaussian as Gaussian
    from .value.outputs import C51 as C51
    from .value.outputs import Expectation as Expectation
    from .value.outputs import Quantiles as Quantiles
    from .value.sac import SAC as SAC
    from .value.tabular_q import QLearning as QLearning
    from .value.td3 import TD3 as TD3

_HOMES = {
    "actor_critic.asynchronous": "Asynchronous",
    "core": "Algorithm Batch Configured Drawn Environment EnvSpec Learner Model Policy Rollout Solution Spec Timestep Transition "
    "VectorEnv number part setting",
    "data.prioritised": "PrioritisedReplay",
    "data.replay": "Replay UniformReplay",
    "envs.gymnasium": "EnvironmentFailure GymnasiumEnv",
    "envs.registry": "make",
    "envs.vectorize": "vectorize",
    "imitation.bc": "BC",
    "imitation.dagger": "DAgger",
    "imitation.experts": "Fallible as_expert",
    "loops.collect": "collect",
    "loops.off_policy": "OffPolicy",
    "loops.offline": "Offline",
    "loops.on_policy": "OnPolicy",
    "model_based.e2c": "E2C",
    "model_based.latent": "LatentMBRL",
    "model_based.mbrl": "ModelBased",
    "model_based.planet": "PlaNet",
    "model_based.solar": "SOLAR",
    "nn.autoregressive": "Autoregressive",
    "nn.entries": "Entries",
    "nn.feature_points": "FeaturePoints",
    "nn.heads": "Standard",
    "nn.latent": "Latent",
    "nn.mixture": "Mixture",
    "nn.network": "CNN MLP",
    "nn.recurrent": "GRU LSTM",
    "nn.stacked": "Stacked",
    "policy_gradient.npg": "NPG",
    "policy_gradient.off_policy": "OffPolicyPG",
    "policy_gradient.ppo": "PPO",
    "policy_gradient.trpo": "TRPO",
    "policy_gradient.vanilla": "PolicyGradient",
    "runner.engine": "Every Moment NonFinite run",
    "runner.policy": "load",
    "runner.threads": "use_threads",
    "runner.train": "Run resume train",
    "value.cem_q": "CEMQ",
    "value.ddpg": "DDPG",
    "value.dqn": "DQN",
    "value.fvi": "FVI",
    "value.maximisers": "Ascent CEM Sampled",
    "value.naf": "NAF",
    "value.noise": "Gaussian OU",
    "value.outputs": "C51 Expectation Quantiles",
    "value.sac": "SAC",
    "value.td3": "TD3",
    "value.tabular_q": "QLearning",
}
_HOME = {name: home for home, names in _HOMES.items() for name in names.split()}
_ROOMS = (
    "actor_critic",
    "core",
    "data",
    "envs",
    "exact",
    "figures",
    "imitation",
    "label",
    "loops",
    "model_based",
    "nn",
    "ops",
    "planning",
    "policy_gradient",
    "runner",
    "value",
)

__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    if name in _ROOMS:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, *_ROOMS]
