"""The commands to kill: how each is started and resumed, and its measurements so far."""

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
SMALL = ["--ppo.num-envs", "8", "--ppo.n-steps", "32", "--ppo.batch-size", "64", "--ppo.no-features"]
#: 2 Hz, sampled at 50 Hz: slow enough for a busy machine.
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
    """A command.

    Attributes:
        name: in the table.
        unit: unit of the loss by a kill.
        most: that it may lose.
        promises: whether the documentation guarantees the same result.
        missing: why it cannot be tried here.
    """

    name, unit, most, promises, missing = "", "", 0.0, True, ""

    def prepare(self, folder: Path) -> None:
        """Make the folder that it is started in."""
        folder.mkdir(parents=True)

    def start(self, folder: Path) -> list[str]:
        """The words of the command line."""
        raise NotImplementedError

    def again(self, folder: Path) -> list[str]:
        """The words that go on after a kill: the same ones."""
        return self.start(folder)

    def measured(self, folder: Path) -> list[Any]:
        """What has been measured, and must be there ever after."""
        return []

    def lost(self, folder: Path) -> float:
        """What had been measured when the kill came, and is to be measured again."""
        return 0.0

    def result(self, folder: Path) -> Any:
        """What is promised to be the same."""


class Train(Case):
    """A training; eight checkpoints."""

    name, unit = "train", "of 8,192 samples (a checkpoint is 1,024)"
    most = 1024 + 256  # an update that is on its way has no row in the log

    def start(self, folder: Path) -> list[str]:
        """From nothing."""
        words = ["train", "--env", TRACK, "--steps", "8192", "--checkpoints", "8", "--eval-every", "2048"]
        return [*words, "--systems", "0", "--output", "run", *SMALL]

    def again(self, folder: Path) -> list[str]:
        """``--resume``, where there is a run."""
        run = folder / "run"
        if (run / CARD_FILE).exists() or not (run / "config.json").exists():
            return ["rig", "list"] if (run / CARD_FILE).exists() else self.start(folder)
        return ["train", "--resume", "run", "--systems", "0"]

    def measured(self, folder: Path) -> list[Any]:
        """The policies of the checkpoints."""
        return [(path.parent.name, path.read_bytes()) for path in folder.glob(f"run/checkpoints/*/{WEIGHTS_FILE}")]

    def lost(self, folder: Path) -> float:
        """Samples in the log beyond the latest checkpoint."""
        return self.lost_by(folder / "run")

    def lost_by(self, run: Path) -> float:
        """By one run."""
        log = run / "progress.csv"
        if (run / CARD_FILE).exists() or not log.exists():
            return 0.0
        steps = [int(row["time/total_timesteps"]) for row in csv.DictReader(log.read_text().splitlines())]
        kept = [int(state.parent.name) for state in run.glob(f"checkpoints/*/{STATE_FILE}")]
        return max(steps, default=0) - max(kept, default=0)

    def result(self, folder: Path) -> Any:
        """The weights."""
        return (folder / "run" / WEIGHTS_FILE).read_bytes()


class Tune(Case):
    """A search of three trials."""

    name, unit, most = "train --tune", "of 3 trials", 1.0

    def start(self, folder: Path) -> list[str]:
        """The same whenever."""
        return ["train", "--env", TRACK, "--steps", "1024", "--tune", "3", "--output", "search", *SMALL]

    def measured(self, folder: Path) -> list[Any]:
        """Trials that were finished, with their scores."""
        return [(trial.number, trial.values) for trial in self._trials(folder) if trial.state.is_finished()]

    def lost(self, folder: Path) -> float:
        """Trials that were on their way."""
        return sum(trial.state.name == "RUNNING" for trial in self._trials(folder))

    def result(self, folder: Path) -> Any:
        """The score of the first trial, which has the hyperparameters of the file; the others follow from the past."""
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
    """A comparison, over an earlier one."""

    name, unit = "evaluate", "files of before"

    def prepare(self, folder: Path) -> None:
        """With a comparison of before."""
        super().prepare(folder)
        (folder / "out").mkdir()
        (folder / "out" / "evaluation.json").write_text('{"settings": {}, "policies": {}}\n')

    def start(self, folder: Path) -> list[str]:
        """Two signals."""
        return ["evaluate", "--env", TRACK, "--policies", "uniform", "prbs", "--systems", "16", "--output", "out"]

    def result(self, folder: Path) -> Any:
        """All figures but the time that a decision took."""
        return _untimed(json.loads((folder / "out" / "evaluation.json").read_text()))


class Submit(Case):
    """The protocol, onto a board with an entry."""

    name, unit, most = "evaluate --submit", "entries of before", 0.0
    _board = "board.jsonl"

    def prepare(self, folder: Path) -> None:
        """With an entry of before."""
        super().prepare(folder)
        entry = json.loads(SHIPPED_LEADERBOARD.read_text().splitlines()[0])
        (folder / self._board).write_text(json.dumps(entry | {"name": "of before"}) + "\n")

    def start(self, folder: Path) -> list[str]:
        """A signal."""
        words = ["evaluate", "--protocol", "Short-v0", "--policies", "prbs", "--submit", "mine"]
        return [*words, "--board", self._board]

    def measured(self, folder: Path) -> list[Any]:
        """The entries."""
        return (folder / self._board).read_text().splitlines()

    def result(self, folder: Path) -> Any:
        """The latest entry, but for the time that a decision took."""
        return _untimed(json.loads(self.measured(folder)[-1]))


class Ship(Case):
    """Two seeds, over a policy that ships already."""

    name, unit = "research.studies.ship_policy", "files of before"

    def prepare(self, folder: Path) -> None:
        """Two run folders of untrained policies."""
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
        """The median of two."""
        return ["ship", "--name", "ppo/mine", "--runs", "run-0", "run-1", "--systems", "16"]

    def result(self, folder: Path) -> Any:
        """Weights and card."""
        shipped = folder / "ppo" / "mine"
        return (shipped / WEIGHTS_FILE).read_bytes(), json.loads((shipped / CARD_FILE).read_text())


class Counted(SimulatedPlant):
    """A plant that counts its samples in a file, as an instrument would know them."""

    def read(self) -> float:
        """The output, counted."""
        value = super().read()
        place = os.open("samples.count", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.write(place, b".")
        os.close(place)
        return value


def plant(rig: Rig) -> Counted:
    """What `duffing-env run --plant` asks for."""
    return Counted(rig)


class Run(Case):
    """An experiment, sample by sample against the clock."""

    name, unit, most, promises = "run", "of 216 samples", 1.0, False

    def prepare(self, folder: Path) -> None:
        """With a rig file."""
        super().prepare(folder)
        (folder / "rig.toml").write_text(RIG)

    def start(self, folder: Path) -> list[str]:
        """Four seconds of PRBS."""
        words = ["run", "rig.toml", "--plant", f"{__name__}:plant", "--policy", "prbs"]
        return [*words, "--samples", "200", "--out", "run"]

    def again(self, folder: Path) -> list[str]:
        """What was measured is identified; where nothing was, the run begins again, in a new folder."""
        if len(self.measured(folder)) > 100:
            return ["identify", "rig.toml", "run/samples.csv", "--save", "known.npz"]
        return [*self.start(folder)[:-1], "again"]

    def measured(self, folder: Path) -> list[Any]:
        """The rows."""
        file = folder / "run" / "samples.csv"
        return file.read_text().splitlines()[1:] if file.exists() else []

    def lost(self, folder: Path) -> float:
        """Samples that the plant gave, and that have no row."""
        count = folder / "samples.count"
        return (count.stat().st_size if count.exists() else 0) - len(self.measured(folder))


class Ray(Train):
    """Two seeds on Ray: a kill of the program that waits for them."""

    name = "train --ray"

    @property
    def missing(self) -> str:  # type: ignore[override]
        """Without Ray."""
        return install_hint("ray") if is_not_installed("ray") else ""

    def start(self, folder: Path) -> list[str]:
        """The same whenever."""
        return [*super().start(folder), "--seeds", "2", "--ray"]

    def again(self, folder: Path) -> list[str]:
        """The same whenever."""
        return self.start(folder)

    def measured(self, folder: Path) -> list[Any]:
        """The policies of the checkpoints."""
        found = folder.glob(f"run/*/checkpoints/*/{WEIGHTS_FILE}")
        return [(path.parts[-4], path.parent.name, path.read_bytes()) for path in found]

    def lost(self, folder: Path) -> float:
        """Samples of a seed beyond its latest checkpoint."""
        return max((self.lost_by(run) for run in folder.glob("run/*")), default=0.0)

    def result(self, folder: Path) -> Any:
        """The weights of both."""
        return [(folder / "run" / seed / WEIGHTS_FILE).read_bytes() for seed in "01"]


def _untimed(content: Any) -> Any:
    """Without what the machine's speed, the day and the command line say."""
    if isinstance(content, dict):
        names = content.keys() - {"decision_time", "date", "command"}
        return {name: _untimed(content[name]) for name in names}
    return content


CASES: dict[str, type[Case]] = {case.name: case for case in (Train, Tune, Evaluate, Submit, Ship, Run, Ray)}
