# The names of `estimator`, for type checkers and for its `__init__.py`, which fetches each when it is asked for.
from .belief import Belief
from .ensemble import NoiseRatio
from .identification import identify
from .identification.result import Result
from .information import cramer_rao, fisher_information, relative_covariance
from .models.difference import difference
from .models.duffing import duffing
from .models.model import Model
from .offline import PEMNARX
from .online import OnlineEstimator
from .parameters import CONTINUOUS_TWIN, SAMPLING_STEP, SILVERBOX_TWIN, Parameters
from .physical import coefficients_of, to_physical
from .priors import paper_text_prior, published_run_prior, recorded_prior, silverbox_prior, weak_prior
from .rig import Channel, Rig
from .saving import load_estimator, save_estimator

__all__ = [
    "CONTINUOUS_TWIN",
    "PEMNARX",
    "SAMPLING_STEP",
    "SILVERBOX_TWIN",
    "Belief",
    "Channel",
    "Model",
    "NoiseRatio",
    "OnlineEstimator",
    "Parameters",
    "Result",
    "Rig",
    "coefficients_of",
    "cramer_rao",
    "difference",
    "duffing",
    "fisher_information",
    "identify",
    "load_estimator",
    "paper_text_prior",
    "published_run_prior",
    "recorded_prior",
    "relative_covariance",
    "save_estimator",
    "silverbox_prior",
    "to_physical",
    "weak_prior",
]
