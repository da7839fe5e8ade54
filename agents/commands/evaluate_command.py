"""``duffing-env evaluate``: compare policies, or measure one by the evaluation protocol."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from agents.json_options import JsonOptions
from agents.track_ids import RIG_TRACK, check_is_duffing_track, full_track_id, options_with_rig

#: Options that may be given with ``protocol``.
_PROTOCOL_OPTIONS = ("policies", "protocol", "submit", "samples", "board")


@dataclass(frozen=True)
class EvaluateCommand:
    """Compare policies on common random numbers: a table, JSON and figures.

    $ duffing-env evaluate                                     what ships
    $ duffing-env evaluate --policies runs/demo prbs           a run and PRBS
    $ duffing-env evaluate --policies lab:Mine prbs            Mine, in lab.py
    $ duffing-env evaluate --policies "ppo=runs/ppo-*-[0-4]"   seeds as one
    $ duffing-env evaluate --report runs/report                as an HTML page
    $ duffing-env evaluate --rig rig.toml --policies efe       on your own rig
    $ duffing-env evaluate --options '{"max_output": 0.3}'     another limit
    $ duffing-env evaluate --protocol Short-v0 --policies lab:Mine --submit Mine
    """

    policies: tuple[str, ...] = ()
    """Names, run folders, module:name, or TITLE=PATTERN for folders of seeds; the default policies if none."""
    env: str | None = None
    """Track, such as Short-v0; Amplitude-v0 where it is not given."""
    rig: str | None = None
    """Rig file, or the name of a rig that ships; the track is then Rig-v0."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    systems: int = 256
    """Systems of the comparison, the same for every policy."""
    seed: int = 0
    """Seed of systems and noise."""
    output: Path = Path("runs/evaluation")
    """Folder for evaluation.json and the figures."""
    report: Path | None = None
    """Folder for a report in place of figures: one HTML page, and evaluation.json."""
    protocol: str | None = None
    """Track, such as Short-v0, to measure one policy by docs/protocol.md, which fixes all other settings."""
    submit: str | None = None
    """Add the result to the board under this name."""
    samples: int | None = None
    """Training samples of the policy, for the board; a run folder holds them itself."""
    board: Path = Path("runs/leaderboard.jsonl")
    """File of the board."""

    def __post_init__(self) -> None:
        if self.rig is not None and self.env is not None and full_track_id(self.env) != RIG_TRACK:
            raise ValueError(f"env must be left out with rig, whose track is Rig-v0, but is {self.env}; leave one out")
        check_is_duffing_track(self._track)
        if self.protocol is not None and len(self.policies) != 1:
            raise ValueError(f"policies must name one for the protocol, but are {list(self.policies)}; name one")
        if self.protocol is None and self.submit is not None:
            raise ValueError("submit goes with a protocol, but protocol is None; add e.g. --protocol Short-v0")

    @property
    def _track(self) -> str:
        return RIG_TRACK if self.rig is not None else full_track_id("Amplitude-v0" if self.env is None else self.env)

    def _check_protocol(self, track: str) -> None:
        """Refuse settings that the protocol fixes."""
        given = replace(self, env=None) if full_track_id(self.env) == track else self
        defaults = asdict(EvaluateCommand())
        for name, value in asdict(given).items():
            if name not in _PROTOCOL_OPTIONS and value != defaults[name]:
                raise ValueError(f"protocol fixes all but the policy, but {name} is {value}; leave it out")

    def run(self) -> None:
        """Compare or measure, and print where the files are."""
        if self.protocol is not None:
            self._run_protocol(self.protocol)
            return
        from agents.evaluation.comparison import compare_policies, default_policies

        options = options_with_rig(self.options, self.rig)
        folder = self.report if self.report is not None else self.output
        compare_policies(
            self.policies or default_policies(self._track, options), self._track, self.systems, options, folder,
            seed=self.seed, as_report=self.report is not None,
        )  # fmt: skip

    def _run_protocol(self, protocol: str) -> None:
        from agents.console_output import format_table, print_in_80_columns, print_texts_and_tables
        from agents.leaderboard.leaderboard_file import append_entry, check_new_entry
        from agents.leaderboard.leaderboard_tables import COLUMN_TITLES, LEADERBOARD_CAPTION, entry_cells
        from agents.leaderboard.protocol import measure_policy
        from estimator.support.progress import show_progress

        (policy,) = self.policies
        track = full_track_id(protocol)
        self._check_protocol(track)
        tracks_with_name = set() if self.submit is None else check_new_entry(self.board, self.submit)
        with show_progress("Measuring") as on_progress:
            name = policy.partition("=")[0] if self.submit is None else self.submit
            entry = measure_policy(policy, track, name, self.samples, on_progress)
        # The result is printed also where the board cannot be written.
        try:
            if self.submit is not None:
                append_entry(self.board, entry)
        finally:
            print_texts_and_tables(track, format_table(COLUMN_TITLES, [entry_cells(entry)]), LEADERBOARD_CAPTION)
        if self.submit is not None:
            print_in_80_columns(f"{self.submit} is on the board {self.board}: duffing-env report")
            if track in tracks_with_name:
                print_in_80_columns(
                    f"The board had {self.submit} on {track} before; the report shows the latest entry of a name."
                )
