"""Reinforcement learning with learned models (chapter 8, section 8.3)."""

from .ensembles import Ensemble as Ensemble
from .ensembles import LearnedModel as LearnedModel
from .ensembles import Prediction as Prediction
from .mbrl import ModelBased as ModelBased
