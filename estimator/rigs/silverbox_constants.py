"""Constants of the Silverbox benchmark circuit: its sampling step and its identified parameters, in volts."""

from __future__ import annotations

from estimator.models.named_parameters import Parameters

#: Sampling step of the Silverbox record [s]; its sampling rate is 610.35 Hz.
SILVERBOX_SAMPLING_STEP = 2**14 / 1e7

#: Parameters of the Silverbox by the difference equation: m [s²], c [s], a [1] and b [V⁻²] of Eq. (1), as
#: ``python -m duffing_env.plants.silverbox_twin`` identifies them.
SILVERBOX_TWIN = Parameters(m=6.4568e-6, c=2.5717e-4, a=1.1747, b=3.7672)

#: Input gain of the Silverbox by the differential equation, 1/m [s⁻²].
_SILVERBOX_GAIN = 186_015.0

#: Parameters of the Silverbox by the differential equation, in the same units.
SILVERBOX_ODE_TWIN = Parameters(
    m=1 / _SILVERBOX_GAIN, c=41.8992 / _SILVERBOX_GAIN, a=184_255.0 / _SILVERBOX_GAIN, b=730_155.0 / _SILVERBOX_GAIN
)
