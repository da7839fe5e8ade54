"""Train five seeds on a Ray cluster of two nodes, kill one node in mid-training, and compare with runs without Ray.

$ python -m benchmarks.ray_node_kill

Both nodes are processes of this machine, with their own processes for the seeds. All processes of one node get SIGKILL
at once, as in a loss of power. The exit status is the number of failed seeds. A seed passes if it finishes with the
weights of the run without Ray, bit for bit, and loses at most the samples between two checkpoints. Needs Ray: it runs
in the environment of ``make compat``.
"""

import csv
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from signal import SIGKILL, SIGSTOP

from agents.console_output import format_table, print_texts_and_tables
from estimator.support.optional_dependencies import require_packages

ROOT = Path(__file__).parents[1]

#: Trainings, samples and checkpoints of each, and samples of a roll-out.
SEEDS, STEPS, CHECKPOINTS, ROLLOUT = 5, 40_960, 8, 1_024

#: Samples between checkpoints.
INTERVAL = STEPS // CHECKPOINTS

#: Options of a slow training: many gradient steps for few samples.
WORDS = (
    "--env", "duffing_env/Short-v0", "--steps", str(STEPS), "--checkpoints", str(CHECKPOINTS), "--seeds", str(SEEDS),
    "--systems", "0", "--ppo.num-envs", "64", "--ppo.n-steps", "16", "--ppo.batch-size", "64", "--ppo.n-epochs", "10",
)  # fmt: skip

#: Longest wait [s]; more than any step takes.
LONGEST = 3600.0


def begin(output: Path, *words: str, **environment: str) -> subprocess.Popen:
    """Train all seeds into a folder, in a process of its own."""
    command = [sys.executable, str(ROOT / "train.py"), *WORDS, "--output", str(output), *words]
    variables = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.Popen(command, cwd=ROOT, env=variables, stdout=subprocess.DEVNULL)


def children(pid: int) -> list[int]:
    """Direct child processes of a process."""
    lists = [path.read_text().split() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return [int(child) for each in lists for child in each]


def at_work(pids: list[int], output: Path) -> set[int]:
    """Seeds whose log one of the processes has open."""
    places = set()
    for file in (file for pid in pids for file in Path(f"/proc/{pid}/fd").glob("*")):
        with suppress(OSError):  # a file may be closed meanwhile
            places.add(file.readlink())
    return {seed for seed in range(SEEDS) if output / str(seed) / "progress.csv" in places}


def rows(run: Path) -> list[dict[str, str]]:
    """Rows of a run's log, one for each roll-out."""
    return [row for row in csv.DictReader((run / "progress.csv").read_text().splitlines()) if None not in row.values()]


def steps_of(row: dict[str, str]) -> int:
    """Samples until the end of a roll-out."""
    return int(row["time/total_timesteps"])


def begun_at(run: Path) -> list[int]:
    """Samples at which each attempt began: the first row of an attempt has no update."""
    return [steps_of(row) - ROLLOUT for row in rows(run) if not row["train/n_updates"]]


def is_midway(run: Path) -> bool:
    """Whether a run has a checkpoint, and samples beyond it."""
    kept = [int(state.parent.name) for state in run.glob("checkpoints/*/training.json")]
    return bool(kept) and steps_of(rows(run)[-1]) > max(kept)


def kill_in_training(node: object, output: Path) -> dict[int, int]:
    """Kill a node's processes when all its seeds are midway; return the samples of each seed until then."""
    (raylet,) = (info.process.pid for info in node.all_processes["raylet"])
    ends = time.monotonic() + LONGEST
    while time.monotonic() < ends:
        pids = [*children(raylet), raylet]
        seeds = at_work(pids, output)
        if seeds and all(is_midway(output / str(seed)) for seed in seeds):
            signal_all(pids, SIGSTOP)
            had = {seed: steps_of(rows(output / str(seed))[-1]) for seed in seeds}
            signal_all(pids, SIGKILL)
            return had
        time.sleep(0.05)
    raise TimeoutError(f"no seed of the node was midway within {LONGEST:.0f} s")


def signal_all(pids: list[int], signal: int) -> None:
    """Send a signal to processes."""
    for pid in pids:
        os.kill(pid, signal)


def main() -> int:
    """Print the table; return the number of failed seeds."""
    require_packages("ray")
    from ray.cluster_utils import Cluster

    with tempfile.TemporaryDirectory() as folder:
        alone, spread = Path(folder).resolve() / "alone", Path(folder).resolve() / "spread"
        if status := begin(alone).wait(LONGEST):
            return status
        sizes = {"object_store_memory": 10**8}
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, **sizes})
        try:
            node = cluster.add_node(num_cpus=3, **sizes)
            driver = begin(spread, "--ray", RAY_ADDRESS=cluster.address)
            killed = kill_in_training(node, spread)
            if status := driver.wait(LONGEST):
                return status
        finally:
            cluster.shutdown()
        lines, wrong = [], 0
        for seed in range(SEEDS):
            one, other = ((where / str(seed) / "policy.safetensors").read_bytes() for where in (alone, spread))
            first, *again = begun_at(spread / str(seed))
            lost = killed[seed] - again[0] if seed in killed and again else 0
            is_right = one == other and first == 0 and len(again) == (seed in killed) and 0 <= lost <= INTERVAL
            wrong += not is_right
            counts = (f"{killed[seed]:,}", f"{again[0]:,}", f"{lost:,}") if seed in killed and again else ("-",) * 3
            lines.append((str(seed), *counts, "the same" if one == other else "others"))
    titles = (
        "seed",
        "samples when its node was killed",
        "went on from",
        "lost",
        f"weights after {STEPS:,}, without Ray",
    )
    print_texts_and_tables(format_table(titles, lines, markdown=True), f"A checkpoint every {INTERVAL:,} samples.")
    return wrong


if __name__ == "__main__":
    sys.exit(main())
