"""Compares policies with the planner on unseen oscillators of the family.

    python -m research.studies.unseen_oscillators --policies ppo/universal shield prbs uniform silverbox-multisine

plays every policy on the same oscillators, one of each rig drawn by
`agents.training.environments.oscillator_family`, in the branch ``test`` of the seeds. D-efficiency is
exp(2 (I - I_efe) / K), with I the information gained about the K coefficients and I_efe the planner's on the same
oscillator with the same noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from agents.cli import run_script
from agents.console_output import format_table, print_texts_and_tables
from agents.evaluation.policy_arguments import check_policies_can_play
from agents.evaluation.track_batch import TEST_OPTIONS, make_track_batch
from agents.policies import make_policy
from agents.result_files import write_json
from agents.track_ids import RIG_TRACK
from agents.training.environments.oscillator_family import FamilyMember, draw_oscillator
from agents.user_code import attribute_user_errors
from estimator.support.progress import iterate_with_progress

PLANNER = "efe"

#: Seed word of the family's draws, which no training uses.
_SEED_BRANCH = 2


@dataclass(frozen=True)
class Config:
    """Evaluate policies on the family of oscillators."""

    policies: tuple[str, ...] = ("ppo/universal", "shield", "prbs", "prbs-4", "uniform", "silverbox-multisine")
    """Names or run folders, beside the planner."""
    systems: int = 256
    """Rigs, one oscillator of each."""
    seed: int = 0
    """Of rigs, oscillators and noise."""
    output: Path | None = None
    """Folder for results as JSON."""

    def __post_init__(self) -> None:
        if not self.policies or self.systems < 2:
            raise ValueError(f"policies must be some and systems at least 2, but are {self.policies}, {self.systems}")


def draw_unseen_rigs(n_rigs: int, seed: int = 0) -> list[FamilyMember]:
    """Rigs of the family that no training draws."""
    return [draw_oscillator(np.random.default_rng((seed, _SEED_BRANCH, i))) for i in range(n_rigs)]


def play_episode(rig: FamilyMember, policy: str, seed: int) -> tuple[float, float, float]:
    """Play an episode: information gained [nats], 1 where a limit ended it, share of 90 % intervals with the truth."""
    envs = make_track_batch(RIG_TRACK, 1, rig.options | TEST_OPTIONS)
    chosen = make_policy(policy, envs, seed=seed)
    observations, _ = envs.reset(seed=seed)
    state, start = None, np.ones(1, dtype=np.bool_)
    gained, terminated = 0.0, np.zeros(1, dtype=np.bool_)
    for _ in range(envs.horizon):
        with attribute_user_errors(policy, "policy"):
            actions, state = chosen.predict(observations, state, start, deterministic=True)
        start = np.zeros(1, dtype=np.bool_)
        observations, _, terminated, truncated, infos = envs.step(actions)
        gained += float(infos["information_gain"][0])
        if terminated[0] or truncated[0]:
            break
    belief, truth = infos["belief"][0], infos["truth"][0]
    intervals = belief.interval(0.9)
    covered = np.mean([low <= getattr(truth, name) <= high for name, (low, high) in intervals.items()])
    envs.close()
    return gained, float(terminated[0]), float(covered)


def oscillator_classes(rigs: Sequence[FamilyMember]) -> Iterator[tuple[str, npt.NDArray[np.bool_]]]:
    """Name of a class of oscillators to a mask of its members."""
    stiffness_kinds = np.array([member.stiffness for member in rigs])
    yield "all", np.ones(len(rigs), dtype=np.bool_)
    for kind in dict.fromkeys(stiffness_kinds):
        yield str(kind), stiffness_kinds == kind
    for name, values, edge in (("damping", [m.damping for m in rigs], 0.025), ("drive", [m.drive for m in rigs], 0.14)):
        yield f"weak {name}", np.array(values) < edge
        yield f"strong {name}", np.array(values) >= edge
    known = np.array([member.options.get("noise_range") == 1.0 for member in rigs])
    frugal = np.array(["max_rms" in member.options for member in rigs])
    yield "known noise", known
    yield "unknown noise", ~known
    yield "limited energy", frugal
    yield "limited amplitude alone", ~frugal


def main(config: Config) -> None:
    """Play, and print the table."""
    members = draw_unseen_rigs(config.systems, config.seed)
    names = (PLANNER, *config.policies)
    check_policies_can_play(names, RIG_TRACK, members[0].options, config.seed)
    gains, ended, covered = np.empty((3, len(names), len(members)))
    tasks = [
        (f"{name}, {member.stiffness}", (p, i)) for p, name in enumerate(names) for i, member in enumerate(members)
    ]
    for p, i in iterate_with_progress(tasks):
        gains[p, i], ended[p, i], covered[p, i] = play_episode(members[i], names[p], config.seed + i)
    groups = [(name, mask) for name, mask in oscillator_classes(members) if mask.any()]
    n_coefficients = 6
    efficiency = np.exp(2.0 * (gains - gains[0]) / n_coefficients)
    rows = []
    for name, mask in groups:
        cells = [f"{np.median(e[mask]):.2f} / {np.quantile(e[mask], 0.1):.2f}" for e in efficiency]
        rows.append([name, str(int(mask.sum())), *cells])
    rows.append(["ended early", "", *(f"{100 * e.mean():.1f} %" for e in ended)])
    rows.append(["90 % intervals that cover", "", *(f"{c.mean():.3f}" for c in covered)])
    rows.append(["information / nat", "", *(f"{g.mean():.2f}" for g in gains)])
    if config.output is not None:
        config.output.mkdir(parents=True, exist_ok=True)
        told = {"gains": gains.tolist(), "ended": ended.tolist(), "covered": covered.tolist()}
        write_json(config.output / "family.json", {"policies": names, **told})
    heading = "D-efficiency beside efe: median / 10 % quantile"
    print_texts_and_tables(heading, format_table(("oscillators", "number", *names), rows, markdown=True, n_labels=2))


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
