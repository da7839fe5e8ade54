"""Fuzzing of ``duffing-env`` command lines: each must end with status 0, 1 or 2, and 2 with a message."""

import contextlib
import io
import os
import tempfile
from pathlib import Path

from hypothesis import strategies as st

from agents.commands import main
from agents.leaderboard.leaderboard_file import SHIPPED_LEADERBOARD
from benchmarks.fuzz.call_verdicts import Call
from benchmarks.fuzz.fuzz_estimators import RIG

#: Words to put behind a command.
_WORDS = [
    *("rig", "init", "list", "identify", "export", "run", "--help", "--from", "--report", "--json", "rig.toml"),
    *("record.csv", "short.csv", "none", "beam", "-1", "0", "1e999", "nan", "\ud800", "a" * 300, ".", "/dev/null"),
    *("--options", '{"num_envs": 3}', '{"autoreset_mode": "x"}', '{"max_episode_steps": "x"}', "[" * 5000, "{", "[1]"),
    *("--policies", "prbs", "unifrom", "../x", "--systems", "--env", "duffing_env/Short-v0", "CartPole-v1"),
    *("--samples", "--output", "--step", "--seed", "--plant", "os:system", "x:y", "--out", "--max-rms", "=1+1"),
    *("\x1b[31m", "", "--bound", "--board", "board.jsonl"),
]  # fmt: skip

#: Commands.
_FIRST = [
    *(["rig", "list"], ["rig", "init"], ["identify"], ["run"], ["report"], ["report", "--board", "board.jsonl"], []),
    *(["evaluate", "--systems", "1"], ["evaluate", "--protocol"], ["export"], ["export", "prbs", "--output", "x.csv"]),
    *(["design", "--samples", "8", "--policy", "prbs"], ["train", "--steps", "0"]),
]  # fmt: skip


def calls() -> st.SearchStrategy[Call]:
    """Calls of the command ``duffing-env``."""
    place = Path(tempfile.mkdtemp(prefix="fuzz-"))
    os.chdir(place)
    Path("rig.toml").write_text(RIG.to_toml())
    Path("record.csv").write_text("u,y\n" + "1,2\n" * 60)
    Path("board.jsonl").write_text(SHIPPED_LEADERBOARD.read_text().splitlines()[0] + "\n{}\n")
    Path("short.csv").write_text("u,y\n1,2\n")

    @st.composite
    def call(draw: st.DrawFn) -> Call:
        first = draw(st.sampled_from(_FIRST))
        words = [*first, *draw(st.lists(st.one_of(st.sampled_from(_WORDS), st.text(max_size=5)), max_size=4))]

        def function() -> str:
            printed, errors = io.StringIO(), io.StringIO()
            status: object = 0
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
                try:
                    main(words)
                except SystemExit as stop:
                    status = stop.code
            said = errors.getvalue()
            if "Traceback" in said or status not in (0, 1, 2, None):
                return f"status {status}: {said[:200]}"
            return "status 2 without a message" if status == 2 and not (said or printed.getvalue()).strip() else ""

        return Call(f"duffing-env {' '.join(first)}", function, ("must",), sound=str)

    return call()
