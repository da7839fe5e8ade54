"""The conditionally linear stochastic pendulum of IO-SMC² (Iqbal et al., ICML 2024): q'' = -p1 sin q - p2 q' + p3 u.

The published plant takes steps of Euler's rule, under which an oscillation grows without input, here by 1.8 % per
sample. `PENDULUM_EULER` is this plant; `PENDULUM` is the differential equation.
"""

from __future__ import annotations

from dataclasses import replace

from estimator.models.model import Model

#: Sampling step [s].
PENDULUM_SAMPLING_STEP = 0.05

#: The pendulum as a differential equation, with sensors of both states. Time counts samples, so that the angular
#: velocity w is in rad per sample, and the coefficients are p1 δ², p2 δ and p3 δ². Process noise of unit strength moves
#: q by 1 within a sample.
PENDULUM = Model(
    name="pendulum",
    states={"q": "rad", "w": "rad"},
    coefficients={"gravity": "1", "friction": "1", "torque": "1"},
    rates=("w", "torque*u - friction*w - gravity*sin(q)"),
    noise=("0", "sqrt(3)"),
    outputs={"angle": "q", "velocity": "w"},
    substeps=2,
    physical={"p1": "gravity/step**2", "p2": "friction/step", "p3": "torque/step**2"},
    dimensions={"p1": (0, 0, -2), "p2": (0, 0, -1), "p3": (-1, 1, -2)},
    inverse={"gravity": "p1*step**2", "friction": "p2*step", "torque": "p3*step**2"},
)

#: The pendulum by Euler's rule. Process noise of unit strength moves w by 1 rad per sample, and thereby the angle of
#: the next sample. The first sensor measures that angle, because the present angle does not contain the present noise.
PENDULUM_EULER = replace(
    PENDULUM,
    name="pendulum_map",
    rates=(),
    next_state=("q + w", "w + torque*u - friction*w - gravity*sin(q)"),
    noise=("0", "1"),
    outputs={"ahead": "q + w", "velocity": "w"},
    substeps=1,
)
