"""Run the benchmarks: `make bench`, or ``python -m benchmarks --help``."""

import importlib
import inspect
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from agents.cli import run_script
from agents.result_files import package_versions, write_json
from benchmarks.peer_process import Peers
from benchmarks.section_tables import Section, print_section, print_verdicts
from benchmarks.timed_rounds import CORES

SectionName = Literal["estimators", "environments", "training", "decisions", "roofline", "scaling", "startup"]

#: Variables that set threads.
_SETTINGS = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "NUMBA_NUM_THREADS", "NUMBA_THREADING_LAYER")


@dataclass(frozen=True)
class Config:
    """Timed comparisons of the estimator, the environments and the training, with others and with the machine.

    All rows of a section are timed in turns, in the same run. Needs about 15 minutes and a quiet machine.
    """

    sections: tuple[SectionName, ...] = (
        "estimators", "environments", "training", "decisions", "roofline", "scaling", "startup",
    )  # fmt: skip
    """Parts to run."""
    repetitions: int = 5
    """Rounds; every row is run once in each. At least 5 for results to be quoted."""
    peers: bool = True
    """Install and run the packages to compare with, in .venv-peers."""
    json: Path | None = None
    """File for all values."""
    figure: Path = Path("runs/benchmarks/scaling.png")
    """File for the figure of the section scaling."""


def main(config: Config) -> None:
    """Run the sections, print each when it is finished, and the targets at the end."""
    from rich.console import Console

    if config.repetitions < 1:
        raise ValueError(f"repetitions must be at least 1, but is {config.repetitions}; 5 is the least to quote")
    started = time.perf_counter()
    status = Console(stderr=True).status("Starting")
    sections: dict[str, Section] = {}
    with tempfile.TemporaryDirectory() as folder:
        samples = Path(folder) / "samples.npz"
        with Peers(samples, config.peers) as peers:
            machine = describe_machine()
            used = {"ours": package_versions("llvmlite", "stable-baselines3", "torch"), "peers": peers.versions()}
            print_head(machine, used, config.repetitions)
            with status:
                on_row: Callable[[str], None] = status.update
                for name in config.sections:
                    sections[name] = _run(name, config, peers, samples, on_row)
                    print_section(sections[name])
    print_verdicts(list(sections.values()))
    print(f"\n{(time.perf_counter() - started) / 60:.1f} minutes; load at the end: {_load()}")
    if config.json is not None:
        content = {"machine": machine, "versions": used, "repetitions": config.repetitions}
        write_json(config.json, content | {"sections": {name: section.to_dict() for name, section in sections.items()}})
        print(config.json)


def _run(name: str, config: Config, peers: Peers, samples: Path, on_row: Callable[[str], None]) -> Section:
    """Run one section; import its module only now, so that it does not take memory and threads from the others."""
    module = importlib.import_module(f"benchmarks.{name}")
    if name == "estimators":
        module.write_samples(samples)
    arguments: dict[str, Any] = {**vars(config), "peers": peers, "on_row": on_row}
    section: Section = module.run(**{each: arguments[each] for each in inspect.signature(module.run).parameters})
    return section


def describe_machine() -> dict[str, Any]:
    """Processor, cores, versions, load and settings of threads."""
    processor = cpuinfo()
    return {
        "processor": f"{processor.get('model name', 'unknown processor')} (family {processor.get('cpu family', '?')})",
        "cores": CORES,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "load_before": _load(),
        "settings": {name: os.environ[name] for name in _SETTINGS if name in os.environ},
    }


def print_head(machine: dict[str, Any], versions: dict[str, dict[str, str]], repetitions: int) -> None:
    """Print the machine, the versions, and how to read what follows."""
    settings = ", ".join(f"{name}={value}" for name, value in machine["settings"].items()) or "none set"
    print(f"{machine['processor']}, {machine['cores']} cores, {machine['system']}")
    print(f"Load before: {machine['load_before']}. Thread settings: {settings}")
    for name, found in versions.items():
        print(f"{name}: " + (", ".join(f"{package} {number}" for package, number in found.items()) or "none"))
    print(f"Median [minimum, maximum] of {repetitions} repetitions, all rows of a section in turns. Ratios of medians.")


def cpuinfo() -> dict[str, str]:
    """Linux's description of the first processor; elsewhere the processor's name alone, or nothing."""
    try:
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
    except OSError:
        return {"model name": platform.processor()} if platform.processor() else {}
    fields = (line.partition(":") for line in lines)
    return {name.strip(): value.strip() for name, _, value in fields}


def _load() -> str:
    return ", ".join(f"{load:.2f}" for load in os.getloadavg()) if hasattr(os, "getloadavg") else "unknown"


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
