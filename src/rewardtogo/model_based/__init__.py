"""Reinforcement learning with learned models (chapter 8, section 8.3)."""

from .ensembles import Ensemble as Ensemble
from .ensembles import LearnedModel as LearnedModel
from .ensembles import Prediction as Prediction
from .latent import LatentMBRL as LatentMBRL
from .latent import LatentModel as LatentModel
from .latent_linear import fit_linear_gaussian as fit_linear_gaussian
from .mbrl import ModelBased as ModelBased
from .planet import PlaNet as PlaNet
