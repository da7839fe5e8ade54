"""The report of an identification: one HTML page with parameters, fits, residuals and checks, readable offline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from estimator.identification.data.record import Record
from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.fitting.posterior_belief import ContractionHistory
from estimator.identification.report_figures import MAX_SHOWN_SAMPLES, draw_contraction, draw_fit, draw_residuals
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT
from estimator.rigs.units import format_interval
from estimator.support.array_types import FloatArray
from estimator.support.file_io import write_atomically
from estimator.support.html_page import figure_to_svg, html_document, html_table

_PARAMETER_MEANINGS = {
    "m": "mass",
    "c/m": "damping by mass",
    "a/m": "linear stiffness by mass",
    "b/m": "cubic stiffness by mass",
    "c": "damping",
    "a": "linear stiffness",
    "b": "cubic stiffness",
    "u0": "offset of the input",
    "y0": "offset of the output",
}

_CONTRACTION_CAPTION = (
    "The uncertainty that remains after the first outputs of the records. An interval narrows with the square root of "
    "their number, and faster at first. Where it does not narrow, choose an input that excites this parameter."
)
_FIT_CAPTION = (
    "The free run starts from 20 outputs and continues with the input alone: it errs where parameters are wrong, and "
    "where the force is disturbed. The forecast uses every output before its own: 90 % of its errors lie in the band "
    "if the intervals are right."
)
_RESIDUALS_CAPTION = (
    "The errors of the forecasts in standard deviations. They are normal and white where equation, input and noise are "
    "as assumed."
)


@dataclass(frozen=True)
class ReportContent:
    """The content of a report.

    Attributes:
        rig: the rig of the records.
        parameters: parameter to mean and standard deviation.
        intervals: parameter to its 90 % interval.
        units: parameter to its unit.
        unidentified: parameters that the records do not identify.
        noises: ``input`` and ``output`` to mean and standard deviation of the noise.
        warnings: the findings of the checks.
        records: the records, cleaned.
        forecasts: per record, (T, 2) mean and variance of each output, one sample ahead.
        free_runs: per record, the same after the first `estimator.identification.report_figures.FREE_RUN_OUTPUTS`.
        history: parameters that the first outputs leave, for growing numbers of outputs.
    """

    rig: Rig
    parameters: Mapping[str, tuple[float, float]]
    intervals: Mapping[str, tuple[float, float]]
    units: Mapping[str, str]
    unidentified: Sequence[str]
    noises: Mapping[str, tuple[float, float]]
    warnings: Sequence[CheckFinding]
    records: Sequence[Record]
    forecasts: Sequence[FloatArray]
    free_runs: Sequence[FloatArray]
    history: ContractionHistory


def write_report(content: ReportContent, path: Path, commands: Sequence[str] = ()) -> Path:
    """Write the page, and return its path; see `estimator.identification.identification_result.Result.report`."""
    parts = ["<h1>Identification</h1>", _checks_html(content.warnings), _parameters_html(content)]
    contraction = figure_to_svg(draw_contraction(content.history, content.parameters))
    parts.append("<h2>Intervals over the number of outputs</h2>")
    parts.append(_figure_html(contraction, _CONTRACTION_CAPTION))
    for record, forecast, free_run in zip(content.records, content.forecasts, content.free_runs, strict=True):
        parts.append(f"<h2>{escape(record.name)}</h2>{_record_summary(record, content.rig.step)}")
        parts.append(_figure_html(figure_to_svg(draw_fit(content.rig, record, forecast, free_run)), _FIT_CAPTION))
        parts.append(_figure_html(figure_to_svg(draw_residuals(record, forecast)), _RESIDUALS_CAPTION))
    if commands:
        parts.append(f"<h2>How this page was made</h2><pre>{escape(chr(10).join(commands))}</pre>")
    write_atomically(path, html_document("Identification", parts))
    return path


def _figure_html(svg: str, caption: str) -> str:
    return f"<figure>{svg}<figcaption>{caption}</figcaption></figure>"


def _checks_html(warnings: Sequence[CheckFinding]) -> str:
    if not warnings:
        return "<p class='fine'>No check speaks against this result.</p>"
    return "".join(
        f"<p class='warning'><b>{escape(warning.name)}</b>: {escape(warning.message)}</p>" for warning in warnings
    )


def _parameters_html(content: ReportContent) -> str:
    rows = []
    for name, (mean, std) in content.parameters.items():
        low, high = content.intervals[name]
        mean_text, low_text, high_text = format_interval(mean, low, high, 6)
        mean_text = "open" if name in content.unidentified else mean_text
        interval = f"{low_text} to {high_text}"
        label = f"{name}, {_PARAMETER_MEANINGS[name]}"
        rows.append([label, mean_text, f"{std:.2g}", interval, escape(content.units[name])])
    channels = (
        ("input", "disturbance of the force", content.rig.only_input),
        ("output", "noise of the sensor", content.rig.output),
    )
    for name, label, channel in channels:
        mean, std = content.noises[name]
        half_width = STDS_PER_90_PERCENT * std
        mean_text, low_text, high_text = format_interval(mean, max(mean - half_width, 0.0), mean + half_width, 3)
        rows.append([label, mean_text, f"{std:.1g}", f"{low_text} to {high_text}", escape(channel.unit)])
    equation = "<p>m x'' + c x' + a x + b x³ = u - u0 + w, observed with the offset y0 and noise.</p>"
    headings = ["", "mean", "standard deviation", "90 % interval", "unit"]
    return f"<h2>Parameters</h2>{equation}{html_table(headings, rows)}"


def _record_summary(record: Record, step: float) -> str:
    n_samples = len(record.u)
    facts = [f"{n_samples} samples in {n_samples * step:.4g} s"]
    counts = ((record.n_missing, "missing"), (record.n_clipped, "clipped"))
    facts += [f"{count} outputs {label}" for count, label in counts if count]
    shown = f"; the figures show the first {MAX_SHOWN_SAMPLES}" if n_samples > MAX_SHOWN_SAMPLES else ""
    return f"<p>{', '.join(facts)}{shown}.</p>"
