"""Online identification of a Duffing oscillator by free energy minimisation.

Useful alone, on any recorded input and output: it knows no environment and no policy.
"""

from estimator.belief import Belief, Prior
from estimator.continuous import CONTINUOUS_TWIN, ContinuousBelief, continuous_prior
from estimator.ensemble import NoiseRatio
from estimator.fisher import cramer_rao, fisher_information, ode_information, relative_covariance
from estimator.gaussian import JointBelief
from estimator.models.nlarx import NLARX
from estimator.models.ode import DuffingODE
from estimator.offline import PEMNARX
from estimator.online import OnlineEstimator
from estimator.parameters import (
    SAMPLING_STEP,
    SILVERBOX_TWIN,
    Coefficients,
    PhysicalParameters,
    to_coefficients,
    to_physical,
)
from estimator.saving import load_estimator, save_estimator

__all__ = [
    "CONTINUOUS_TWIN",
    "NLARX",
    "PEMNARX",
    "SAMPLING_STEP",
    "SILVERBOX_TWIN",
    "Belief",
    "Coefficients",
    "ContinuousBelief",
    "DuffingODE",
    "JointBelief",
    "NoiseRatio",
    "OnlineEstimator",
    "PhysicalParameters",
    "Prior",
    "continuous_prior",
    "cramer_rao",
    "fisher_information",
    "load_estimator",
    "ode_information",
    "relative_covariance",
    "save_estimator",
    "to_coefficients",
    "to_physical",
]
