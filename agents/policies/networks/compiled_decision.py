"""Decision of a trained policy with features as one compiled function: features, network, shield.

Each row is calculated by itself, in the same order of operations. So a decision has the same bits alone, in a batch,
and in a batch of another size.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.planning.model_probe import ModelView
from agents.policies.networks.rollout_features import compile_features
from estimator.compilation.array_operations import copy
from estimator.compilation.simd import jit, kernel

Array = npt.NDArray[Any]

#: Activations between layers, by their numbers.
ACTIVATION_NAMES = ("tanh", "relu", "elu")


class CompiledActor(NamedTuple):
    """A network as arrays, for the compiled decision.

    Attributes:
        mean: (features,) float32 of the features.
        scale: (features,) float32 one over their standard deviations.
        clip: largest normalised feature, in standard deviations.
        sizes: (layers + 1,) widths before and after every layer.
        weights: float32 of all layers, flat: the weights from a number to all of the next layer lie together.
        biases: float32 of all layers, flat.
        activation: of `ACTIVATION_NAMES`.
        levels: actions from -1 to 1 of which the last layer has the log probabilities; 0 where it has the action.
        squashed: whether the action is the tanh of the last layer.
    """

    mean: Array
    scale: Array
    clip: float
    sizes: Array
    weights: Array
    biases: Array
    activation: int
    levels: int
    squashed: bool

    @classmethod
    def of(
        cls,
        layers: Sequence[tuple[Array, Array]],
        normalizer: tuple[Array, Array, float],
        activation: str,
        levels: int,
        squashed: bool,
    ) -> CompiledActor:
        """The arrays of layers, each a weight (out, in) and a bias (out,)."""
        mean, std, clip = normalizer
        weights = np.concatenate([np.ravel(weight.T) for weight, _ in layers])
        biases = np.concatenate([bias for _, bias in layers])
        sizes = np.array([layers[0][0].shape[1], *(len(bias) for _, bias in layers)])
        number = ACTIVATION_NAMES.index(activation)
        return cls(mean, np.float32(1) / std, float(clip), sizes, weights, biases, number, levels, squashed)


@jit
def _accumulate_eight(y, x, weights, n):
    """Add eight inputs, each times its weights to ``n`` outputs, to the outputs, one after the other.

    The outputs are loaded and stored once for eight inputs: processors multiply faster than they store.
    """
    x0, x1, x2, x3, x4, x5, x6, x7 = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7]
    w0, w1, w2, w3 = weights[:n], weights[n : 2 * n], weights[2 * n : 3 * n], weights[3 * n : 4 * n]
    w4, w5, w6, w7 = weights[4 * n : 5 * n], weights[5 * n : 6 * n], weights[6 * n : 7 * n], weights[7 * n : 8 * n]
    for j in range(len(y)):
        half = (((y[j] + x0 * w0[j]) + x1 * w1[j]) + x2 * w2[j]) + x3 * w3[j]
        y[j] = (((half + x4 * w4[j]) + x5 * w5[j]) + x6 * w6[j]) + x7 * w7[j]


@jit
def _accumulate_one(y, x, weights):
    for j in range(len(y)):
        y[j] += x * weights[j]


@jit
def _dense_layer(y, x, weights):
    """Add ``weights`` (inputs * outputs) times ``x`` (inputs,) to ``y`` (outputs,)."""
    n, whole = len(y), len(x) - len(x) % 8
    for i in range(0, whole, 8):
        _accumulate_eight(y, x[i:], weights[i * n :], n)
    for i in range(whole, len(x)):
        _accumulate_one(y, x[i], weights[i * n : (i + 1) * n])


@jit
def _activate(x, start, count, activation):
    for i in range(start, start + count):
        if activation == 1:
            x[i] = max(x[i], np.float32(0.0))
        elif activation == 0:
            x[i] = np.tanh(x[i])
        else:
            x[i] = x[i] if x[i] > 0.0 else np.float32(np.expm1(x[i]))


@jit
def _forward(actor, values, x):
    """The network's action in [-1, 1], before mirroring; ``x`` holds the activations of all layers in turn."""
    sizes, clip = actor.sizes, np.float32(actor.clip)
    for i in range(sizes[0]):
        x[i] = max(-clip, min((values[i] - actor.mean[i]) * actor.scale[i], clip))
    input_start, weight, bias = 0, 0, 0
    for layer in range(len(sizes) - 1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        output_start = input_start + inputs
        copy(x, output_start, actor.biases[bias:], outputs)
        _dense_layer(
            x[output_start : output_start + outputs], x[input_start : input_start + inputs], actor.weights[weight:]
        )
        if layer < len(sizes) - 2:
            _activate(x, output_start, outputs, actor.activation)
        input_start, weight, bias = output_start, weight + inputs * outputs, bias + outputs
    if actor.levels == 0:
        return (
            np.tanh(x[input_start]) if actor.squashed else max(np.float32(-1.0), min(x[input_start], np.float32(1.0)))
        )
    best = 0
    for i in range(1, actor.levels):
        best = i if x[input_start + i] > x[input_start + best] else best
    return np.float32(2.0 * best / (actor.levels - 1) - 1.0)


@cache
def compile_decision(view: ModelView) -> Any:
    """``decide(observations, setting, with_observation, actor, actions)`` fills in the actions (n, 1) of observations.

    It returns the index of the first row that is not finite, and stops there; else -1.
    """
    workspace, encode = compile_features(view)

    @kernel(variant=view.compile_key)
    def decide(observations, setting, with_observation, actor, actions):
        buffers, values, allowed_interval = workspace(), np.empty(actor.sizes[0], np.float32), np.empty(2, np.float32)
        x = np.empty(actor.sizes.sum(), np.float32)
        for i in range(len(observations)):
            total = np.float32(0.0)
            for j in range(observations.shape[1]):
                total += np.float32(0.0) * observations[i, j]
            if total != 0.0:  # NaN, that is 0 times a number that is not finite
                return i
            sign, action_scale, _ = encode(
                observations[i], setting, with_observation, buffers, values, allowed_interval
            )
            choice = _forward(actor, values, x)
            actions[i, 0] = (
                np.float32(sign) * np.float32(action_scale) * max(allowed_interval[0], min(choice, allowed_interval[1]))
            )
        return -1

    return decide
