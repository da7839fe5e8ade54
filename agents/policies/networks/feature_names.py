"""Names and places of the features that networks take (`agents.policies.networks.rollout_features`)."""

FIRST_INPUTS = ("up", "none", "down")

#: Features that stand for each of the first inputs.
_PER_FIRST_INPUT = (
    "next_output", "free_peak", "braked_peak", "braked_peak_with_margin", "free_information", "braked_information",
)  # fmt: skip

#: Features of every network. ``next_output``: the first sensor's output after a move. ``free_peak`` and
#: ``braked_peak``: its largest magnitude in a free and a braked rollout; ``braked_peak_with_margin``: the latter with
#: the shield's margin. All are in parts of the limit. ``free_information`` and ``braked_information`` compare the
#: information of three moves: ``up`` is up less down, and ``none`` is none less the better of both, in parts of the
#: largest; ``down`` is the logarithm of the largest over the samples left.
FEATURE_NAMES = (
    "log_std_mean", "log_std_max", "log_gamma", "log_xi", "time_left",
    "energy_left_ratio", "energy_left", "action_scale", "last_input", "last_output", "output", "velocity",
    "log_deviation", "lowest_allowed", "highest_allowed",
    *(f"{what}_{first}" for what in _PER_FIRST_INPUT for first in FIRST_INPUTS),
    "free_response_2", "free_response_3", "free_response_4", "remaining_information", "open_information_rate",
)  # fmt: skip

_PLACE = {name: i for i, name in enumerate(FEATURE_NAMES)}

#: Places of the features of the first of `FIRST_INPUTS`; the others follow.
NEXT, REST, PEAK, REACH, TAUGHT, BRAKED = (_PLACE[f"{what}_up"] for what in _PER_FIRST_INPUT)

#: Places of the free response and of the features behind it.
FREE, OTHERS = _PLACE["free_response_2"], _PLACE["remaining_information"]

#: Largest size of a feature.
MAX_FEATURE = 10.0
