"""Print the compatibility table: ``python -m benchmarks.compat [LIBRARY ...]``."""

import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from importlib.metadata import version

from benchmarks.compat.library_rows import CELLS, Gymnasium, Minari, RLlib, StableBaselines3, Tianshou, TorchRL

LIBRARIES = {kind.__name__: kind for kind in (Gymnasium, TorchRL, Tianshou, StableBaselines3, RLlib, Minari)}


def cell(run: Callable[[], None] | None) -> str:
    """``yes``, ``-`` where there is nothing to run, or the error."""
    if run is None:
        return "-"
    try:
        run()
    except Exception as error:
        return f"{type(error).__name__}: {error}".split("\n")[0][:100]
    return "yes"


def row(name: str) -> list[str]:
    """The row of a library, run in this process: its name and version, and its cells."""
    warnings.simplefilter("ignore")
    library = LIBRARIES[name]()
    return [f"{name} {version(library.package)}", *(cell(getattr(library, each)) for each in CELLS)]


def main() -> int:
    """Print the table; the exit status is the number of cells that failed."""
    if len(sys.argv) == 3 and sys.argv[1] == "--row":
        print("\n" + json.dumps(row(sys.argv[2])))
        return 0
    print(f"| with Gymnasium {version('gymnasium')} | {' | '.join(CELLS)} |\n|---|{'---|' * len(CELLS)}", flush=True)
    failed = 0
    for name in sys.argv[1:] or LIBRARIES:
        with tempfile.TemporaryDirectory() as folder:  # for Minari's data sets
            command = [sys.executable, "-m", "benchmarks.compat", "--row", name]
            environment = {**os.environ, "MINARI_DATASETS_PATH": folder}
            done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        cells = json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else [name, *[done.stderr[-100:]] * 4]
        failed += sum(each not in ("yes", "-") for each in cells[1:])
        print(f"| {' | '.join(cells)} |", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
