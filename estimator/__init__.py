"""Online identification of a Duffing oscillator by free energy minimisation.

Useful alone, on any recorded input and output: it knows no environment and no policy.
"""

from estimator.belief import Belief, Prior
from estimator.models.nlarx import NLARX
from estimator.online import OnlineEstimator
from estimator.parameters import (
    SAMPLING_STEP,
    SILVERBOX_TWIN,
    Coefficients,
    PhysicalParameters,
    to_coefficients,
    to_physical,
)

__all__ = [
    "NLARX",
    "SAMPLING_STEP",
    "SILVERBOX_TWIN",
    "Belief",
    "Coefficients",
    "OnlineEstimator",
    "PhysicalParameters",
    "Prior",
    "to_coefficients",
    "to_physical",
]
