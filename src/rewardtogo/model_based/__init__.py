"""Reinforcement learning with learned models (chapter 8, section 8.3)."""

from .e2c import E2C as E2C
from .ensembles import Ensemble as Ensemble
from .ensembles import Prediction as Prediction
from .ensembles import aleatoric as aleatoric
from .ensembles import epistemic as epistemic
from .ensembles import output_entropy as output_entropy
from .ensembles import total_variance as total_variance
from .fit import Regression as Regression
from .fit import fit as fit
from .fit import fit_model as fit_model
from .latent import LatentMBRL as LatentMBRL
from .latent import LatentModel as LatentModel
from .latent_linear import fit_linear_gaussian as fit_linear_gaussian
from .learned import LearnedModel as LearnedModel
from .learned import Objective as Objective
from .mbrl import ModelBased as ModelBased
from .planet import PlaNet as PlaNet
from .posteriors import Bootstrap as Bootstrap
from .posteriors import Dropout as Dropout
from .posteriors import MeanField as MeanField
from .posteriors import Posterior as Posterior
from .solar import SOLAR as SOLAR
