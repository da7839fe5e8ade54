"""The compile-time specification and run-time parameters of a kernel, and the rows of a block of environments.

A block holds `estimator.compilation.simd.LANES` environments: first the rows of the estimator
(`estimator.engine.storage_layout.update_layout`), then the rows of the plant and of the episode.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import cache
from itertools import combinations
from typing import Any, NamedTuple, get_type_hints

import numpy as np
import numpy.typing as npt

from estimator.compilation.simd import LANES, jit_closure, number_rows
from estimator.engine.storage_layout import (
    belief_rows,
    input_history_row,
    input_rows,
    integrator_rows,
    known_inputs,
    trace_rows,
    update_layout,
)
from estimator.models.difference_equation import difference
from estimator.models.model import MAX_INPUT_AGE, Model

#: Adjacent rows of a block with the outcome of a step: reward, gains and flags.
OUTCOME_ROWS = (
    *("REWARD", "INFORMATION_GAIN", "LOG_POSTERIOR_GAIN"),
    *("TERMINATED", "TRUNCATED", "DIVERGED", "OFF_RECORD"),
)

#: Outcomes that add up over the samples of a step; the last sample alone sets the others.
SUMMED_OUTCOMES = ("REWARD", "INFORMATION_GAIN", "LOG_POSTERIOR_GAIN")


class KernelSpec(NamedTuple):
    """The kind of an experiment: each kind has a kernel of its own.

    Attributes:
        belief_model: the model of the belief.
        plant_model: the model that is simulated; None where a record is replayed.
        degree: degree of the input over a sample of a differential equation: 0 held, 1 linear from the last input on.
        factorisation: ``structured``, or the paper's ``mean_field``.
        iterations: variational iterations per sample that the structured update is generated with; 0 for mean field,
            which takes them from `KernelParams`.
        reward_hooks: name of a reward with hooks (`duffing_env.rewards.named_rewards`); empty for the other rewards,
            whose weights are in `KernelParams`.
        has_noise_hypotheses: whether an environment weighs several beliefs
            (`duffing_env.kernel_stages.noise_filter_bank`); their number is in `KernelParams`.
        uses_cubature: whether sigma points propagate these beliefs (`estimator.engine.cubature`).
    """

    belief_model: Model
    plant_model: Model | None
    degree: int = 0
    factorisation: str = "structured"
    iterations: int = 3
    reward_hooks: str = ""
    has_noise_hypotheses: bool = False
    uses_cubature: bool = False

    @property
    def name(self) -> str:
        """Suffix of its compiled functions, different for every kind (`estimator.compilation.simd.jit_closure`)."""
        digests = (self.belief_model.digest, self.plant_model.digest if self.plant_model else "replay")
        return "_".join(str(word) for word in (*digests, *self[2:]))

    @property
    def truth_model(self) -> Model:
        """The model whose parameters the truth has."""
        return self.plant_model or self.belief_model


class KernelParams(NamedTuple):
    """The run-time parameters of a kernel, the same for all environments of an experiment.

    Attributes:
        max_input: (inputs,) inputs of the action 1.
        max_output: limit of the first sensor.
        horizon: samples of an episode.
        iterations: variational iterations per sample.
        step: sampling step [s].
        nominal_parameters: (p,) parameters in the middle of the range, or their means.
        parameter_stds: (p,) a positive number is the standard deviation of a Gaussian parameter, a negative one minus
            the standard deviation of a log-normal parameter's logarithm, and 0 stands for a log-uniform parameter.
        measurement_noise: (sensors,) standard deviations.
        walk_variances: (K,) variances of the coefficients' random walk in a sample.
        reward_weights: (4,) weights of the reward's terms (`duffing_env.rewards.named_rewards.Reward`).
        terminal: whether the whole reward is paid at the end of the episode.
        has_terminated_return: whether a terminated episode returns ``terminated_return``.
        terminated_return: return of a terminated episode.
        prior: (size,) record that episodes start from.
        prior_inverse_std: (K,) 1 / standard deviation of the prior's coefficients.
        prior_log_precisions: (1 + sensors,) logarithms of the prior's E[γ] and E[ξ].
        max_slew: (inputs,) largest changes of the inputs between samples.
        sqrt_input_cost: (inputs,) square roots of the costs of inputs of 1.
        sensor_limits: (sensors - 1,) limits of the further sensors; infinite where there is none.
        hold: samples of an action.
        max_samples: samples after which an outer limit truncates an episode, as Gymnasium's ``TimeLimit`` does.
        process_noise: standard deviation of the effect of one sample's process noise on the first sensor.
        noise_range: largest over smallest value that an episode draws for each noise; 1 draws no noises.
        spread: relative half width of the range of log-uniform parameters.
        budget: largest energy of an episode: Σ u², over all inputs, each in its own unit.
        jump: largest relative jump of the first parameter.
        has_drift: whether the belief lets the coefficients walk at random.
        as_published: whether mean field departs from the paper as its published run did.
        input_delay: samples between a recorded input and the output it acts on.
        interleaved_envs: environments of a block whose members lie side by side
            (`duffing_env.kernel_stages.noise_filter_bank`).
        hypothesis_priors: (members, 3 + 2 s) first shape and rate of γ and of each sensor's ξ of each of several
            beliefs, and its weight, for s sensors.
    """

    max_input: npt.NDArray[np.float64]
    max_output: float
    horizon: float
    iterations: int
    step: float
    nominal_parameters: npt.NDArray[np.float64]
    parameter_stds: npt.NDArray[np.float64]
    measurement_noise: npt.NDArray[np.float64]
    walk_variances: npt.NDArray[np.float64]
    reward_weights: npt.NDArray[np.float64]
    terminal: bool
    has_terminated_return: bool
    terminated_return: float
    prior: npt.NDArray[np.float64]
    prior_inverse_std: npt.NDArray[np.float64]
    prior_log_precisions: npt.NDArray[np.float64]
    max_slew: npt.NDArray[np.float64]
    sqrt_input_cost: npt.NDArray[np.float64]
    sensor_limits: npt.NDArray[np.float64]
    hold: int = 1
    max_samples: float = np.inf
    process_noise: float = 0.0
    noise_range: float = 1.0
    spread: float = 0.0
    budget: float = np.inf
    jump: float = 0.0
    has_drift: bool = False
    as_published: bool = False
    input_delay: int = 0
    interleaved_envs: int = 1
    hypothesis_priors: npt.NDArray[np.float64] = np.empty((0, 5))


def pack_params(params: KernelParams) -> npt.NDArray[np.float64]:
    """The parameters as one array: a call of a compiled function takes it in a tenth of a tuple's time."""
    return np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in params])


def compile_unpacker(spec: KernelSpec) -> Any:
    """``unpack(packed)``: the parameters from the array of `pack_params`, compiled."""
    n_sensors, n_parameters = spec.truth_model.n_outputs, len(parameter_names(spec.truth_model))
    sizes = {
        "measurement_noise": n_sensors,
        "sensor_limits": n_sensors - 1,
        "nominal_parameters": n_parameters,
        "parameter_stds": n_parameters,
        "reward_weights": 4,
    }
    sizes |= dict.fromkeys(("max_input", "max_slew", "sqrt_input_cost"), spec.truth_model.n_inputs)
    sizes |= dict.fromkeys(("walk_variances", "prior_inverse_std"), spec.belief_model.n_coefficients)
    sizes |= {"prior": len(belief_rows(spec.belief_model)), "prior_log_precisions": 1 + spec.belief_model.n_outputs}
    fields, offset = [], 0
    for name, field_type in get_type_hints(KernelParams).items():
        size = sizes.get(name)
        packed_slice = f"packed[{offset}]" if size is None else f"packed[{offset}:{offset + size}]"
        if name == "hypothesis_priors":  # the last
            packed_slice = f"packed[{offset}:].reshape(-1, {3 + 2 * spec.belief_model.n_outputs})"
        fields.append({int: f"int({packed_slice})", bool: f"{packed_slice} != 0.0"}.get(field_type, packed_slice))
        offset += 1 if size is None else size
    return _compiled_unpacker(", ".join(fields))


@cache  # most kinds have the same sizes
def _compiled_unpacker(arguments: str) -> Any:
    namespace: dict[str, Any] = {"KernelParams": KernelParams}
    exec(f"def unpack(packed):\n    return KernelParams({arguments})\n", namespace)
    return jit_closure(hashlib.sha256(arguments.encode()).hexdigest()[:12])(namespace["unpack"])


def observation_bounds(model: Model) -> dict[str, tuple[float, float]]:
    """Entries of the observation of a belief, in order, with their bounds; `duffing_env.env` says what they are.

    For K coefficients, n states, s sensors and i inputs there are 2 K + K (K - 1) / 2 + n + 2 s + i + 3 entries.
    """
    names = list(model.coefficients)
    return {
        **{f"mean_{c}": (-10.0, 10.0) for c in names},
        **{f"log_std_{c}": (-20.0, 5.0) for c in names},
        **{f"corr_{c}_{d}": (-1.0, 1.0) for c, d in combinations(names, 2)},
        "log_gamma": (-20.0, 20.0),
        **{f"log_xi_{y}": (-20.0, 20.0) for y in model.outputs},
        **{f"state_{x}": (-2.0, 2.0) for x in model.states},
        **dict.fromkeys(last_input_entries(model), (-1.0, 1.0)),
        **{f"last_{y}": (-2.0, 2.0) for y in model.outputs},
        "time_left": (0.0, 1.0),
        "budget_left": (0.0, 1.0),
    }


def last_input_entries(model: Model) -> list[str]:
    """Names of the entries of the last inputs: ``last_<input>`` of each, and ``last_input`` of an only input u."""
    return ["last_input"] if list(model.inputs) == ["u"] else [f"last_{i}" for i in model.inputs]


def rise_row(name: str) -> str:
    """Name of the row of an input's change since the sample before."""
    return f"RISE_{name}"


def requested_row(name: str) -> str:
    """Name of the row of the input that is asked for, before its limits."""
    return f"REQUESTED_INPUT_{name}"


def _environment_input_rows(name: str) -> list[str]:
    """Adjacent rows of an input: as it is applied, of the two samples before, its rise, and what is asked for."""
    ages = range(MAX_INPUT_AGE + 1)
    return [*(input_history_row(name, age) for age in ages), rise_row(name), requested_row(name)]


def parameter_names(model: Model) -> tuple[str, ...]:
    """Names of the parameters that an episode draws: physical ones, or the coefficients of a model without any."""
    return tuple(model.physical or model.coefficients)


def noise_std_rows(model: Model) -> dict[str, str]:
    """Name of each noise of the plant to the row of its standard deviation: process noise first, then the sensors."""
    has_one_sensor = model.n_outputs == 1
    sensors = {
        "measurement_noise" if has_one_sensor else f"measurement_noise_{y}": f"SENSOR_STD_{y}" for y in model.outputs
    }
    return {"process_noise": "PROCESS_STD", **sensors}


def noise_draw_rows(model: Model) -> list[tuple[str, str]]:
    """Rows of the two standard normal numbers of each source of process noise; the sensors take the first pair."""
    further = [(f"NOISE_w_{source}", f"NOISE_v_{source}") for source in model.noise_sources[1:]]
    return [("NOISE_w", "NOISE_v"), *further]


def estimated_expressions(model: Model) -> Mapping[str, str]:
    """Name of each parameter that is compared with the truth, to its expression in the coefficients."""
    return model.physical or {c: c for c in model.coefficients}


@cache
def block_layout(spec: KernelSpec) -> Mapping[str, int]:
    """Name of a quantity to its row in a block of this kind."""
    belief, truth = spec.belief_model, spec.truth_model
    aliases = input_rows(belief, spec.degree)
    row_of = {name: row for name, row in update_layout(belief, spec.degree).items() if name not in aliases}
    row_of = {name: row for row, name in enumerate(row_of)}
    row_names = [f"Y_{y}" for y in truth.outputs]
    row_names += [f"PARAM_{p}" for p in parameter_names(truth)]
    row_names += noise_std_rows(truth).values()  # behind the parameters, as `draw_plant_parameters` expects
    row_names += [f"X_{x}" for x in truth.states]
    row_names += [f"TRUE_{c}" for model in {truth: None, belief: None} for c in model.coefficients]
    row_names += [f"INVERSE_TRUE_{p}" for p in estimated_expressions(belief)]
    row_names += ["SFC64_a", "SFC64_b", "SFC64_c", "SFC64_d", *(row for pair in noise_draw_rows(truth) for row in pair)]
    row_names += [row for i in truth.inputs for row in _environment_input_rows(i)]
    row_names += ["ENERGY_SPENT", "JUMP_AT", "JUMP_FACTOR"]
    row_names += ["ELAPSED_SAMPLES", "NEEDS_RESET", "LOG_DET", "LOG_DENSITY", "PARAMETER_ERROR"]
    row_names += ["HOOK_REWARD", "EPISODE_RETURN"]
    row_names += OUTCOME_ROWS
    if spec.reward_hooks == "fisher":
        row_names += [f"FISHER_{name}" for name in belief_rows(belief) if name.startswith("P_")]
    if spec.reward_hooks == "simulation_error":
        row_names += [f"{who}_{x}" for who in ("SIMULATED_BELIEVED", "SIMULATED_TRUE") for x in belief.states]
        row_names += ["SUM_SQUARED_DIFFERENCE", "SUM_SQUARED_TRUE", "SIMULATION_ERROR"]
    if spec.factorisation == "mean_field":
        from estimator.inference import mean_field

        row_names += [*mean_field.SCRATCH_ROWS, *missing_mean_field_rows(spec)]
    row_names += [name for name in integrator_rows(belief) if name not in row_of]
    if spec.reward_hooks == "free_energy" and spec.factorisation == "structured":
        row_names += ["FREE_ENERGY"] if spec.has_noise_hypotheses else trace_rows(belief, spec.iterations)
    missing = [name for name in dict.fromkeys(row_names) if name not in row_of]
    row_of |= number_rows(" ".join(missing), first_row=len(row_of))
    return row_of | model_input_rows(spec, belief, row_of)


def block_offsets(spec: KernelSpec) -> dict[str, int]:
    """Name of a quantity to the place of its first lane in a flat block."""
    return {name: row * LANES for name, row in block_layout(spec).items()}


def input_places(spec: KernelSpec, row: Callable[[str], str]) -> tuple[int, int]:
    """Place of a row of the first input in a flat block, and the distance to the same row of the next input."""
    first = next(iter(spec.truth_model.inputs))
    return block_offsets(spec)[row(first)], len(_environment_input_rows(first)) * LANES


def applied_row(name: str) -> str:
    """Name of the row of an input as it is applied in the last sample."""
    return input_history_row(name, 0)


def missing_mean_field_rows(spec: KernelSpec) -> list[str]:
    """Rows that mean field needs, but a smaller model than the paper's does not have: they hold zeros."""
    if spec.factorisation != "mean_field":
        return []
    believed_rows = belief_rows(spec.belief_model)
    return [name for name in belief_rows(difference()) if name not in believed_rows]


def model_input_rows(spec: KernelSpec, model: Model, row_of: Mapping[str, int]) -> dict[str, int]:
    """Rows of a model's inputs over a sample (`input_rows`): other names of rows that a block has anyway.

    A difference equation takes each input at the sample before, the last action, where the inputs of the plant go
    linearly from one action to the next.
    """
    inputs = list(model.inputs)
    lag = int(not model.is_continuous and spec.truth_model.is_continuous and spec.degree == 1)
    rows = {}
    for known in known_inputs(model, spec.degree, lag):
        name = inputs[known.channel]
        rows[known.name] = row_of[
            input_history_row(name, known.age) if known.subtracted_age is None else rise_row(name)
        ]
    return rows
