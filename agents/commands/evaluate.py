"""``duffing-env evaluate``: policies compared."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from agents.cli import RIG_TRACK, JsonOptions, check_track, with_rig


@dataclass(frozen=True)
class Evaluate:
    """Compare policies on common random numbers: a table, JSON and figures.

    $ duffing-env evaluate                                     what ships
    $ duffing-env evaluate --policies runs/demo prbs           a run and PRBS
    $ duffing-env evaluate --policies lab:Mine prbs            Mine, in lab.py
    $ duffing-env evaluate --policies "ppo=runs/ppo-*-[0-4]"   seeds as one
    $ duffing-env evaluate --report runs/report                as an HTML page
    $ duffing-env evaluate --rig rig.toml --policies efe       on your own rig
    $ duffing-env evaluate --options '{"max_output": 0.3}'     another limit
    """

    policies: tuple[str, ...] = ()
    """Names, run folders, module:name, TITLE=PATTERN for folders of seeds; what ships and the planner if none."""
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

    def run(self) -> None:
        """Compare, and say where everything is."""
        from agents.evaluation.comparison import compare, usual_policies

        options = with_rig(self.options, self.rig)
        folder = self.report if self.report is not None else self.output
        compare(
            self.policies or usual_policies(self.env, options), self.env, self.systems, options, folder,
            seed=self.seed, report=self.report is not None,
        )  # fmt: skip
