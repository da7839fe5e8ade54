"""What an experiment is compiled for, the rows of its block, and what its kernel is told.

Environments lie in blocks of `estimator.lanes.LANES`. A block holds the rows of the estimator first
(`estimator.engine.rows.layout`), then those of the plant and of the episode.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from itertools import combinations
from typing import Any, NamedTuple, get_type_hints

import numpy as np
import numpy.typing as npt

from estimator.engine.rows import belief_names, carried_names, layout, trace_names
from estimator.lanes import part, rows
from estimator.models.difference import difference
from estimator.models.model import Model

#: What a step leaves for an environment's face, in adjacent rows of its block.
OUTCOME = (
    *("REWARD", "INFORMATION_GAIN", "LOG_POSTERIOR_GAIN"),
    *("TERMINATED", "TRUNCATED", "DIVERGED", "OFF_RECORD"),
)

#: Those of them that add up over the samples of a step; the others are as the last sample leaves them.
SUMMED = ("REWARD", "INFORMATION_GAIN", "LOG_POSTERIOR_GAIN")


class Kind(NamedTuple):
    """What a kernel is compiled for.

    Attributes:
        belief: the model that is believed.
        plant: the model that is simulated; None where a record is replayed.
        degree: of the input over a sample of a differential equation: 0 held, 1 linear from the last input to this one.
        factorisation: ``structured``, or the paper's ``mean_field``.
        iterations: variational iterations per sample of the structured belief, whose update is generated with them; 0
            for mean field, which is told.
        work: name of the reward, if it has hooks (`duffing_env.rewards`); the others are weights that a kernel is told.
        weighs: whether several beliefs are weighed (`duffing_env.hypotheses`); how many is told.
        points: whether these are moved by sigma points (`estimator.engine.points`).
    """

    belief: Model
    plant: Model | None
    degree: int = 0
    factorisation: str = "structured"
    iterations: int = 3
    work: str = ""
    weighs: bool = False
    points: bool = False

    @property
    def name(self) -> str:
        """What tells its compiled functions from those of other kinds (`estimator.lanes.part`)."""
        digests = (self.belief.digest, self.plant.digest if self.plant else "replay")
        return "_".join(str(word) for word in (*digests, *self[2:]))

    @property
    def truth(self) -> Model:
        """The model whose parameters the truth has."""
        return self.plant or self.belief


class Setup(NamedTuple):
    """What a kernel is told about an experiment, the same for all environments.

    Attributes:
        max_input: input of the action 1.
        max_output: limit of the first sensor.
        horizon: samples of an episode.
        iterations: variational iterations per sample.
        step: sampling step [s].
        center: (p,) parameters in the middle of the range, or their means.
        width: (p,) standard deviations of those that are drawn from a Gaussian; minus that of the logarithm of those
            that are log-normal; 0 for those that are log-uniform.
        measurement_noise: (sensors,) standard deviations.
        walk: (K,) variances of the coefficients' walk in a sample.
        weights: (4,) of the reward (`duffing_env.rewards.Reward`).
        terminal: whether a reward is paid at the end.
        forfeits: whether an episode that is terminated returns ``terminated_return``.
        terminated_return: return of an episode that is terminated, where it forfeits.
        prior: (size,) record that episodes start from.
        inverse_std: (K,) 1 / standard deviation of the prior's coefficients.
        log_precisions: (1 + sensors,) logarithms of the prior's E[γ] and E[ξ].
        hold: samples of an action.
        limit: samples after which an episode is cut off from outside, as Gymnasium's ``TimeLimit`` does.
        process_noise: standard deviation of what a sample's process noise does to the first sensor.
        noise_range: largest over smallest of what is drawn for an episode about each of the noises; 1 leaves them.
        spread: relative half width of the range.
        budget: of the energy Σ u².
        max_slew: largest change of the input.
        input_price: square root of what an input of 1 costs.
        jump: of the first parameter, in parts of it.
        drifts: whether the coefficients are believed to walk.
        as_published: whether mean field departs from the paper as its published run did.
        delay: samples between a recorded input and the output it acts on.
        abreast: environments of a block whose members lie beside each other (`duffing_env.hypotheses`).
        hypotheses: (members, 5) shape and rate of γ and of ξ that each of several beliefs starts from, and its weight.
    """

    max_input: float
    max_output: float
    horizon: float
    iterations: int
    step: float
    center: npt.NDArray[np.float64]
    width: npt.NDArray[np.float64]
    measurement_noise: npt.NDArray[np.float64]
    walk: npt.NDArray[np.float64]
    weights: npt.NDArray[np.float64]
    terminal: bool
    forfeits: bool
    terminated_return: float
    prior: npt.NDArray[np.float64]
    inverse_std: npt.NDArray[np.float64]
    log_precisions: npt.NDArray[np.float64]
    hold: int = 1
    limit: float = np.inf
    process_noise: float = 0.0
    noise_range: float = 1.0
    spread: float = 0.0
    budget: float = np.inf
    max_slew: float = np.inf
    input_price: float = 0.0
    jump: float = 0.0
    drifts: bool = False
    as_published: bool = False
    delay: int = 0
    abreast: int = 1
    hypotheses: npt.NDArray[np.float64] = np.empty((0, 5))


def pack(setup: Setup) -> npt.NDArray[np.float64]:
    """A setup as one array: a compiled function takes that in a tenth of the time that it takes the tuple."""
    return np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in setup])


def unpacker(kind: Kind) -> Any:
    """``unpack(packed)``: the setup again, compiled."""
    sensors, parameters = kind.truth.n_outputs, len(parameter_names(kind.truth))
    sizes = {"measurement_noise": sensors, "center": parameters, "width": parameters, "weights": 4}
    sizes |= dict.fromkeys(("walk", "inverse_std"), kind.belief.n_coefficients)
    sizes |= {"prior": len(belief_names(kind.belief)), "log_precisions": 1 + kind.belief.n_outputs}
    told, at = [], 0
    for name, kind_of_value in get_type_hints(Setup).items():
        size = sizes.get(name)
        place = f"packed[{at}]" if size is None else f"packed[{at}:{at + size}]"
        if name == "hypotheses":  # the last
            place = f"packed[{at}:].reshape(-1, 5)"
        told.append({int: f"int({place})", bool: f"{place} != 0.0"}.get(kind_of_value, place))
        at += 1 if size is None else size
    return _unpacker(", ".join(told))


@cache  # most kinds have the same sizes
def _unpacker(told: str) -> Any:
    namespace: dict[str, Any] = {"Setup": Setup}
    exec(f"def unpack(packed):\n    return Setup({told})\n", namespace)
    return part(hashlib.sha256(told.encode()).hexdigest()[:12])(namespace["unpack"])


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


def noise_rows(model: Model) -> dict[str, str]:
    """Name of a noise of the plant to the row of its standard deviation: the process noise, then each sensor's."""
    one = model.n_outputs == 1
    sensors = {"measurement_noise" if one else f"measurement_noise_{y}": f"SENSOR_STD_{y}" for y in model.outputs}
    return {"process_noise": "PROCESS_STD", **sensors}


def estimated(model: Model) -> Mapping[str, str]:
    """What is compared with the truth's parameters: name to its expression in the coefficients."""
    return model.physical or {c: c for c in model.coefficients}


@cache
def layout_of(kind: Kind) -> Mapping[str, int]:
    """Name of a quantity to its row in a block of this kind."""
    belief, truth = kind.belief, kind.truth
    place = {name: row for name, row in layout(belief, kind.degree).items() if not name.startswith("U_")}
    place = {name: row for row, name in enumerate(place)}
    wanted = [f"Y_{y}" for y in truth.outputs]
    wanted += [f"PARAM_{p}" for p in parameter_names(truth)]
    wanted += noise_rows(truth).values()  # behind the parameters, see `stages.draw_plant`
    wanted += [f"X_{x}" for x in truth.states]
    wanted += [f"TRUE_{c}" for model in {truth: None, belief: None} for c in model.coefficients]
    wanted += [f"PER_{p}" for p in estimated(belief)]
    wanted += ["STREAM_a", "STREAM_b", "STREAM_c", "STREAM_d", "NOISE_w", "NOISE_v"]
    wanted += ["INPUT", "LAST_INPUT", "OLDER_INPUT", "RISE", "ASKED", "SPENT", "JUMP_AT", "JUMP_FACTOR"]
    wanted += ["ELAPSED", "WAITING", "RECORDED_u", "RECORDED_y", "LOG_DET", "LOG_DENSITY", "ERROR", "WORK", "EARNED"]
    wanted += OUTCOME
    if kind.work == "fisher":
        wanted += [f"I_{name}" for name in belief_names(belief) if name.startswith("P_")]
    if kind.work == "simulation_error":
        wanted += [f"{who}_{x}" for who in ("MODEL", "TWIN") for x in belief.states]
        wanted += ["DEVIATION", "POWER", "MISFIT"]
    if kind.factorisation == "mean_field":
        from estimator.inference import mean_field

        wanted += [*mean_field.SCRATCH, *left_out(kind)]
    wanted += [name for name in carried_names(belief) if name not in place]
    if kind.work == "free_energy" and kind.factorisation == "structured":
        wanted += ["FREE_ENERGY"] if kind.weighs else trace_names(belief, kind.iterations)
    missing = [name for name in dict.fromkeys(wanted) if name not in place]
    place |= rows(" ".join(missing), start=len(place))
    return place | inputs_of(kind, belief, place)


def left_out(kind: Kind) -> list[str]:
    """Rows of what the paper's model has and the believed one has not, which mean field needs: they hold zeros."""
    if kind.factorisation != "mean_field":
        return []
    known = belief_names(kind.belief)
    return [name for name in belief_names(difference()) if name not in known]


def inputs_of(kind: Kind, model: Model, place: Mapping[str, int]) -> dict[str, int]:
    """Rows of the input over a sample as a model takes it, ``U_0``, ``U_1``, ...: they stand in rows that are there."""
    if model.is_continuous:
        names = ["INPUT"] if kind.degree == 0 else ["LAST_INPUT", "RISE"]
    elif kind.truth.is_continuous and kind.degree == 1:
        # A difference equation takes the input at the sample before; where the input goes linearly from one action to
        # the next, that is the last action.
        names = ["LAST_INPUT", "OLDER_INPUT"]
    else:
        names = ["INPUT", "LAST_INPUT", "OLDER_INPUT"]
    return {f"U_{k}": place[name] for k, name in enumerate(names)}
