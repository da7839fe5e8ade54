"""Compare policies on common random numbers: a table, JSON and figures.

$ python evaluate.py                                        what ships, the planner and two signals
$ python evaluate.py --policies runs/demo prbs              a trained policy beside PRBS
$ python evaluate.py --policies "ppo=runs/ppo-*-[0-4]"      five training seeds as one entry
$ python evaluate.py --report runs/report                   all of it on one HTML page
$ python evaluate.py --rig rig.toml --policies efe prbs     on a rig of your own
$ python evaluate.py --options '{"max_output": 0.3}'        under another limit
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from agents.cli import RIG_TRACK, JsonOptions, check_track, run_script, with_rig


@dataclass(frozen=True)
class Config:
    """Compare policies on common random numbers."""

    policies: tuple[str, ...] = ()
    """Names of policies, run folders, TITLE=PATTERN for those of several seeds; what ships and the planner if none."""
    env: str = "duffing_env/Amplitude-v0"
    """Id of the track."""
    rig: str | None = None
    """Rig file; the track is then Rig-v0."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    systems: int = 256
    """Systems that every policy is evaluated on, the same for all."""
    seed: int = 0
    """Seed of systems and noise."""
    output: Path = Path("runs/evaluation")
    """Folder for evaluation.json and the figures."""
    report: Path | None = None
    """Folder for a report instead: one HTML page, and evaluation.json."""

    def __post_init__(self) -> None:
        if self.rig is not None:
            object.__setattr__(self, "env", RIG_TRACK)
        check_track(self.env)


def main(config: Config) -> None:
    """Compare, and say where everything is."""
    from agents.evaluation.comparison import compare, usual_policies

    options = with_rig(config.options, config.rig)
    folder = config.report if config.report is not None else config.output
    compare(
        config.policies or usual_policies(config.env, options), config.env, config.systems, options, folder,
        seed=config.seed, report=config.report is not None,
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main, Config, __doc__)
