"""All checks of an identification: faults that show in the records and make its intervals wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.belief import Belief
from estimator.identification.data.record import Record
from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.diagnostics.equation_checks import (
    check_asymmetry,
    check_input_lag,
    check_missing_terms,
    check_process_noise,
    check_signs,
    check_trigger_offset,
    search_failed_finding,
)
from estimator.identification.diagnostics.guess_checks import (
    check_guess,
    fit_without_guess,
    guess_conflict_findings,
    is_shifted_by_guess,
)
from estimator.identification.diagnostics.identifiability_checks import check_identifiability
from estimator.identification.diagnostics.input_timing_checks import MIN_EVIDENCE, check_input_path
from estimator.identification.diagnostics.record_checks import check_records
from estimator.identification.diagnostics.residual_checks import check_residuals
from estimator.identification.fitting.ridge_posterior import RidgePosterior
from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.support.array_types import FloatArray

#: Relative forecast error below which no check of the noise runs: a simulated record without noise leaves the errors
#: of the integration alone.
_MIN_JUDGED_ERROR = 1e-6


def run_all_checks(
    problem: ScaledRecords,
    search_result: SearchResult,
    ridges: RidgePosterior | None,
    belief: Belief,
    parameters: dict[str, tuple[float, float]],
    disturbance: tuple[float, float],
    records: Sequence[Record],
    forecasts: Sequence[FloatArray],
) -> tuple[CheckFinding, ...]:
    """Run all checks.

    Args:
        problem: the records, scaled.
        search_result: the result of the search.
        ridges: ridges of a posterior that is no Gaussian; None of a Gaussian.
        belief: the posterior.
        parameters: parameter to mean and standard deviation, in the rig's units.
        disturbance: mean and standard deviation of the force's disturbance, which is a standard deviation per sample in
            the unit of the input.
        records: the records as they were read.
        forecasts: per record, (T, 2) mean and variance of each output, one sample ahead.
    """
    if problem.is_free_decay:  # without an input, and with m = 1 by definition
        return (
            *check_records(problem, records),
            *check_missing_terms(problem, search_result),
            *check_identifiability(problem, search_result, None, parameters),
            *check_residuals(problem, records, forecasts),
        )
    guess, kind = problem.rig.guess, problem.rig.output.kind
    record_findings = check_records(problem, records)
    has_noise = _expected_forecast_error(records, forecasts) > _MIN_JUDGED_ERROR
    input_path_findings = check_input_path(problem, search_result) if has_noise else []
    if not input_path_findings and (search_result.has_failed or check_process_noise(problem, disturbance)):
        input_path_findings = check_trigger_offset(problem)
    if search_result.has_failed and not input_path_findings:  # the other checks would name the equation
        return (*record_findings, search_failed_finding(search_result))
    fit_findings = [
        *(input_path_findings or (check_missing_terms(problem, search_result) if has_noise else [])),
        *check_process_noise(problem, disturbance),
        *check_signs(parameters),
        *check_asymmetry(problem, belief),
        *check_input_lag(problem, parameters),
        *check_identifiability(problem, search_result, ridges, parameters),
        *([] if guess is None else check_guess(guess, parameters, kind)),
        *(check_residuals(problem, records, forecasts) if has_noise else []),
    ]
    if guess is not None and fit_findings:
        alone, gain = fit_without_guess(problem, search_result)
        if gain > MIN_EVIDENCE and is_shifted_by_guess(guess, parameters, alone):
            # The other findings judge a fit that the guess has spoilt.
            conflicts = guess_conflict_findings(guess, parameters, alone, gain, kind)
            return (*record_findings, *check_signs(alone), *conflicts)
    return (*record_findings, *fit_findings)


def _expected_forecast_error(records: Sequence[Record], forecasts: Sequence[FloatArray]) -> float:
    """Median standard deviation of the forecasts, relative to the standard deviation of the outputs."""
    variances = np.concatenate(
        [forecast[np.isfinite(one.y), 1] for one, forecast in zip(records, forecasts, strict=True)]
    )
    outputs = np.concatenate([one.y for one in records])
    return float(np.sqrt(np.nanmedian(variances)) / np.nanstd(outputs))
