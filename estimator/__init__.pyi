# The names of `estimator`, for type checkers and for `__init__.py`, which imports each on first use.
from .belief import Belief
from .identification import identify
from .identification.identification_result import Result
from .inference.fisher_information import cramer_rao, fisher_information, relative_covariance
from .inference.noise_grid import NoiseRatio
from .inference.noise_profile import profile_noises
from .inference.pem_narx import PEMNARX
from .models.difference_equation import difference
from .models.duffing import duffing
from .models.model import Model
from .models.named_parameters import Parameters
from .online import OnlineEstimator
from .priors import paper_text_prior, published_run_prior, recorded_prior, silverbox_prior, weak_prior
from .rigs.channel import Channel
from .rigs.physical_parameters import coefficients_of, to_physical
from .rigs.rig import Rig
from .rigs.silverbox_constants import SILVERBOX_ODE_TWIN, SILVERBOX_SAMPLING_STEP, SILVERBOX_TWIN
from .saving import load_estimator, save_estimator

__all__ = [
    "PEMNARX",
    "SILVERBOX_ODE_TWIN",
    "SILVERBOX_SAMPLING_STEP",
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
    "profile_noises",
    "published_run_prior",
    "recorded_prior",
    "relative_covariance",
    "save_estimator",
    "silverbox_prior",
    "to_physical",
    "weak_prior",
]
