"""Configuration of a training run: algorithm, track, reward, steps and hyperparameters, and its file config.json."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from agents.json_options import JsonOptions
from agents.policies.networks.trained_policy import CONFIG_FILE
from agents.result_files import package_versions, write_json
from agents.track_ids import RIG_TRACK, check_is_duffing_track, full_track_id, options_with_rig
from agents.training.algorithms import ALGORITHMS, AlgorithmSettings, hyperparameters_to_dict
from agents.training.environments.oscillator_family import FAMILY
from agents.training.hyperparameters import parse_hyperparameters, read_hyperparameters
from agents.user_code import check_env_options, env_spec_of
from estimator.compilation.simd import LANES
from estimator.support.argument_checks import check_choice, check_integer, check_mapping, is_finite_number, short_repr
from estimator.support.file_io import check_readable_file
from estimator.support.optional_dependencies import require_packages

#: Rewards whose sum is information [nats].
INFORMATION_REWARDS = ("information_gain", "log_posterior", "fisher", "expected_free_energy")


@dataclass(frozen=True)
class TrainingSubject:
    """Algorithm and track of a training, from which the default hyperparameters follow."""

    algo: Literal["ppo", "sac", "td3", "tqc", "recurrent_ppo"] = "ppo"
    """Algorithm."""
    env: str = "duffing_env/Amplitude-v0"
    """Track, such as Short-v0; or family: random oscillators of all kinds."""
    rig: str | None = None
    """Rig file, or the name of a rig that ships; the track is then Rig-v0."""
    settings: Path | None = None
    """TOML file of hyperparameters; the package's file where it is not given."""

    def __post_init__(self) -> None:
        if self.rig is not None and full_track_id(self.env) not in (TrainingSubject.env, RIG_TRACK):
            raise ValueError(f"env must be left out with rig, whose track is Rig-v0, but is {self.env}; leave one out")
        object.__setattr__(self, "env", RIG_TRACK if self.rig is not None else full_track_id(self.env))


@dataclass(frozen=True)
class TrainConfig(TrainingSubject):
    """Configuration of a training run, which is written to ``config.json`` of its folder."""

    reward: str = "information_gain"
    """Name of the reward, such as information_gain, log_posterior or fisher."""
    steps: int = 5_000_000
    """Samples to learn from, over all environments."""
    seed: int = 0
    """Seed of systems, noise, weights and exploration; the same seed gives the same policy."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    vary: JsonOptions = field(default_factory=dict)
    """Options that are drawn for every episode, as JSON: name to lowest and highest value."""
    output: Path | None = None
    """Run folder; runs/ALGO-TRACK-SEED where it is not given, with a number where that exists."""
    begin: Path | None = None
    """Policy folder with the initial network, of the same shape; random weights where it is not given."""
    imitate: str | None = None
    """Policy that the network imitates before it learns by reward, such as efe; with ppo alone."""
    imitations: int = 200_000
    """Samples of the imitation, over all environments."""
    checkpoints: int = 5
    """Checkpoints over the run, evenly spaced."""
    eval_every: int = 0
    """Samples between evaluations on systems held out from training; 0 for none."""
    tensorboard: bool = False
    """Whether to write a log for TensorBoard, too."""
    torch_threads: int = 1
    """Threads of torch; several change the last digits, gain little, and lose much on a busy machine."""
    hyperparameters: AlgorithmSettings = field(default=None)  # type: ignore[assignment]
    """Hyperparameters; by the file's table for the track where they are not given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("algo", self.algo, ALGORITHMS)
        if not isinstance(self.env, str):
            check_is_duffing_track(self.env)
        check_mapping("options", self.options)
        check_env_options(self.options)
        # The options hold the rig itself, because its file may change.
        object.__setattr__(self, "options", options_with_rig(self.options, self.rig))
        object.__setattr__(self, "rig", None)
        upper_bounds = {
            "steps": 10**12,
            "checkpoints": 10**4,
            "torch_threads": 1024,
            "imitations": 10**9,
            "eval_every": 10**12,
            "seed": 2**32 - 1,
        }
        for name, upper_bound in upper_bounds.items():
            check_integer(name, getattr(self, name), upper_bound, 0 if name in ("eval_every", "seed") else 1)
        if self.tensorboard:
            require_packages("tensorboard")
        if "reward" in self.options:
            raise ValueError(f"options must not hold reward, but are {self.options}; give it as reward")
        if "branch" in self.options:
            raise ValueError(
                f"options must not hold branch, but are {self.options}; the other branches are for comparison"
            )
        if self.env != FAMILY:
            check_is_duffing_track(self.env)
        elif self.options or self.eval_every or self.algo != "ppo":
            raise ValueError(
                f"env {FAMILY!r} takes no options, no eval_every, and ppo alone; leave them out, and compare from "
                "a checkout of the repository, with python -m research.studies.unseen_oscillators"
            )
        if self.hyperparameters is None:
            object.__setattr__(self, "hyperparameters", read_hyperparameters(self.algo, self.env, self.settings))
        if type(self.hyperparameters) is not ALGORITHMS[self.algo]:
            raise ValueError(
                f"hyperparameters must be {ALGORITHMS[self.algo].__name__} for {self.algo}, "
                f"but are {type(self.hyperparameters).__name__}"
            )
        if self.hyperparameters.features and self.env != FAMILY:
            _check_observation(self)
        if self.vary:
            object.__setattr__(self, "vary", _checked_option_ranges(self))
        if self.imitate is not None:
            _check_imitation(self)
        if (first := getattr(self.hyperparameters, "learning_starts", 0)) >= self.steps:
            raise ValueError(
                f"learning_starts must be below steps, but is {first} of {self.steps}: nothing would be learned; "
                "lower it, or take more steps"
            )

    @property
    def samples(self) -> int:
        """Number of samples of the training: ``steps``, rounded up to a whole number of updates."""
        per_update = self.hyperparameters.samples_per_update
        return -(-self.steps // per_update) * per_update


def _check_observation(config: TrainConfig) -> None:
    """Refuse an observation without features."""
    observation = {**env_spec_of(config.env).kwargs, **config.options}.get("observation", "posterior")
    if observation != "posterior":
        raise ValueError(
            f"observation must be 'posterior' with features, but is {short_repr(observation)}; "
            f"add --{config.algo.replace('_', '-')}.no-features"
        )


def _check_imitation(config: TrainConfig) -> None:
    """Refuse a configuration that cannot imitate a policy."""
    if config.algo != "ppo" or not config.hyperparameters.features or config.env == FAMILY or config.vary:
        raise ValueError(
            f"imitate needs ppo with features on one track, but algo is {config.algo}, features "
            f"{config.hyperparameters.features}, env {config.env}, vary {config.vary}; leave imitate out"
        )
    if config.begin is not None:
        raise ValueError(f"imitate must be left out with begin, but is {config.imitate!r}; choose one of them")


def _checked_option_ranges(config: TrainConfig) -> dict[str, list[float]]:
    """The range of each varied option, checked."""
    check_mapping("vary", config.vary)
    if config.env == FAMILY or not config.hyperparameters.features or config.reward not in INFORMATION_REWARDS:
        raise ValueError(
            f"vary needs a track, features and a reward of {', '.join(INFORMATION_REWARDS)}, but env is "
            f"{config.env}, features {config.hyperparameters.features}, reward {config.reward}; leave vary out"
        )
    if (num_envs := config.hyperparameters.num_envs) % LANES:
        raise ValueError(
            f"num_envs must be a multiple of {LANES} with vary, but is {num_envs}; take {num_envs + -num_envs % LANES}"
        )
    if duplicates := sorted(set(config.vary) & set(config.options)):
        raise ValueError(f"vary must not hold what options hold, but both have {duplicates[0]}; leave it out of one")
    for name, bounds in config.vary.items():
        bounds = list(bounds) if isinstance(bounds, list | tuple) else [bounds]
        if len(bounds) != 2 or not all(is_finite_number(end) for end in bounds) or not 0 < bounds[0] <= bounds[1]:
            raise ValueError(
                f"vary[{name!r}] must be two positive numbers, the lower one first, but is "
                f"{short_repr(config.vary[name])}"
            )
    return {name: list(ends) for name, ends in config.vary.items()}


def describe_run(config: TrainConfig) -> dict[str, Any]:
    """The content of config.json: the resolved configuration, the command and the versions."""
    resolved = asdict(config) | {"hyperparameters": hyperparameters_to_dict(config.hyperparameters)}
    resolved = {name: str(value) if isinstance(value, Path) else value for name, value in resolved.items()}
    return {
        "config": resolved,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": package_versions("stable-baselines3", "torch", *contrib_packages(config)),
    }


def claim_run_folder(config_file: Path, config: TrainConfig) -> None:
    """Write the configuration into a folder, or check that the folder holds the same one.

    The location of the folder does not count: it may have been moved, together with the initial policy beside it. The
    file then gets the present locations.

    Raises:
        ValueError: for a folder with another configuration, naming the first setting that differs.
    """
    described = json.loads(json.dumps(describe_run(config)))
    old_content = json.loads(config_file.read_text(encoding="utf-8")) if config_file.exists() else described
    old_settings, new_settings = _comparable_settings(old_content["config"]), _comparable_settings(described["config"])
    for name, value in new_settings.items():
        if old_settings.get(name) != value:
            raise ValueError(
                f"output must be a new folder or the folder of the same command, but in {config_file} {name} is "
                f"{short_repr(old_settings.get(name))} instead of {short_repr(value)}; name another folder"
            )
    if not config_file.exists() or old_content["config"] != described["config"]:
        write_json(config_file, old_content | {"config": described["config"]})


def _comparable_settings(config: dict[str, Any]) -> dict[str, Any]:
    """Settings of a config.json, each hyperparameter by itself, and paths relative to the output."""
    settings = {name: config.get(name) for name in (f.name for f in fields(TrainConfig)) if name != "output"}
    if config.get("output") and settings["begin"]:
        settings["begin"] = os.path.relpath(settings["begin"], config["output"])
    hyperparameters = settings.pop("hyperparameters") or {}
    return settings | {f"hyperparameters.{name}": value for name, value in hyperparameters.items()}


def contrib_packages(config: TrainConfig) -> tuple[str, ...]:
    """The package of algorithms beyond Stable-Baselines3, where this one needs it."""
    return ("sb3_contrib",) if config.algo in ("tqc", "recurrent_ppo") else ()


def read_config(folder: Path) -> TrainConfig:
    """The configuration of a run folder; settings of a command alone are left out.

    Raises:
        ValueError: for a config.json that is damaged, or of a version with other settings.
    """
    try:
        config_file = check_readable_file(
            folder / CONFIG_FILE, "resume must be a run folder, with a config.json", 2**20
        )
        found = json.loads(config_file.read_text(encoding="utf-8"))["config"]
        settings = {f.name: found[f.name] for f in fields(TrainConfig)}
        settings |= {
            name: None if settings[name] is None else Path(settings[name]) for name in ("output", "settings", "begin")
        }
        settings["hyperparameters"] = parse_hyperparameters(ALGORITHMS[settings["algo"]], settings["hyperparameters"])
        return TrainConfig(**settings)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(
            f"{CONFIG_FILE} of {folder} must hold the settings of a training run, but does not: {error!r}; train anew"
        ) from error
