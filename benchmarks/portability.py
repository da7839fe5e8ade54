"""Run the numerical tests under several instruction sets of one machine: `make portability`.

The processor decides how a sum is grouped, whether a product is rounded before it is added, and which polynomial
computes a tanh. Settings of the libraries do so too, and let one machine compute as others would. A test that fails
under one setting and passes under another has a bound from a machine instead of from the arithmetic.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

from agents.cli import run_script
from agents.console_output import format_table, print_texts_and_tables
from benchmarks.__main__ import cpuinfo, describe_machine

ROOT = Path(__file__).parents[1]

#: Tests that compare code compiled by Numba with NumPy.
COMPILED = (
    "tests/estimator",
    "tests/duffing_env/test_continuous_plant.py",
    "tests/duffing_env/test_kernel.py",
    "tests/duffing_env/test_noise.py",
    "tests/duffing_env/test_external_plant_env.py",
    "tests/duffing_env/test_plant.py",
    "tests/duffing_env/test_rewards.py",
    "tests/duffing_env/test_simulation.py",
    "tests/agents/test_d_optimality.py",
    "tests/agents/test_efe_planner.py",
    "tests/research/benchmarks/test_coverage.py",
    "tests/research/benchmarks/test_roofline.py",
    "tests/research/benchmarks/test_pieces.py",
)
#: Tests that compare networks with torch's.
NETWORKS = (
    "tests/agents/test_evaluation.py",
    "tests/agents/test_rollout_features.py",
    "tests/agents/test_trained_policy.py",
    "tests/agents/test_sb3_vec_env.py",
)
#: Tests of code on NumPy and SciPy.
ARRAYS = (
    "tests/estimator",
    "tests/duffing_env/test_silverbox.py",
    "tests/duffing_env/test_twin.py",
    "tests/agents/test_excitations.py",
    "tests/agents/test_signals.py",
)


@dataclass(frozen=True)
class Setting:
    """Environment variables that choose instructions.

    Attributes:
        name: in the table.
        part: the tests of what the variables change.
        variables: of the environment.
        needs: the features that a processor must have for them, by Linux's names.
    """

    name: str
    part: tuple[str, ...]
    variables: dict[str, str] = field(default_factory=dict)
    needs: tuple[str, ...] = ()


_AVX512 = ("avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl")
_HASWELL = ("avx2", "fma", "bmi2")


def settings() -> Iterator[Setting]:
    """All settings."""
    # With a name alone, Numba would add the features of the machine to it.
    numba = {name: {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""} for name in ("generic", "haswell")}
    numba["skylake-avx512"] = {"NUMBA_CPU_NAME": "skylake-avx512", "NUMBA_CPU_FEATURES": ""}
    dispatched = " ".join(_numpy_features())
    oldest = {
        **numba["generic"],
        "ATEN_CPU_CAPABILITY": "default",
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": dispatched,
    }
    everything = tuple(dict.fromkeys(COMPILED + NETWORKS + ARRAYS))
    arrays = tuple(dict.fromkeys(NETWORKS + ARRAYS))
    yield Setting("as the machine is", everything)
    yield Setting("Numba: generic", COMPILED, numba["generic"])
    yield Setting("Numba: haswell", COMPILED, numba["haswell"], _HASWELL)
    yield Setting("Numba: skylake-avx512", COMPILED, numba["skylake-avx512"], _AVX512)
    yield Setting("torch: default", NETWORKS, {"ATEN_CPU_CAPABILITY": "default"})
    yield Setting("torch: avx2", NETWORKS, {"ATEN_CPU_CAPABILITY": "avx2"}, _HASWELL)
    yield Setting("torch: avx512", NETWORKS, {"ATEN_CPU_CAPABILITY": "avx512"}, _AVX512)
    yield Setting("OpenBLAS: Nehalem", arrays, {"OPENBLAS_CORETYPE": "Nehalem"}, ("sse4_2",))
    yield Setting("OpenBLAS: Haswell", arrays, {"OPENBLAS_CORETYPE": "Haswell"}, _HASWELL)
    yield Setting("OpenBLAS: SkylakeX", arrays, {"OPENBLAS_CORETYPE": "SkylakeX"}, _AVX512)
    yield Setting("NumPy: baseline", arrays, {"NPY_DISABLE_CPU_FEATURES": dispatched})
    yield Setting("the oldest of all four", everything, oldest, ("sse4_2",))


def _numpy_features() -> list[str]:
    """Instruction sets beyond NumPy's baseline that it uses on this machine; the names change with its versions."""
    from numpy._core import _multiarray_umath as found  # type: ignore[attr-defined]

    return [name for name in found.__cpu_dispatch__ if found.__cpu_features__[name]]


def processor_features() -> set[str]:
    """The features of this machine's processor, by Linux's names; empty where they are unknown."""
    return set(cpuinfo().get("flags", "").split())


@dataclass(frozen=True)
class Outcome:
    """Number of passed tests, names of failed ones, and their time [s]."""

    passed: int
    failed: tuple[str, ...]
    seconds: float


def run(setting: Setting, workers: int, caches: Path) -> Outcome:
    """Run the tests of a setting under it.

    Raises:
        OSError: if the tests did not start; the message has their output.
    """
    # Kernels depend on Numba's setting alone: all other settings share one cache.
    cache = caches / setting.variables.get("NUMBA_CPU_NAME", "host")
    report = caches / "report.xml"
    report.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-n", str(workers), "--dist", "loadfile"]
    started = time.perf_counter()
    finished = subprocess.run(
        [*command, f"--junitxml={report}", *setting.part],
        cwd=ROOT, env=os.environ | setting.variables | {"NUMBA_CACHE_DIR": str(cache)}, capture_output=True, text=True,
    )  # fmt: skip
    seconds = time.perf_counter() - started
    if not report.exists():
        raise OSError(f"the tests did not run under {setting.name!r}:\n{finished.stdout}{finished.stderr}")
    outcome = read_report(report, seconds)
    if finished.returncode not in (0, 1) or (finished.returncode == 1 and not outcome.failed):
        raise OSError(f"the tests did not end under {setting.name!r}:\n{finished.stdout}{finished.stderr}")
    return outcome


def read_report(path: Path, seconds: float) -> Outcome:
    """The outcomes in a pytest report (JUnit XML)."""
    passed, failed = 0, []
    for case in ElementTree.parse(path).getroot().iter("testcase"):
        kinds = {child.tag for child in case}
        if kinds & {"failure", "error"}:
            failed.append(f"{case.get('classname')}::{case.get('name')}")
        elif "skipped" not in kinds:
            passed += 1
    return Outcome(passed, tuple(failed), seconds)


@dataclass(frozen=True)
class Config:
    """Numerical tests under several instruction sets of this machine; exit status 1 if one fails."""

    only: tuple[str, ...] = ()
    """Words of the names of settings to run; none stands for all."""
    workers: int = 2
    """Number of processes."""


def main(config: Config) -> None:
    """Run all settings, printing each when it is finished, and a table at the end."""
    from rich.console import Console

    if config.workers < 1:
        raise ValueError(f"workers must be at least 1, but is {config.workers}")
    chosen = [s for s in settings() if not config.only or any(word in s.name for word in config.only)]
    if not chosen:
        raise ValueError(f"only must name a setting, but {' '.join(config.only)} is in none of their names")
    features, machine = processor_features(), describe_machine()
    print_texts_and_tables(f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}")
    rows, failed = [], []
    with tempfile.TemporaryDirectory() as folder:
        for setting in chosen:
            if features and not features.issuperset(setting.needs):
                rows.append((setting.name, "not on this processor"))
                continue
            with Console(stderr=True).status(setting.name):
                outcome = run(setting, config.workers, Path(folder))
            failed += [f"{setting.name}: {name}" for name in outcome.failed]
            rows.append((setting.name, f"{outcome.passed}", f"{len(outcome.failed)}", f"{outcome.seconds:.0f}"))
            print_texts_and_tables(f"{setting.name}: {outcome.passed} passed, {len(outcome.failed)} failed")
            print_texts_and_tables(*(f"  {name}" for name in outcome.failed))
    print_texts_and_tables(format_table(("Setting", "Passed", "Failed", "Seconds"), rows))
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
