"""The pendulum of IO-SMC² (Iqbal et al., ICML 2024), whose learned policies' information gain is published.

    python -m research.studies.iosmc_pendulum

plays `duffing_env/Pendulum-v1`, which is the published experiment: Euler's rule with 0.05 s, diffusion 0.1 of the
velocity, p1, p2, p3 Gaussian with means 14.7, 0, 3 and variances 0.1, 0.01, 0.1, from rest at the bottom, |u| ≤ 1, 50
samples, and 1,024 systems. Angle and velocity are measured, so the posterior of p1, p2 and p3 is exact, except that the
belief takes the first velocity to be uncertain by 0.02 rad/s. Gains are prior entropy minus posterior entropy. Two
things differ from the publication: its noise of 0.1 mrad of the angle, which makes a matrix regular, is absent; and an
episode ends where the angle exceeds 4 rad, which the table counts.

The published figures are from the repository Sahel13/InsideOutSMC.jl, experiments/pendulum/linear: the set-up
stands in environment.jl, the evaluation in online_inference/make_plot.jl, the gains in the data's files
linear_pendulum_info_gain_*.csv. Their last row is labelled 50, but the rows are every fifth sample from the first on,
so it is sample 46. The published policies were trained with a weight of 0.1 on changes of the input.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.cli import run_script
from agents.console_output import format_table, print_texts_and_tables
from agents.evaluation.metric_summary import METRIC_COLUMNS, center_and_interval_text
from agents.evaluation.track_batch import TEST_OPTIONS, make_track_batch
from agents.policies import make_policy
from agents.user_code import attribute_user_errors
from estimator.support.array_types import FloatArray

TRACK = "duffing_env/Pendulum-v1"

#: The sample after which gains are published.
PUBLISHED_SAMPLE = 46

#: Published mean and standard deviation over systems, after `PUBLISHED_SAMPLE` samples [nats].
PUBLISHED = {"uniform": (1.33, 0.21), "prbs": (2.16, 0.35), "IO-SMC², IBIS": (3.36, 0.18), "IO-SMC²": (3.41, 0.18)}


@dataclass(frozen=True)
class Config:
    """Compare policies with IO-SMC²'s on its pendulum."""

    policies: tuple[str, ...] = ("efe", "ppo/pendulum", "velocity-sign", "prbs", "uniform")
    """Names or run folders."""
    systems: int = 1024
    """Pendulums."""
    seed: int = 0
    """Of pendulums, noise and policies."""


def information_gains(policy: str, systems: int, seed: int = 0) -> tuple[FloatArray, int]:
    """(50, systems) information gained after every sample [nats], and the number of episodes that a limit ended."""
    envs = make_track_batch(TRACK, systems, TEST_OPTIONS)
    with attribute_user_errors(policy, "policy"):
        chosen = make_policy(policy, envs, seed=seed)
    observations, _ = envs.reset(seed=seed)
    found, running = np.zeros((envs.horizon, systems)), np.ones(systems, dtype=np.bool_)
    state, start, early = None, np.ones(systems, dtype=np.bool_), 0
    for t in range(envs.horizon):
        with attribute_user_errors(policy, "policy"):
            actions, state = chosen.predict(observations, state, start, deterministic=True)
        start = np.zeros(systems, dtype=np.bool_)
        observations, _, terminated, truncated, infos = envs.step(actions)
        found[t, running] = infos["information_gain"][running]
        early += int((running & terminated).sum())
        running &= ~(terminated | truncated)
    envs.close()
    return found.cumsum(axis=0), early


def main(config: Config) -> None:
    """Play, and print the table."""
    rows, metric = [], METRIC_COLUMNS["information_gain"]
    for name in config.policies:
        found, early = information_gains(name, config.systems, config.seed)
        then, last = (
            center_and_interval_text(metric, found[PUBLISHED_SAMPLE - 1]),
            center_and_interval_text(metric, found[-1]),
        )
        rows.append([name, then, f"{found[PUBLISHED_SAMPLE - 1].std():.2f}", last, str(early)])
    rows += [[f"published: {name}", f"{mean:.2f}", f"{std:.2f}", "", ""] for name, (mean, std) in PUBLISHED.items()]
    titles = (
        "policy",
        f"gain of {PUBLISHED_SAMPLE} samples / nat",
        "std over systems",
        "gain of 50 / nat",
        "ended early",
    )
    print_texts_and_tables(format_table(titles, rows, markdown=True))


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
