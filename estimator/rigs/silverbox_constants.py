"""Constants of the Silverbox benchmark circuit: its sampling step and its identified parameters, in volts."""

from __future__ import annotations

from estimator.models.named_parameters import Parameters

#: Time between two samples of the Silverbox record [s]: 610.35 Hz.
SILVERBOX_SAMPLING_STEP = 2**14 / 1e7

#: The Silverbox circuit as the difference equation sees it, m [s²], c [s], a [1] and b [V⁻²] of Eq. (1)
#: (``python -m duffing_env.plants.silverbox_twin`` identifies it).
SILVERBOX_TWIN = Parameters(m=6.4568e-6, c=2.5717e-4, a=1.1747, b=3.7672)

_SILVERBOX_GAIN = 186_015.0  # s⁻²

#: The same as the differential equation sees it.
SILVERBOX_ODE_TWIN = Parameters(
    m=1 / _SILVERBOX_GAIN, c=41.8992 / _SILVERBOX_GAIN, a=184_255.0 / _SILVERBOX_GAIN, b=730_155.0 / _SILVERBOX_GAIN
)
