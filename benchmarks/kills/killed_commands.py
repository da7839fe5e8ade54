"""The commands to kill: how each starts and resumes, what it has measured, and how much a kill may lose."""

import csv
import json
import os
from pathlib import Path
from typing import Any

from agents.hardware.simulated_plant import SimulatedPlant
from agents.leaderboard.leaderboard_file import SHIPPED_LEADERBOARD
from agents.policies.networks.trained_policy import CARD_FILE, WEIGHTS_FILE
from agents.training.checkpoints import STATE_FILE
from estimator import Rig
from estimator.support.optional_dependencies import install_hint, is_not_installed

TRACK = "duffing_env/Short-v0"

#: Options of a training that lasts seconds.
SMALL = ["--ppo.num-envs", "8", "--ppo.n-steps", "32", "--ppo.batch-size", "64", "--ppo.no-features"]

#: An oscillator of 2 Hz, sampled at 50 Hz: slow enough for a busy machine.
RIG = """step = 0.02
[input]
unit = "N"
limit = 4.0
noise = 0.01
[output]
unit = "m"
range = 0.08
noise = 2e-5
[guess]
m = [0.8, 1.25]
c = [0.5, 1.6]
a = [110.0, 180.0]
b = [4e4, 1.4e5]
"""


class Case:
    """A command to kill.

    Attributes:
        name: name in the table.
        unit: unit of a loss.
        most: largest loss that passes, in this unit.
        promises: whether the documentation guarantees the same result after a kill.
        missing: why the command cannot run here; empty where it can.
    """

    name, unit, most, promises, missing = "", "", 0.0, True, ""

    def prepare(self, folder: Path) -> None:
        """Make the folder in which the command starts."""
        folder.mkdir(parents=True)

    def start(self, folder: Path) -> list[str]:
        """The words of the command line that starts the command."""
        raise NotImplementedError

    def again(self, folder: Path) -> list[str]:
        """The words that resume the command after a kill; the same by default."""
        return self.start(folder)

    def measured(self, folder: Path) -> list[Any]:
        """What the folder holds and a kill must not take away."""
        return []

    def lost(self, folder: Path) -> float:
        """Work done before the kill that has to be done again."""
        return 0.0

    def result(self, folder: Path) -> Any:
        """The result that must equal the result without a kill."""


class Train(Case):
    """A training with eight checkpoints."""

    name, unit = "train", "of 8,192 samples (a checkpoint is 1,024)"
    most = 1024 + 256  # a checkpoint, and the update in progress, which the log does not hold yet

    def start(self, folder: Path) -> list[str]:
        """A new run."""
        words = ["train", "--env", TRACK, "--steps", "8192", "--checkpoints", "8", "--eval-every", "2048"]
        return [*words, "--systems", "0", "--output", "run", *SMALL]

    def again(self, folder: Path) -> list[str]:
        """``--resume``; a new run where none has begun, and nothing to do where it has ended."""
        run = folder / "run"
        if (run / CARD_FILE).exists():
            return ["rig", "list"]
        if not (run / "config.json").exists():
            return self.start(folder)
        return ["train", "--resume", "run", "--systems", "0"]

    def measured(self, folder: Path) -> list[Any]:
        """The policies of the checkpoints."""
        return [(path.parent.name, path.read_bytes()) for path in folder.glob(f"run/checkpoints/*/{WEIGHTS_FILE}")]

    def lost(self, folder: Path) -> float:
        """Samples in the log beyond the latest checkpoint."""
        return self.lost_by_run(folder / "run")

    def lost_by_run(self, run: Path) -> float:
        """Samples in the log of a run folder beyond its latest checkpoint."""
        log = run / "progress.csv"
        if (run / CARD_FILE).exists() or not log.exists():
            return 0.0
        steps = [int(row["time/total_timesteps"]) for row in csv.DictReader(log.read_text().splitlines())]
        kept = [int(state.parent.name) for state in run.glob(f"checkpoints/*/{STATE_FILE}")]
        return max(steps, default=0) - max(kept, default=0)

    def result(self, folder: Path) -> Any:
        """The network's weights."""
        return (folder / "run" / WEIGHTS_FILE).read_bytes()


class Tune(Case):
    """A search of three trials."""

    name, unit, most = "train --tune", "of 3 trials", 1.0

    def start(self, folder: Path) -> list[str]:
        """The same at first and after a kill."""
        return ["train", "--env", TRACK, "--steps", "1024", "--tune", "3", "--output", "search", *SMALL]

    def measured(self, folder: Path) -> list[Any]:
        """Finished trials, with their scores."""
        return [(trial.number, trial.values) for trial in self._trials(folder) if trial.state.is_finished()]

    def lost(self, folder: Path) -> float:
        """Trials in progress."""
        return sum(trial.state.name == "RUNNING" for trial in self._trials(folder))

    def result(self, folder: Path) -> Any:
        """The score of the first trial, whose hyperparameters are fixed; the others follow earlier scores."""
        return next(trial.values for trial in self._trials(folder) if trial.state.name == "COMPLETE")

    def _trials(self, folder: Path) -> list[Any]:
        import optuna

        log = folder / "search" / "study.log"
        if not log.exists():
            return []
        storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(log)))
        studies = optuna.get_all_study_names(storage)
        return optuna.load_study(study_name=studies[0], storage=storage).trials if studies else []


class Evaluate(Case):
    """A comparison that replaces an earlier one."""

    name, unit = "evaluate", "earlier files"

    def prepare(self, folder: Path) -> None:
        """Write an earlier comparison."""
        super().prepare(folder)
        (folder / "out").mkdir()
        (folder / "out" / "evaluation.json").write_text('{"settings": {}, "policies": {}}\n')

    def start(self, folder: Path) -> list[str]:
        """Compare two signals."""
        return ["evaluate", "--env", TRACK, "--policies", "uniform", "prbs", "--systems", "16", "--output", "out"]

    def result(self, folder: Path) -> Any:
        """All numbers except the time of a decision."""
        return _untimed(json.loads((folder / "out" / "evaluation.json").read_text()))


class Submit(Case):
    """A measurement by the protocol, added to a board that holds an entry."""

    name, unit, most = "evaluate --submit", "earlier entries", 0.0
    _board = "board.jsonl"

    def prepare(self, folder: Path) -> None:
        """Write a board with one entry."""
        super().prepare(folder)
        entry = json.loads(SHIPPED_LEADERBOARD.read_text().splitlines()[0])
        (folder / self._board).write_text(json.dumps(entry | {"name": "earlier"}) + "\n")

    def start(self, folder: Path) -> list[str]:
        """Submit a signal."""
        words = ["evaluate", "--protocol", "Short-v0", "--policies", "prbs", "--submit", "mine"]
        return [*words, "--board", self._board]

    def measured(self, folder: Path) -> list[Any]:
        """Entries of the board."""
        return (folder / self._board).read_text().splitlines()

    def result(self, folder: Path) -> Any:
        """The latest entry, without the time of a decision."""
        return _untimed(json.loads(self.measured(folder)[-1]))


class Ship(Case):
    """The shipping of one of two seeds in place of a policy that ships already."""

    name, unit = "research.studies.ship_policy", "earlier files"

    def prepare(self, folder: Path) -> None:
        """Write two run folders of untrained policies, and a policy that ships."""
        from stable_baselines3 import PPO

        from agents.policies.networks.policy_saving import save_policy
        from agents.sb3_vec_env import DuffingVecEnv

        super().prepare(folder)
        envs = DuffingVecEnv(TRACK, 2)
        for seed in range(2):
            settings: dict[str, Any] = {"net_arch": [8], "log_std_init": -1.0}
            model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, policy_kwargs=settings, seed=seed, device="cpu")
            config = {"env": TRACK, "reward": "information_gain", "options": {}, "seed": seed, "output": str(seed)}
            card = {"algorithm": "ppo", "config": config, "command": ["train.py"]}
            save_policy(folder / f"run-{seed}", model, card)
        save_policy(folder / "ppo" / "mine", model, card)

    def start(self, folder: Path) -> list[str]:
        """Ship the median of the two."""
        return ["ship", "--name", "ppo/mine", "--runs", "run-0", "run-1", "--systems", "16"]

    def result(self, folder: Path) -> Any:
        """The shipped weights and card."""
        shipped = folder / "ppo" / "mine"
        return (shipped / WEIGHTS_FILE).read_bytes(), json.loads((shipped / CARD_FILE).read_text())


class Counted(SimulatedPlant):
    """A simulated plant that counts its samples in a file, as an instrument would."""

    def read(self) -> float:
        """Measure the output, and count it."""
        value = super().read()
        place = os.open("samples.count", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.write(place, b".")
        os.close(place)
        return value


def plant(rig: Rig) -> Counted:
    """Make the plant for ``duffing-env run --plant``."""
    return Counted(rig)


class Run(Case):
    """An experiment in real time, sample by sample."""

    name, unit, most, promises = "run", "of 216 samples", 1.0, False

    def prepare(self, folder: Path) -> None:
        """Write a rig file."""
        super().prepare(folder)
        (folder / "rig.toml").write_text(RIG)

    def start(self, folder: Path) -> list[str]:
        """Run four seconds of PRBS."""
        words = ["run", "rig.toml", "--plant", f"{__name__}:plant", "--policy", "prbs"]
        return [*words, "--samples", "200", "--out", "run"]

    def again(self, folder: Path) -> list[str]:
        """Identify what was measured; begin again in a new folder where that is at most 100 samples."""
        if len(self.measured(folder)) > 100:
            return ["identify", "rig.toml", "run/samples.csv", "--save", "known.npz"]
        return [*self.start(folder)[:-1], "again"]

    def measured(self, folder: Path) -> list[Any]:
        """Rows of the samples."""
        file = folder / "run" / "samples.csv"
        return file.read_text().splitlines()[1:] if file.exists() else []

    def lost(self, folder: Path) -> float:
        """Samples of the plant that have no row."""
        count = folder / "samples.count"
        return (count.stat().st_size if count.exists() else 0) - len(self.measured(folder))


class Ray(Train):
    """Trainings of two seeds on Ray; the program that waits for them is killed."""

    name = "train --ray"

    @property
    def missing(self) -> str:  # type: ignore[override]
        """Whether Ray is not installed."""
        return install_hint("ray") if is_not_installed("ray") else ""

    def start(self, folder: Path) -> list[str]:
        """A run of two seeds."""
        return [*super().start(folder), "--seeds", "2", "--ray"]

    def again(self, folder: Path) -> list[str]:
        """The same command, which resumes by itself."""
        return self.start(folder)

    def measured(self, folder: Path) -> list[Any]:
        """The policies of the checkpoints."""
        found = folder.glob(f"run/*/checkpoints/*/{WEIGHTS_FILE}")
        return [(path.parts[-4], path.parent.name, path.read_bytes()) for path in found]

    def lost(self, folder: Path) -> float:
        """Samples of a seed beyond its latest checkpoint; the larger of both."""
        return max((self.lost_by_run(run) for run in folder.glob("run/*")), default=0.0)

    def result(self, folder: Path) -> Any:
        """The weights of both networks."""
        return [(folder / "run" / seed / WEIGHTS_FILE).read_bytes() for seed in "01"]


def _untimed(content: Any) -> Any:
    """Leave out what depends on the speed of the machine, the day and the command line."""
    if isinstance(content, dict):
        names = content.keys() - {"decision_time", "date", "command"}
        return {name: _untimed(content[name]) for name in names}
    return content


CASES: dict[str, type[Case]] = {case.name: case for case in (Train, Tune, Evaluate, Submit, Ship, Run, Ray)}
