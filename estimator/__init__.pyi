# The names of `estimator`, for type checkers and for its `__init__.py`, which fetches each when it is asked for.
from .belief import Belief
from .continuous import (
    CONTINUOUS_TWIN,
    ContinuousBelief,
    continuous_prior,
)
from .ensemble import NoiseRatio
from .gaussian import JointBelief
from .information import (
    cramer_rao,
    fisher_information,
    relative_covariance,
)
from .models.nlarx import NLARX
from .models.ode import DuffingODE
from .offline import PEMNARX
from .online import OnlineEstimator
from .parameters import (
    SAMPLING_STEP,
    SILVERBOX_TWIN,
    Coefficients,
    PhysicalParameters,
    to_coefficients,
    to_physical,
)
from .prior import Prior
from .saving import (
    load_estimator,
    save_estimator,
)

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
    "relative_covariance",
    "save_estimator",
    "to_coefficients",
    "to_physical",
]
