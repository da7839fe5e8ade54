"""Timing of the compiled components of a step: the plant alone, and the estimator alone.

They are the functions that the environment's kernel calls, on blocks of the same kind, called once per sample from
Python.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.kernel_stages.generated_environment_functions import generated_functions
from duffing_env.kernel_stages.plant_stages import compile_noise_draw
from duffing_env.storage.kernel_spec import block_layout, noise_std_rows
from duffing_env.storage.random_streams import new_stream_words
from estimator.compilation.simd import LANES, kernel
from estimator.engine.kernels import compile_belief_update
from estimator.inference import mean_field
from estimator.rigs.physical_parameters import coefficients_of
from estimator.support.array_types import FloatArray

#: Standard deviation of both noises [V].
NOISE = 5e-4

#: Samples of a record.
SAMPLES = 256


def experiment_of(factorisation: str) -> SimulatedExperiment:
    """An experiment whose systems all are the twin."""
    return SimulatedExperiment(factorisation, plant_spread=0.0, process_noise=NOISE, measurement_noise=NOISE)


_EXPERIMENT = experiment_of("structured")
_PLACE = block_layout(_EXPERIMENT.kernel_spec)


@cache
def plant_mover() -> Any:
    """``move_all(blocks, inputs)``: move the plants of all blocks by one sample, noise drawn within."""
    draw_noise, plant = compile_noise_draw(_PLACE), generated_functions(_EXPERIMENT.kernel_spec).step_plant
    u = _PLACE["U_u_0"] * LANES

    @kernel(variant=_EXPERIMENT.kernel_spec.name)
    def move_all(blocks, inputs):
        for b in range(len(blocks)):
            W = blocks[b]
            for j in range(LANES):
                W[u + j] = inputs[b * LANES + j]
            draw_noise(W)
            plant(W)

    return move_all


@cache
def updater(factorisation: str, iterations: int) -> Any:
    """``infer_all(blocks, inputs, outputs)``, one sample for the beliefs of all blocks, and the rows of a block."""
    is_structured, model = factorisation == "structured", _EXPERIMENT.model
    if is_structured:
        task = compile_belief_update(model, iterations=iterations)
        update, place = task.update, task.layout
    else:
        place = mean_field.mean_field_layout()
        update = mean_field.compile_mean_field_update(place)
    u, y = place["U_u_0"] * LANES, place["Y_y"] * LANES

    @kernel(variant=f"{model.digest}_{factorisation}_{iterations}")
    def infer_all(blocks, inputs, outputs):
        for b in range(len(blocks)):
            W = blocks[b]
            for j in range(LANES):
                W[u + j] = inputs[b * LANES + j]
                W[y + j] = outputs[b * LANES + j]
            if is_structured:
                update(W)
            else:
                update(W, iterations, False)

    return infer_all, place


@dataclass(frozen=True)
class Data:
    """Inputs and outputs (SAMPLES, n) [V] of n twins under uniform inputs, n a multiple of `LANES`."""

    inputs: FloatArray
    outputs: FloatArray


def plants(num_envs: int, factorisation: str = "structured") -> npt.NDArray[np.float64]:
    """Blocks of twins at rest, (n_blocks, rows * LANES), with streams of random numbers and beliefs at the prior."""
    experiment = experiment_of(factorisation)
    place, prior = block_layout(experiment.kernel_spec), experiment.prior_belief.record
    n_blocks = -(-num_envs // LANES)
    blocks = np.zeros((n_blocks, max(place.values()) + 1, LANES))
    coefficients = coefficients_of(experiment.plant, experiment.nominal_parameters, experiment.scales)
    truth = {f"TRUE_{name}": value for name, value in zip(experiment.plant.coefficients, coefficients, strict=True)}
    truth |= {f"PARAM_{name}": value for name, value in experiment.nominal_parameters.items()}
    truth |= dict.fromkeys(noise_std_rows(experiment.plant).values(), NOISE)
    for name, value in truth.items():
        blocks[:, place[name]] = value
    first = place["SFC64_a"]
    rng = np.random.default_rng(0)
    words = np.stack([new_stream_words(rng) for _ in range(LANES)], axis=-1)
    # Copies of a few streams do: nothing here depends on their independence.
    blocks[:, first : first + 4] = words
    blocks[:, : len(prior)] = prior[:, None]
    return blocks.reshape(n_blocks, -1)


def play(num_envs: int) -> Data:
    """Let the plants run, to have something to infer from."""
    blocks, move_all = plants(num_envs), plant_mover()
    inputs = np.random.default_rng(1).uniform(-0.15, 0.15, (SAMPLES, len(blocks) * LANES))
    outputs = np.empty_like(inputs)
    for t in range(SAMPLES):
        move_all(blocks, inputs[t])
        outputs[t] = blocks.reshape(len(blocks), -1, LANES)[:, _PLACE["Y_y"]].reshape(-1)
    return Data(inputs, outputs)


def plant_only(num_envs: int, data: Data) -> Callable[[int], None]:
    """The plants alone: ``step(t)`` moves them by the t-th sample, in one call."""
    blocks, move_all = plants(num_envs), plant_mover()
    return lambda t: move_all(blocks, data.inputs[t % SAMPLES])


class EstimatorOnly:
    """The estimators alone, on data that lie ready; every `SAMPLES` samples they begin again at the prior."""

    def __init__(self, data: Data, factorisation: str, iterations: int) -> None:
        self._data = data
        self._infer, place = updater(factorisation, iterations)
        self._prior = np.repeat(experiment_of(factorisation).prior_belief.record, LANES)
        self._blocks = np.zeros((data.inputs.shape[1] // LANES, len(place) * LANES))

    def step(self, t: int) -> None:
        """Update with the t-th sample."""
        if t % SAMPLES == 0:
            self._blocks[:, : len(self._prior)] = self._prior
        self._infer(self._blocks, self._data.inputs[t % SAMPLES], self._data.outputs[t % SAMPLES])

    def records(self) -> FloatArray:
        """(n, size) the beliefs, as flat records; a copy."""
        size = len(self._prior) // LANES
        blocks = self._blocks.reshape(len(self._blocks), -1, LANES)[:, :size]
        return blocks.swapaxes(1, 2).reshape(-1, size)
