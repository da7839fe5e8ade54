"""The compiled pieces of a step, called apart: the plant alone, and the estimator alone.

They are the functions that the environment's kernel calls, over blocks of the same kind, once per sample from Python.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from duffing_env.plant import draw_noise, move_plant

from duffing_env.layout import LAYOUT, N_ROWS
from duffing_env.noise import stream_words
from estimator import SILVERBOX_TWIN, Prior, to_coefficients
from estimator.inference import update
from estimator.lanes import LANES, jit, kernel
from estimator.parameters import FloatArray
from estimator.record import N_ROWS as N_BELIEF_ROWS
from estimator.record import RECORD_SIZE

NOISE = 5e-4
SAMPLES = 256

_U, _Y = LAYOUT["u"] * LANES, LAYOUT["y"] * LANES


# Not cached on disk: the cache's stamp does not know the sources of duffing_env (see `estimator.lanes.kernel`).
@jit
def move_all(blocks, inputs, noise):
    """Move the plants of all blocks by one sample, noise drawn within: inputs (n,)."""
    for b in range(len(blocks)):
        W = blocks[b]
        for j in range(LANES):
            W[_U + j] = inputs[b * LANES + j]
        draw_noise(W)
        move_plant(W, noise, noise)


@kernel
def infer_all(blocks, inputs, outputs, structured, iterations):
    """Update the beliefs of all blocks with one sample each: inputs and outputs (n,)."""
    for b in range(len(blocks)):
        W = blocks[b]
        for j in range(LANES):
            W[_U + j] = inputs[b * LANES + j]
            W[_Y + j] = outputs[b * LANES + j]
        update(W, structured, iterations, False, W[:0])


@dataclass(frozen=True)
class Data:
    """Inputs and outputs (SAMPLES, n) [V] of n twins under uniform inputs, n a multiple of `LANES`."""

    inputs: FloatArray
    outputs: FloatArray


def plants(num_envs: int) -> npt.NDArray[np.float64]:
    """Blocks of twins at rest, (n_blocks, N_ROWS * LANES), with streams of random numbers and beliefs at the prior."""
    n_blocks = -(-num_envs // LANES)
    blocks = np.zeros((n_blocks, N_ROWS, LANES))
    truth = to_coefficients(SILVERBOX_TWIN)
    for name, value in zip(
        ("true_t1", "true_t2", "true_t3", "true_e"), (truth.theta1, truth.theta2, truth.theta3, truth.eta), strict=True
    ):
        blocks[:, LAYOUT[name]] = value
    first = LAYOUT["stream_a"]
    rng = np.random.default_rng(0)
    words = np.stack([stream_words(rng) for _ in range(LANES)], axis=-1)
    # Copies of a few streams do: nothing here depends on their independence.
    blocks[:, first : first + 4] = words
    blocks[:, :RECORD_SIZE] = Prior.silverbox_twin().to_record()[:, None]
    return blocks.reshape(n_blocks, -1)


def play(num_envs: int) -> Data:
    """Let the plants run, to have something to infer from."""
    blocks = plants(num_envs)
    inputs = np.random.default_rng(1).uniform(-0.15, 0.15, (SAMPLES, len(blocks) * LANES))
    outputs = np.empty_like(inputs)
    for t in range(SAMPLES):
        move_all(blocks, inputs[t], NOISE)
        outputs[t] = blocks.reshape(-1, N_ROWS, LANES)[:, LAYOUT["y"]].reshape(-1)
    return Data(inputs, outputs)


class PlantOnly:
    """The plants alone: a vector step is one call."""

    def __init__(self, num_envs: int, data: Data) -> None:
        self._blocks = plants(num_envs)
        self._inputs = data.inputs

    def step(self, t: int) -> None:
        """Move by the t-th sample."""
        move_all(self._blocks, self._inputs[t % SAMPLES], NOISE)


class EstimatorOnly:
    """The estimators alone, on data that lie ready; every `SAMPLES` samples they begin again at the prior."""

    def __init__(self, data: Data, structured: bool, iterations: int) -> None:
        record = Prior.silverbox_twin().to_record(factorisation="structured" if structured else "mean_field")
        self._data = data
        self._rule = (structured, iterations)
        n_blocks = data.inputs.shape[1] // LANES
        self._prior = np.repeat(record[:, None], LANES, axis=1).reshape(-1)
        self._blocks = np.zeros((n_blocks, N_BELIEF_ROWS * LANES))

    def step(self, t: int) -> None:
        """Update with the t-th sample."""
        if t % SAMPLES == 0:
            self._blocks[:, : RECORD_SIZE * LANES] = self._prior
        infer_all(self._blocks, self._data.inputs[t % SAMPLES], self._data.outputs[t % SAMPLES], *self._rule)
