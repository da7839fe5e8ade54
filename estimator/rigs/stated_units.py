"""Models whose numbers are in stated units and seconds: the scaled model for a rig, and its prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief
from estimator.models.model import Model
from estimator.models.scaling import power_of_two, scale_model, state_sizes
from estimator.priors import gaussian_moments, weak_prior
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.rig import Rig
from estimator.rigs.units import Scales
from estimator.support.argument_checks import check_mapping, to_float_array

#: Standard deviation of a state about rest, in parts of its size.
_REST_STD = 1e-3


def model_near_one(
    model: Model,
    scales: Scales,
    mean: Mapping[str, float],
    channel_sizes: Mapping[str, float] | None = None,
    sizes: Mapping[str, float] | None = None,
) -> Model:
    """The model in numbers near one and in samples; its parameters are in the stated units.

    Args:
        model: the model, usually with time in seconds.
        scales: sampling step, and the sizes of the numbers of inputs and outputs that become 1.
        mean: parameter to a typical value, in its unit.
        channel_sizes: input or sensor to the size of its numbers, for the sizes of states; by default from ``scales``.
        sizes: state to its size; by default `estimator.models.scaling.state_sizes` finds it.

    Raises:
        ValueError: as `estimator.models.scaling.state_sizes`, or for a missing parameter.
    """
    channels = _channel_sizes(model, scales)
    of_states = state_sizes(Model.require_model(model), scales.step, channel_sizes or channels, sizes)
    first = scale_model(model, scales.step, channels | of_states)
    typical = np.abs(coefficients_of(first, mean, scales))
    of_coefficients = {
        c: power_of_two(size) if 1e-300 < size < 1e300 else 1.0
        for c, size in zip(model.coefficients, typical.tolist(), strict=True)
    }
    return scale_model(model, scales.step, channels | of_states | of_coefficients)


def prior_in_units(
    model: Model,
    rig: Rig,
    mean: Mapping[str, float],
    std: Mapping[str, float],
    *,
    process_noise: float,
    measurement_noise: float | Sequence[float],
    noise_shape: float = 2.0,
    state_std: Mapping[str, float] | None = None,
    sizes: Mapping[str, float] | None = None,
) -> Belief:
    """A prior in the stated units, with independent Gaussian parameters, weak noise priors and the plant near rest.

    ``OnlineEstimator(prior=prior, rig=rig)`` takes it; ``belief.parameters()`` is in the stated units again.

    Args:
        model: a model with time in seconds (``time="s"``).
        rig: sampling step; the input's limit and the output's range are the sizes of their numbers.
        mean: parameter (or coefficient, where the model has no parameters) to its mean, in its unit.
        std: parameter to its standard deviation, in its unit.
        process_noise: strength of the process noise at which its prior is centred. `Model.noise` times it is the root
            of a white intensity, in the unit of each state per root of a second.
        measurement_noise: standard deviation at which the prior of a sensor's noise is centred, in the sensor's unit;
            one number, or one for each sensor.
        noise_shape: see `estimator.priors.weak_prior`.
        state_std: state to its standard deviation about rest, in its unit; by default 1e-3 of its size.
        sizes: state to its size, in its unit, where the units do not say it
            (`estimator.models.scaling.state_sizes`). Sizes are rounded to powers of two, and hardly matter.

    Raises:
        ValueError: naming the argument, for a value out of its range, or an unknown or missing name.

    Example:
        >>> from estimator import Channel, Model, Rig
        >>> from estimator.rigs.stated_units import prior_in_units
        >>> shaker = Model(
        ...     "shaker", {"x": "m", "v": "m/s"}, {"m": "kg", "k": "N/m"}, noise=("0", "1/m"), outputs={"y": "x"},
        ...     rates=("v", "(u - k*x)/m"), inputs={"u": "N"}, time="s",
        ... )
        >>> rig = Rig(1e-4, input=Channel("N", limit=5), output=Channel("m", range=1e-4))
        >>> mean = {"m": 2e-3, "k": 4e4}
        >>> prior = prior_in_units(
        ...     shaker, rig, mean, {"m": 4e-4, "k": 8e3}, process_noise=1e-3, measurement_noise=1e-7
        ... )
        >>> [f"{name} = {mean:.3g} ± {std:.1g} {unit}" for name, (mean, std, unit) in prior.parameters().items()]
        ['m = 0.002 ± 0.0004 kg', 'k = 4e+04 ± 8e+03 N/m']
    """
    scales = rig.scales
    scaled = model_near_one(model, scales, mean, sizes=sizes)
    moments = gaussian_moments(scaled, mean, std, scales)
    channels = _channel_sizes(model, scales)
    found = state_sizes(model, scales.step, channels, sizes)
    check_mapping("state_std", state_std or {})
    unknown = sorted(set(state_std or {}) - set(found))
    if unknown:
        raise ValueError(f"state_std must be of {list(found)}, but has {unknown}; leave them out")
    states = [(state_std or {}).get(x, _REST_STD * size) / size for x, size in found.items()]
    sensors: npt.NDArray[np.float64] = to_float_array("measurement_noise", measurement_noise) / scales.output
    noises = process_noise / scales.output, sensors.tolist()
    return weak_prior(scaled, *moments, *noises, noise_shape, states, scales)


def _channel_sizes(model: Model, scales: Scales) -> dict[str, float]:
    """Input or sensor to the size of its numbers, in its unit."""
    of_inputs = zip(model.inputs, scales.input_scales(model.n_inputs).tolist(), strict=True)
    return dict(of_inputs) | dict.fromkeys(model.outputs, scales.output)
