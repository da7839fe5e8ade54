"""Child processes that run rows of the benchmark, among them the peers in their own virtual environment."""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from benchmarks.timed_rounds import Row

ROOT = Path(__file__).parents[1]
LOCK = Path(__file__).with_name("peers.lock")
ENVIRONMENT = ROOT / ".venv-peers"


class NotAvailable(RuntimeError):
    """A peer cannot run here; the message says why."""


def ensure_environment() -> Path:
    """Build the peers' environment from its lock, where that is not done; return its Python.

    Where the whole lock cannot be installed, its lines are installed one by one, as far as possible: the rows of
    what is missing then say so.

    Raises:
        NotAvailable: if not even an empty environment can be made.
    """
    python = ENVIRONMENT / "bin" / "python"
    stamp = ENVIRONMENT / ".ready"
    digest = hashlib.sha256(LOCK.read_bytes()).hexdigest()
    if stamp.is_file() and stamp.read_text() == digest:
        return python
    print(f"Installing the peers into {ENVIRONMENT.name} (about a minute)", flush=True)
    made = subprocess.run([sys.executable, "-m", "venv", "--clear", ENVIRONMENT], capture_output=True, text=True)
    if made.returncode:
        raise NotAvailable(f"{ENVIRONMENT.name} cannot be made: {_last_line(made.stderr or made.stdout)}")
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    installed = subprocess.run([*install, "--requirement", str(LOCK)], capture_output=True, text=True)
    if installed.returncode:
        print(f"The lock as a whole cannot be installed: {_last_line(installed.stderr)}; trying line by line")
        for line in LOCK.read_text().splitlines():
            if line and not line.startswith("#") and subprocess.run([*install, line], capture_output=True).returncode:
                print(f"  not installed: {line}", flush=True)
    else:
        stamp.write_text(digest)
    return python


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no reason given"


def unpack_version(commit: str, folder: Path) -> None:
    """Write the tree of a commit of this project into a folder."""
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True).stdout
    subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)


class Child:
    """A process that runs rows, one request at a time (`benchmarks.peers` has the requests). A context manager.

    Args:
        command: that starts it.
        cwd: where it runs; None for here.
        settings: environment variables, besides this process's.
    """

    def __init__(
        self, command: Sequence[str | Path] = (), cwd: Path | None = None, settings: Mapping[str, str] | None = None
    ) -> None:
        self._command, self._cwd = list(command), cwd
        self._settings = {**os.environ, **(settings or {})}
        self._process: subprocess.Popen[str] | None = None
        self._reason = ""
        self.answers: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def _stop(self) -> int:
        """End the process by closing its input; return its exit status."""
        if self._process is None:
            return 0
        process, self._process = self._process, None
        with process:
            try:
                process.communicate(timeout=30)
            except subprocess.TimeoutExpired:
                process.kill()
        return process.returncode

    def row(self, name: str, title: str, unit: str) -> Row:
        """Make a row from the process's row ``name``, under another title."""

        def run(count: int) -> tuple[float, float]:
            answer = self.ask(name, count)
            self.answers[title] = answer
            return answer["seconds"], answer["work"]

        return Row(title, unit, run)

    def ask(self, name: str, count: int) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Raises:
            NotAvailable: if there is no such process, the row raised, or its process died. A dead one is started anew
                for the next request.
        """
        if self._reason:
            raise NotAvailable(self._reason)
        process = self._process = self._process or subprocess.Popen(
            self._command,
            cwd=self._cwd,
            env=self._settings,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            print(json.dumps([name, count]), file=process.stdin, flush=True)
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise NotAvailable(f"the process ended with status {self._stop()}; it is started anew")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise NotAvailable(answer["error"])
        return answer


class Peers(Child):
    """The process of the peers.

    Args:
        samples: file with the samples and the prior of the estimators' rows, see `benchmarks.estimators`.
        wanted: whether there are to be peers at all; without them every row is reported as not available.
    """

    def __init__(self, samples: Path, wanted: bool = True) -> None:
        super().__init__()
        self._reason = "" if wanted else "--no-peers"
        if wanted:
            try:
                self._command = [ensure_environment(), "-I", Path(__file__).with_name("peers.py"), samples]
            except (NotAvailable, OSError) as error:
                self._reason = str(error)

    def versions(self) -> dict[str, str]:
        """Versions of the peers' packages; empty without peers."""
        try:
            return self.ask("versions", 0)
        except NotAvailable:
            return {}
