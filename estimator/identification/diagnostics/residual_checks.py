"""Checks of the forecast errors: whether the standardised innovations are white and normal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.identification.data.record import Record
from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.likelihood.problem_signals import mask_unexplained_outputs
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.support.array_types import FloatArray


def standardised_innovations(y: FloatArray, forecast: FloatArray) -> FloatArray:
    """(n,) standardised innovations of the outputs that are not missing.

    Args:
        y: (T,) outputs; NaN where one is missing.
        forecast: (T, 2) mean and variance of each, one sample ahead.
    """
    with np.errstate(invalid="ignore"):
        values = (y - forecast[:, 0]) / np.sqrt(forecast[:, 1])
    return values[np.isfinite(values)]


#: Probability of a false alarm in each test of the residuals.
_FALSE_ALARM_PROBABILITY = 1e-4


def check_residuals(
    problem: ScaledRecords, records: Sequence[Record], forecasts: Sequence[FloatArray]
) -> list[CheckFinding]:
    """Findings about forecast errors that are not white or not normal.

    Args:
        problem: the records, scaled.
        records: the records as they were read.
        forecasts: per record, (T, 2) mean and variance of each output, one sample ahead.
    """
    from statistics import NormalDist

    residuals_of_records = [
        standardised_innovations(mask_unexplained_outputs(one.y, problem.rig), forecast)[4:]
        for one, forecast in zip(records, forecasts, strict=True)
    ]
    values = np.concatenate(residuals_of_records)
    n, warnings = len(values), list[CheckFinding]()
    if n < 100:
        return warnings
    lags, most = 20, 52.386  # chi2.isf(1e-4, 20); SciPy's statistics take longer to import than this function to run
    products = [
        sum(float(one[k:] @ one[: len(one) - k]) for one in residuals_of_records if len(one) > k)
        for k in range(lags + 1)
    ]
    statistic = n * sum((products[k] / products[0]) ** 2 for k in range(1, lags + 1))
    if statistic > most:
        message = (
            "the forecast errors are correlated, not white: the equation, the interpolation of the input or the noise "
            "is not as assumed"
        )
        warnings.append(CheckFinding("residuals_not_white", message))
    centred = (values - values.mean()) / values.std()
    kurtosis = (np.mean(centred**4) - 3) * np.sqrt(n / 24)
    if abs(kurtosis) > 6.0 or np.abs(centred).max() > -NormalDist().inv_cdf(_FALSE_ALARM_PROBABILITY / n / 2):
        message = "the forecast errors are not normal: the output has outliers, or the noise varies in time"
        warnings.append(CheckFinding("residuals_not_normal", message))
    return warnings
