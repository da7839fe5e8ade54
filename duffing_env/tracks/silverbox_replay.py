"""The recorded Silverbox experiment as an environment, in which a record replaces the plant: `SilverboxReplayEnv`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from os import PathLike
from typing import Any, ClassVar

import numpy as np

from duffing_env.env import DuffingEnv
from duffing_env.env_common import ReadOnlyOption
from duffing_env.experiment_config import Experiment
from duffing_env.plants.silverbox_record import REGIME_NAMES, Regime, load_record
from duffing_env.vector_env import DuffingVectorEnv
from estimator.belief import Belief
from estimator.models.difference_equation import difference
from estimator.models.model import Model
from estimator.priors import paper_text_prior, published_run_prior, silverbox_prior
from estimator.support.argument_checks import check_bool
from estimator.support.array_types import FloatArray

#: Name of a prior to the function that makes it for a model.
_PRIOR_FACTORIES: dict[str, Callable[[Model], Belief]] = {
    "silverbox_twin": silverbox_prior,
    "published_run": partial(published_run_prior, True),
    "paper_text": partial(paper_text_prior, True),
}


@dataclass(frozen=True)
class ReplayExperiment(Experiment):
    """The recorded Silverbox experiment; `SilverboxReplayEnv` describes its options."""

    regime: str = "multisine"
    prior: str = "silverbox_twin"
    input_delay: int = 1
    nonlinear: bool = True
    as_published: bool = False
    data: str | None = None

    def __post_init__(self) -> None:
        for name in ("nonlinear", "as_published"):
            check_bool(name, getattr(self, name))
        for name, choices in (("regime", REGIME_NAMES), ("prior", _PRIOR_FACTORIES), ("input_delay", (0, 1))):
            value = getattr(self, name)
            if not isinstance(value, str | int) or value not in choices:
                raise ValueError(f"{name} must be one of {list(choices)}, but is {value!r}")
        if self.data is not None and not isinstance(self.data, str | PathLike):
            raise ValueError(f"data must be the name of a file or folder, or None to search, but is {self.data!r}")
        super().__post_init__()
        if self.hold != 1:
            raise ValueError(f"hold must be 1 for a record, which answers sample by sample, but is {self.hold}")
        if self.reward == "fisher":
            raise ValueError(
                "reward must not be 'fisher' for a record, whose true oscillator is unknown; use 'log_posterior'"
            )
        if self.as_published and self.factorisation != "mean_field":
            raise ValueError(
                f"as_published goes with factorisation='mean_field', but factorisation is {self.factorisation!r}"
            )
        peak = float(np.abs(self._regime.u).max())
        if self.max_inputs[0] < peak:
            raise ValueError(
                f"max_input must reach the record's largest input, {peak} V, but is {self.max_input}; pass 0.15"
            )

    @cached_property
    def _regime(self) -> Regime:
        regime: Regime = getattr(load_record(self.data), self.regime)
        return regime

    @property
    def samples(self) -> int:
        """The samples of the regime that have an output."""
        return len(self._regime.u) - self.input_delay

    @property
    def model(self) -> Model:
        """The paper's, with the cubic term or without."""
        return difference("paper" if self.nonlinear else "linear")

    @cached_property
    def prior_belief(self) -> Belief:
        """The prior with the name in the option ``prior``."""
        return _PRIOR_FACTORIES[self.prior](self.model).with_factorisation(self.factorisation)

    @property
    def replayed_record(self) -> FloatArray:
        """The regime's input and output [V]."""
        return np.stack([self._regime.u, self._regime.y])

    @property
    def recorded_input(self) -> FloatArray:
        """The regime's input [V]."""
        return self._regime.u

    @property
    def plant_params(self) -> dict[str, Any]:
        """The delay of the record's input, and whether mean field follows the published run."""
        return {"as_published": self.as_published, "input_delay": self.input_delay}


class SilverboxReplayEnv(DuffingEnv):
    r"""The paper's experiment: the recorded Silverbox input, sample by sample, through the environment.

    ## Description

    The record of the Silverbox circuit (Wigren and Schoukens 2013) replaces the plant. A record has outputs for the
    recorded inputs only: an action further than float32 rounding from the recorded input ends the episode, flagged
    ``off_record``. Otherwise the estimator gets the recorded float64 input and output. The reference policies
    ``silverbox-multisine`` and ``silverbox-arrow`` of `agents` play the record.

    ## Action space, observation space, reward

    As `DuffingEnv`. The true parameters of a circuit are unknown: ``log_posterior``, ``parameter_error`` and
    ``simulation_error`` are relative to its twin, identified from the whole training part.

    ## Starting state

    The first sample of the regime; the prior is the one named by ``prior``.

    ## Episode end

    - Termination: an action off the record; \|y\| > ``max_output``; a number that is not finite.
    - Truncation: the end of the regime.

    ## Information

    As `DuffingEnv`, and ``off_record``.

    ## Arguments

    ``factorisation``, ``iterations``, ``noise_hypotheses``, ``reward``, ``terminal``, ``terminated_return``,
    ``max_input``, ``max_output`` and ``render_mode`` as `DuffingEnv`. There is no ``hold``: a record is played sample
    by sample.

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | ``regime`` | ``multisine`` | the paper's training part, or ``arrow``, its validation part |
    | ``prior`` | ``silverbox_twin`` | or ``published_run``, ``paper_text`` |
    | ``input_delay`` | 1 | samples between an input and the output it acts on: 1 as in Eq. (2); 0 as published |
    | ``nonlinear`` | True | whether the estimator's model has the cubic term |
    | ``as_published`` | False | mean field with the two departures of the published run |
    | ``data`` | None | file or folder of the record; searched for where None |

    Raises:
        duffing_env.plants.silverbox_record.RecordNotFound: with the source of the record, and the folder to put it in.

    ## Version history

    * v0: initial version
    """

    experiment_class: ClassVar[type[Experiment]] = ReplayExperiment
    _info_flags: ClassVar[tuple[str, ...]] = ("diverged", "off_record")

    #: The inputs of the record, in order [V].
    recorded_input = ReadOnlyOption("recorded_input", "experiment.recorded_input")


class SilverboxReplayVectorEnv(DuffingVectorEnv):
    """Many `SilverboxReplayEnv` at once; all rows replay the same record."""

    single_env_class: ClassVar[type[DuffingEnv]] = SilverboxReplayEnv

    #: As `SilverboxReplayEnv.recorded_input`.
    recorded_input = ReadOnlyOption("recorded_input", "experiment.recorded_input")
