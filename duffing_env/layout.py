"""The layout of an environment: its quantities in a block, what it is told, what a step leaves behind.

Environments lie in blocks of `estimator.lanes.LANES`. A block holds an estimator's rows first (`estimator.record`),
then those of `LAYOUT` below, so that the estimator's functions run on it as they are.
"""

from __future__ import annotations

from estimator.lanes import rows
from estimator.record import LAYOUT as BELIEF_LAYOUT
from estimator.record import N_ROWS as N_BELIEF_ROWS
from estimator.record import RECORD, SCRATCH_BEGIN

#: Entries of the observation, in order, with their bounds; the environment's docstring says what they are.
OBSERVATION = {
    **{f"mean_{c}": (-10.0, 10.0) for c in ("t1", "t2", "t3", "e")},
    **{f"log_std_{c}": (-20.0, 5.0) for c in ("t1", "t2", "t3", "e")},
    **{f"corr_{pair}": (-1.0, 1.0) for pair in ("12", "13", "1e", "23", "2e", "3e")},
    **{f"log_{noise}": (-20.0, 20.0) for noise in ("gamma", "xi")},
    **{f"state_{lag}": (-2.0, 2.0) for lag in ("x0", "x1")},
    "last_input": (-1.0, 1.0),
    "last_output": (-2.0, 2.0),
    "time_left": (0.0, 1.0),
    "budget_left": (0.0, 1.0),
}
N_OBSERVATION = len(OBSERVATION)

#: What the kernel is told about a track: (len(SETTINGS),) float64, the same for all environments.
SETTINGS = rows(
    "max_input max_output horizon hold process_noise measurement_noise spread center_m center_c center_a center_b step",
    "budget max_slew input_cost jump walk_t1 walk_t2 walk_t3 walk_e",
    "reward terminal forfeits terminated_return iterations as_published nonlinear delay",
    "prior_t1 prior_t2 prior_t3 prior_e scale_t1 scale_t2 scale_t3 scale_e prior_log_gamma prior_log_xi",
)

#: What a step leaves for an environment's face, in adjacent rows of its block.
OUTCOME = (
    *("reward", "information_gain", "log_posterior_gain"),
    *("terminated", "truncated", "diverged", "off_record"),
)
N_OUTCOME = len(OUTCOME)

#: Those of them that add up over the samples of a step; the others are as the last sample leaves them.
SUMMED = ("reward", "information_gain", "log_posterior_gain")

#: The covariance that one who knows the truth would have, for the reward ``fisher``; the third lag is not needed.
IDEAL = tuple(f"ideal_{name}" for name in RECORD if name.startswith("P_") and "x2" not in name)

#: The true oscillator.
OSCILLATOR = ("m", "c", "a", "b")

#: Name of a quantity to its row. The observation, which is written last, lies in rows that only an estimator's update
#: uses: the fewer rows a step touches, the less memory it waits for.
LAYOUT = {
    **BELIEF_LAYOUT,
    **rows(
        "stream_a stream_b stream_c stream_d noise_w noise_v",
        " ".join(OSCILLATOR),
        "true_t1 true_t2 true_t3 true_e",
        "x last_x velocity elapsed waiting recorded_u recorded_y",
        "asked spent jump_at jump_factor",
        "log_det log_density error misfit surprise fisher_gain earned ideal_log_det",
        " ".join(IDEAL),
        " ".join(OUTCOME),
        start=N_BELIEF_ROWS,
    ),
    **rows(" ".join(f"obs_{name}" for name in OBSERVATION), start=SCRATCH_BEGIN),
}
N_ROWS = N_BELIEF_ROWS + len(LAYOUT) - len(BELIEF_LAYOUT) - N_OBSERVATION

#: What is kept of an episode that ended, where the next one began in the same step: its record and its oscillator.
ENDED = rows(" ".join(RECORD), " ".join(OSCILLATOR))
