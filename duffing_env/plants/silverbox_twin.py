"""Identifies the twin of the Silverbox circuit: the Duffing oscillator that fits its record best.

Run ``python -m duffing_env.plants.silverbox_twin`` with the record at hand to print the constants of
`estimator.rigs.silverbox_constants.SILVERBOX_TWIN` and of `estimator.rigs.silverbox_constants.SILVERBOX_ODE_TWIN`.
"""

from __future__ import annotations

import numpy as np

from duffing_env.plants.silverbox_record import SilverboxRecord, load_record
from estimator import OnlineEstimator, Rig, difference, duffing
from estimator.models.named_parameters import Parameters
from estimator.rigs.physical_parameters import to_physical


def identify_difference_twin(record: SilverboxRecord) -> tuple[Parameters, float]:
    """Least squares of Eq. (2) with input delay 1 on the record's multisine part.

    Returns:
        The parameters (m, c, a, b), and the root mean square of the one-step residual [V].
    """
    u, y = record.multisine.u, record.multisine.y
    regressors = np.column_stack([y[1:-1], y[1:-1] ** 3, y[:-2], u[1:-1]])
    coefficients, squares, *_ = np.linalg.lstsq(regressors, y[2:], rcond=None)
    parameters = Parameters(
        zip("mcab", to_physical(difference(), np.asarray(coefficients, dtype=np.float64)).tolist(), strict=True)
    )
    return parameters, float(np.sqrt(squares[0] / len(regressors)))


def identify_continuous_twin(record: SilverboxRecord) -> Parameters:
    """The parameters (m, c, a, b) of the differential equation, from the record's multisine part.

    The model is `duffing` with a spline through all inputs. Its offsets and feedthrough are identified too, but left
    out: they belong to the circuit and the sensor, not to the oscillator.
    """
    model = duffing(offsets=True, feedthrough=True, noise="held")
    estimator = OnlineEstimator(model, rig=Rig.silverbox("spline"))
    estimator.run(record.multisine.u, record.multisine.y)
    found = estimator.belief.parameters()
    return Parameters({name: found[name][0] for name in "mcab"})


def main() -> None:
    """Print both twins."""
    twin, residual = identify_difference_twin(load_record())
    print(f"m = {twin.m:.4e} s², c = {twin.c:.4e} s, a = {twin.a:.4f}, b = {twin.b:.4f} V⁻²")
    print(f"one-step residual {1e3 * residual:.3f} mV root mean square")
    m, c, a, b = identify_continuous_twin(load_record()).values()
    print(f"1/m = {1 / m:.6g} s⁻², c/m = {c / m:.6g} s⁻¹, a/m = {a / m:.6g} s⁻², b/m = {b / m:.6g} s⁻² V⁻²")


if __name__ == "__main__":
    main()
