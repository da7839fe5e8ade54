"""Fixtures for all tests, where they find the Silverbox record.

The record is never in the repository. The tests look for it where `load_record` does, and in
`shared/data/silverbox` beside the checkout when `SILVERBOX_DATA` is unset.
"""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

# One thread for matrices and networks, before any of them is loaded: results then do not depend on the machine's
# number of cores, nor do the processes that run the tests fight for these. Numba's threads are the tests' own subject.
for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
# The manual's tools bring colorama, with which Numba colours the messages of every signature that does not fit.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
# A shell lets its background jobs ignore Ctrl-C, and they what they start; some tests send it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest  # noqa: E402

from duffing_env.plants.silverbox_record import SilverboxRecord, load_record, record_available  # noqa: E402

BESIDE_THE_CHECKOUT = Path(__file__).parents[2] / "shared" / "data" / "silverbox"

if not os.environ.get("SILVERBOX_DATA") and BESIDE_THE_CHECKOUT.is_dir():
    os.environ["SILVERBOX_DATA"] = str(BESIDE_THE_CHECKOUT)


@pytest.fixture(scope="session")
def record() -> SilverboxRecord:
    """The Silverbox record; the test is skipped where it is absent."""
    if not record_available():
        pytest.skip("the Silverbox record is not on this machine; set SILVERBOX_DATA")
    return load_record()


@pytest.fixture
def jumping_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let runs of this process, and their simulated plants, share a clock that jumps: none waits, and none is late."""
    from agents.hardware.clock import JumpingClock

    clock = JumpingClock()
    for module in ("experiment_run", "simulated_plant"):
        monkeypatch.setattr(f"agents.hardware.{module}.RealClock", lambda: clock)


@pytest.fixture(autouse=True)
def modules_of_the_test(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Forget the modules that a test wrote and imported: another test may give its own the same name."""
    before = set(sys.modules)
    yield
    written = str(tmp_path_factory.getbasetemp())
    for name in sys.modules.keys() - before:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(written):
            del sys.modules[name]


@pytest.fixture(autouse=True)
def no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether work takes longer than `estimator.support.progress.REPORT_INTERVAL` is for the machine to say."""
    monkeypatch.setattr("estimator.support.progress.REPORT_INTERVAL", float("inf"))


#: Files whose kernels others compile, which begin when these are done.
_LATE = ("test_external_plant_env.py", "test_cli.py", "test_saving.py", "test_identification.py", "test_own_model.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let two processes that run at once not compile the same kernels.

    The first folder is one whose first files share none.
    """
    items.sort(key=lambda item: (item.path.name in _LATE, item.path.parent.name != "duffing_env"))
