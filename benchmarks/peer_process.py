"""The peers' own environment, and the process in it that runs their rows (`benchmarks.peers`)."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

from benchmarks.timing import Row

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


class Peers:
    """The child process that runs the peers' rows, one request at a time. A context manager.

    Args:
        samples: file with the samples and the prior of the estimators' rows, see `benchmarks.estimators`.
        wanted: whether there are to be peers at all; without them every row is reported as not available.
    """

    def __init__(self, samples: Path, wanted: bool = True) -> None:
        self._samples = samples
        self._process: subprocess.Popen[str] | None = None
        self._reason = "" if wanted else "--no-peers"
        self._python = Path()
        self.answers: dict[str, dict[str, Any]] = {}
        if wanted:
            try:
                self._python = ensure_environment()
            except (NotAvailable, OSError) as error:
                self._reason = str(error)

    def __enter__(self) -> Peers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def _stop(self) -> int:
        """End the process, which does so when its input ends; its exit status."""
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
        """The row ``name`` of `benchmarks.peers`, under a title of ours."""

        def run(count: int) -> tuple[float, float]:
            answer = self.ask(name, count)
            self.answers[title] = answer
            return answer["seconds"], answer["work"]

        return Row(title, unit, run)

    def versions(self) -> dict[str, str]:
        """Versions of the peers' packages; empty without peers."""
        try:
            return self.ask("versions", 0)
        except NotAvailable:
            return {}

    def ask(self, name: str, count: int) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Raises:
            NotAvailable: if there are no peers, the row raised, or its process died. A dead one is started anew
                for the next request.
        """
        if self._reason:
            raise NotAvailable(self._reason)
        process = self._process = self._process or subprocess.Popen(
            [self._python, "-I", Path(__file__).with_name("peers.py"), self._samples],
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
            raise NotAvailable(f"the peers' process ended with status {self._stop()}; it is started anew")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise NotAvailable(answer["error"])
        return answer
