"""What an experiment is compiled for, the rows of its block, and what its kernel is told.

Environments lie in blocks of `estimator.compilation.simd.LANES`. A block holds the rows of the estimator first
(`estimator.engine.storage_layout.update_layout`), then those of the plant and of the episode.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from itertools import combinations
from typing import Any, NamedTuple, get_type_hints

import numpy as np
import numpy.typing as npt

from estimator.compilation.simd import LANES, jit_closure, number_rows
from estimator.engine.storage_layout import belief_rows, integrator_rows, trace_rows, update_layout
from estimator.models.difference_equation import difference
from estimator.models.model import Model

#: What a step leaves for an environment's face, in adjacent rows of its block.
OUTCOME_ROWS = (
    *("REWARD", "INFORMATION_GAIN", "LOG_POSTERIOR_GAIN"),
    *("TERMINATED", "TRUNCATED", "DIVERGED", "OFF_RECORD"),
)

#: Those of them that add up over the samples of a step; the others are as the last sample leaves them.
SUMMED_OUTCOMES = ("REWARD", "INFORMATION_GAIN", "LOG_POSTERIOR_GAIN")


class KernelSpec(NamedTuple):
    """What a kernel is compiled for.

    Attributes:
        belief_model: the model that is believed.
        plant_model: the model that is simulated; None where a record is replayed.
        degree: of the input over a sample of a differential equation: 0 held, 1 linear from the last input to this one.
        factorisation: ``structured``, or the paper's ``mean_field``.
        iterations: variational iterations per sample of the structured belief, whose update is generated with them; 0
            for mean field, which is told.
        reward_hooks: name of the reward, if it has hooks (`duffing_env.rewards.reward_registry`); the others are weights that a kernel is told.
        has_noise_hypotheses: whether several beliefs are weighed (`duffing_env.kernel_stages.noise_filter_bank`); how many is told.
        uses_cubature: whether these are moved by sigma points (`estimator.engine.uses_cubature`).
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
        """What tells its compiled functions from those of other kinds (`estimator.compilation.simd.jit_closure`)."""
        digests = (self.belief_model.digest, self.plant_model.digest if self.plant_model else "replay")
        return "_".join(str(word) for word in (*digests, *self[2:]))

    @property
    def truth_model(self) -> Model:
        """The model whose parameters the truth has."""
        return self.plant_model or self.belief_model


class KernelParams(NamedTuple):
    """What a kernel is told about an experiment, the same for all environments.

    Attributes:
        max_input: input of the action 1.
        max_output: limit of the first sensor.
        horizon: samples of an episode.
        iterations: variational iterations per sample.
        step: sampling step [s].
        nominal_parameters: (p,) parameters in the middle of the range, or their means.
        parameter_stds: (p,) standard deviations of those that are drawn from a Gaussian; minus that of the logarithm of those
            that are log-normal; 0 for those that are log-uniform.
        measurement_noise: (sensors,) standard deviations.
        walk_variances: (K,) variances of the coefficients' walk in a sample.
        reward_weights: (4,) of the reward (`duffing_env.rewards.reward_registry.Reward`).
        terminal: whether a reward is paid at the end.
        has_terminated_return: whether an episode that is terminated returns ``terminated_return``.
        terminated_return: return of an episode that is terminated, where it forfeits.
        prior: (size,) record that episodes start from.
        prior_inverse_std: (K,) 1 / standard deviation of the prior's coefficients.
        prior_log_precisions: (1 + sensors,) logarithms of the prior's E[γ] and E[ξ].
        hold: samples of an action.
        max_samples: samples after which an episode is cut off from outside, as Gymnasium's ``TimeLimit`` does.
        process_noise: standard deviation of what a sample's process noise does to the first sensor.
        noise_range: largest over smallest of what is drawn for an episode about each of the noises; 1 leaves them.
        spread: relative half width of the range.
        budget: of the energy Σ u².
        max_slew: largest change of the input.
        sqrt_input_cost: square root of what an input of 1 costs.
        jump: of the first parameter, in parts of it.
        has_drift: whether the coefficients are believed to walk.
        as_published: whether mean field departs from the paper as its published run did.
        input_delay: samples between a recorded input and the output it acts on.
        interleaved_envs: environments of a block whose members lie beside each other (`duffing_env.kernel_stages.noise_filter_bank`).
        hypothesis_priors: (members, 5) shape and rate of γ and of ξ that each of several beliefs starts from, and its weight.
    """

    max_input: float
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
    hold: int = 1
    max_samples: float = np.inf
    process_noise: float = 0.0
    noise_range: float = 1.0
    spread: float = 0.0
    budget: float = np.inf
    max_slew: float = np.inf
    sqrt_input_cost: float = 0.0
    jump: float = 0.0
    has_drift: bool = False
    as_published: bool = False
    input_delay: int = 0
    interleaved_envs: int = 1
    hypothesis_priors: npt.NDArray[np.float64] = np.empty((0, 5))


def pack_params(params: KernelParams) -> npt.NDArray[np.float64]:
    """A setup as one array: a compiled function takes that in a tenth of the time that it takes the tuple."""
    return np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in params])


def compile_unpacker(spec: KernelSpec) -> Any:
    """``unpack(packed)``: the setup again, compiled."""
    n_sensors, n_parameters = spec.truth_model.n_outputs, len(parameter_names(spec.truth_model))
    sizes = {
        "measurement_noise": n_sensors,
        "nominal_parameters": n_parameters,
        "parameter_stds": n_parameters,
        "reward_weights": 4,
    }
    sizes |= dict.fromkeys(("walk_variances", "prior_inverse_std"), spec.belief_model.n_coefficients)
    sizes |= {"prior": len(belief_rows(spec.belief_model)), "prior_log_precisions": 1 + spec.belief_model.n_outputs}
    fields, offset = [], 0
    for name, field_type in get_type_hints(KernelParams).items():
        size = sizes.get(name)
        packed_slice = f"packed[{offset}]" if size is None else f"packed[{offset}:{offset + size}]"
        if name == "hypothesis_priors":  # the last
            packed_slice = f"packed[{offset}:].reshape(-1, 5)"
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

    For K coefficients, n states and s sensors there are 2 K + K (K - 1) / 2 + n + 2 s + 4 entries.
    """
    names = list(model.coefficients)
    return {
        **{f"mean_{c}": (-10.0, 10.0) for c in names},
        **{f"log_std_{c}": (-20.0, 5.0) for c in names},
        **{f"corr_{c}_{d}": (-1.0, 1.0) for c, d in combinations(names, 2)},
        "log_gamma": (-20.0, 20.0),
        **{f"log_xi_{y}": (-20.0, 20.0) for y in model.outputs},
        **{f"state_{x}": (-2.0, 2.0) for x in model.states},
        "last_input": (-1.0, 1.0),
        **{f"last_{y}": (-2.0, 2.0) for y in model.outputs},
        "time_left": (0.0, 1.0),
        "budget_left": (0.0, 1.0),
    }


def parameter_names(model: Model) -> tuple[str, ...]:
    """What is drawn for an episode: the physical parameters, or the coefficients of a model without any."""
    return tuple(model.physical or model.coefficients)


def noise_std_rows(model: Model) -> dict[str, str]:
    """Name of a noise of the plant to the row of its standard deviation: the process noise, then each sensor's."""
    has_one_sensor = model.n_outputs == 1
    sensors = {
        "measurement_noise" if has_one_sensor else f"measurement_noise_{y}": f"SENSOR_STD_{y}" for y in model.outputs
    }
    return {"process_noise": "PROCESS_STD", **sensors}


def estimated_expressions(model: Model) -> Mapping[str, str]:
    """What is compared with the truth's parameters: name to its expression in the coefficients."""
    return model.physical or {c: c for c in model.coefficients}


@cache
def block_layout(spec: KernelSpec) -> Mapping[str, int]:
    """Name of a quantity to its row in a block of this kind."""
    belief, truth = spec.belief_model, spec.truth_model
    row_of = {name: row for name, row in update_layout(belief, spec.degree).items() if not name.startswith("U_")}
    row_of = {name: row for row, name in enumerate(row_of)}
    row_names = [f"Y_{y}" for y in truth.outputs]
    row_names += [f"PARAM_{p}" for p in parameter_names(truth)]
    row_names += noise_std_rows(truth).values()  # behind the parameters, see `stages.draw_plant_parameters`
    row_names += [f"X_{x}" for x in truth.states]
    row_names += [f"TRUE_{c}" for model in {truth: None, belief: None} for c in model.coefficients]
    row_names += [f"PER_{p}" for p in estimated_expressions(belief)]
    row_names += ["STREAM_a", "STREAM_b", "STREAM_c", "STREAM_d", "NOISE_w", "NOISE_v"]
    row_names += ["INPUT", "LAST_INPUT", "OLDER_INPUT", "RISE", "ASKED", "SPENT", "JUMP_AT", "JUMP_FACTOR"]
    row_names += ["ELAPSED", "WAITING", "RECORDED_u", "RECORDED_y", "LOG_DET", "LOG_DENSITY", "ERROR", "WORK", "EARNED"]
    row_names += OUTCOME_ROWS
    if spec.reward_hooks == "fisher":
        row_names += [f"I_{name}" for name in belief_rows(belief) if name.startswith("P_")]
    if spec.reward_hooks == "simulation_error":
        row_names += [f"{who}_{x}" for who in ("MODEL", "TWIN") for x in belief.states]
        row_names += ["DEVIATION", "POWER", "MISFIT"]
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


def missing_mean_field_rows(spec: KernelSpec) -> list[str]:
    """Rows of what the paper's model has and the believed one has not, which mean field needs: they hold zeros."""
    if spec.factorisation != "mean_field":
        return []
    believed_rows = belief_rows(spec.belief_model)
    return [name for name in belief_rows(difference()) if name not in believed_rows]


def model_input_rows(spec: KernelSpec, model: Model, row_of: Mapping[str, int]) -> dict[str, int]:
    """Rows of the input over a sample as a model takes it, ``U_0``, ``U_1``, ...: they stand in rows that are there."""
    if model.is_continuous:
        names = ["INPUT"] if spec.degree == 0 else ["LAST_INPUT", "RISE"]
    elif spec.truth_model.is_continuous and spec.degree == 1:
        # A difference equation takes the input at the sample before; where the input goes linearly from one action to
        # the next, that is the last action.
        names = ["LAST_INPUT", "OLDER_INPUT"]
    else:
        names = ["INPUT", "LAST_INPUT", "OLDER_INPUT"]
    return {f"U_{k}": row_of[name] for k, name in enumerate(names)}
