"""Hyperparameters of PPO, recurrent PPO, SAC, TD3 and TQC: defaults, search ranges, and the models that they make.

The defaults are for batched environments, where a sample is cheap and a gradient step is not: many environments, large
batches, few gradient steps. `agents/hyperparameters/ALGORITHM.toml` has the values that differ on a track.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

#: Hyperparameters from 0 on; other whole numbers are at least 1.
_NON_NEGATIVE = ("learning_starts", "exploration_noise", "dropped_quantiles", "levels", "entropy_bonus")

#: Hyperparameters above 0.
_POSITIVE = ("learning_rate", "entropy_weight")

#: Hyperparameters from 0 to 1.
_FRACTIONS = ("gamma", "gae_lambda", "tau")


def _with_search_range(default: Any, low: Any, high: Any, **sampling: Any) -> Any:
    """A hyperparameter that a search varies: its default, its range, and arguments of Optuna's ``suggest``."""
    return field(default=default, metadata={"low": low, "high": high, **sampling})


@dataclass(frozen=True)
class AlgorithmSettings(ABC):
    """Hyperparameters that every algorithm has."""

    num_envs: int = 512
    """Environments that are stepped together."""
    batch_size: int = 8192
    """Samples of a gradient step."""
    learning_rate: float = _with_search_range(1e-3, 2e-4, 5e-3, log=True)
    """Step size at the start; it falls linearly to 0."""
    gamma: float = _with_search_range(0.99, 0.95, 1.0)
    """Discount factor."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers of actor and critic."""
    activation: Literal["relu", "tanh", "elu"] = "relu"
    """Activation between the layers."""
    features: bool = True
    """Whether the network gets features of the observation, and a shield bounds its input (docs/training.md)."""
    own: bool = True
    """Whether the network gets the observation itself, too; on the family it never does."""

    def __post_init__(self) -> None:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values |= {f"hidden[{i}]": units for i, units in enumerate(values.pop("hidden"))}
        for name, value in values.items():
            least = 0 if name in _NON_NEGATIVE else 1
            if (type(value) is int or name in _NON_NEGATIVE) and value < least:
                raise ValueError(f"{name} must be at least {least}, but is {value}")
            if type(value) is float and not math.isfinite(value):
                raise ValueError(f"{name} must be finite, but is {value}; give a number")
            if name in _POSITIVE and value <= 0:
                raise ValueError(f"{name} must be positive, but is {value}")
            if name in _FRACTIONS and not 0 <= value <= 1:
                raise ValueError(f"{name} must be in [0, 1], but is {value}")

    @property
    @abstractmethod
    def samples_per_update(self) -> int:
        """Samples that are collected between two updates, over all environments."""

    @property
    @abstractmethod
    def log_interval(self) -> int:
        """Updates (on-policy) or episodes (off-policy) between two rows of Stable-Baselines3's log."""

    @abstractmethod
    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """A model with these hyperparameters."""

    @classmethod
    def sample_hyperparameters(cls, trial: Any) -> dict[str, Any]:
        """Hyperparameters that Optuna's ``trial`` chooses from the search space of this algorithm."""
        searched_fields = [f for f in fields(cls) if f.metadata]
        suggest = {int: trial.suggest_int, float: trial.suggest_float}
        return {f.name: suggest[type(f.default)](f.name, **f.metadata) for f in searched_fields}

    def _model_arguments(self, envs: VecEnv, seed: int, *names: str) -> dict[str, Any]:
        """Arguments of every model, and the named hyperparameters."""
        initial_rate = self.learning_rate
        return {name: getattr(self, name) for name in names} | {
            "env": envs,
            "batch_size": self.batch_size,
            "learning_rate": lambda progress_remaining: initial_rate * progress_remaining,
            "gamma": self.gamma,
            "stats_window_size": self.num_envs,
            "policy_kwargs": {"net_arch": list(self.hidden), "activation_fn": _activation_class(self.activation)},
            "seed": seed,
            "device": "cpu",
        }


@dataclass(frozen=True)
class OnPolicySettings(AlgorithmSettings):
    """Hyperparameters of on-policy algorithms, which learn from the samples of the present policy only."""

    n_steps: int = _with_search_range(64, 16, 128, step=16)
    """Samples that each environment collects between two updates."""
    n_epochs: int = _with_search_range(4, 2, 10)
    """Passes over the collected samples in an update."""
    gae_lambda: float = _with_search_range(0.95, 0.85, 1.0)
    """Trade-off of bias and variance in the advantage (generalised advantage estimation)."""
    log_std_init: float = _with_search_range(-0.5, -1.5, 0.0)
    """Log standard deviation of the action at the start; not used with levels."""
    entropy_bonus: float = 0.0
    """Weight of the action's entropy at the start; it falls linearly to 0."""
    levels: int = 0
    """Number of evenly spaced inputs from one limit to the other to choose from; 0: all inputs between."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.levels == 1:
            raise ValueError("levels must be 0 or at least 2, but is 1; a single input leaves no choice")
        if self.batch_size == 1 or self.num_envs * self.n_steps == 1:
            raise ValueError("batch_size and num_envs * n_steps must be at least 2; PPO normalises over a batch")

    @property
    def samples_per_update(self) -> int:
        """Samples of a roll-out."""
        return self.num_envs * self.n_steps

    @property
    def log_interval(self) -> int:
        """Every update."""
        return 1

    def _on_policy_arguments(self, envs: VecEnv, seed: int) -> dict[str, Any]:
        arguments = self._model_arguments(envs, seed, "n_steps", "n_epochs", "gae_lambda")
        if not self.levels:
            arguments["policy_kwargs"]["log_std_init"] = self.log_std_init
        return arguments


@dataclass(frozen=True)
class PPOSettings(OnPolicySettings):
    """Hyperparameters of PPO for batched environments: large batches, few epochs."""

    advantages_by_time: bool = True
    """Whether advantages are normalised at every time of an episode alike (`agents.training.timed_advantages`)."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """Stable-Baselines3's PPO."""
        from stable_baselines3 import PPO

        buffer: dict[str, Any] = {}
        if self.features and self.advantages_by_time:
            from agents.training.timed_advantages import TimeNormalisedRolloutBuffer

            buffer["rollout_buffer_class"] = TimeNormalisedRolloutBuffer
        return PPO("MlpPolicy", **self._on_policy_arguments(envs, seed), **buffer)


@dataclass(frozen=True)
class RecurrentPPOSettings(OnPolicySettings):
    """Hyperparameters of PPO with an LSTM; fewer environments, because a gradient step goes through sequences."""

    num_envs: int = 128
    """Environments that are stepped together."""
    batch_size: int = 2048
    """Samples of a gradient step."""
    lstm_units: int = 32
    """Units of the LSTM before the hidden layers, in actor and critic."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """sb3-contrib's RecurrentPPO."""
        from sb3_contrib import RecurrentPPO

        arguments = self._on_policy_arguments(envs, seed)
        arguments["policy_kwargs"]["lstm_hidden_size"] = self.lstm_units
        return RecurrentPPO("MlpLstmPolicy", **arguments)


@dataclass(frozen=True)
class OffPolicySettings(AlgorithmSettings):
    """Hyperparameters of off-policy algorithms, which learn from a replay buffer."""

    num_envs: int = 64
    """Environments that are stepped together."""
    batch_size: int = _with_search_range(256, 128, 1024, log=True)
    """Samples of a gradient step."""
    buffer_size: int = 200_000
    """Samples in the replay buffer, over all environments."""
    learning_starts: int = 5_000
    """Samples with random inputs at the start, over all environments."""
    train_freq: int = 4
    """Samples that each environment collects between two updates."""
    gradient_steps: int = _with_search_range(32, 8, 64, log=True)
    """Gradient steps in an update."""
    tau: float = _with_search_range(0.005, 2e-3, 2e-2, log=True)
    """Rate at which the target networks follow, per gradient step."""

    @property
    def samples_per_update(self) -> int:
        """Samples that are put into the buffer between two updates."""
        return self.num_envs * self.train_freq

    @property
    def log_interval(self) -> int:
        """About once per episode of all environments."""
        return self.num_envs

    def _off_policy_arguments(self, envs: VecEnv, seed: int) -> dict[str, Any]:
        names = ("buffer_size", "learning_starts", "train_freq", "gradient_steps", "tau")
        return self._model_arguments(envs, seed, *names)


@dataclass(frozen=True)
class SACSettings(OffPolicySettings):
    """Hyperparameters of SAC."""

    entropy_weight: float = 0.1
    """Weight of the action's entropy at the start; it is learned."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """Stable-Baselines3's SAC."""
        from stable_baselines3 import SAC

        return SAC("MlpPolicy", ent_coef=f"auto_{self.entropy_weight}", **self._off_policy_arguments(envs, seed))


@dataclass(frozen=True)
class TQCSettings(SACSettings):
    """Hyperparameters of TQC: SAC with distributional critics, whose upper quantiles are dropped."""

    dropped_quantiles: int = _with_search_range(2, 0, 5)
    """Number of upper quantiles, of 25, that each critic drops against overestimation."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """sb3-contrib's TQC."""
        from sb3_contrib import TQC

        return TQC(
            "MlpPolicy",
            ent_coef=f"auto_{self.entropy_weight}",
            top_quantiles_to_drop_per_net=self.dropped_quantiles,
            **self._off_policy_arguments(envs, seed),
        )


@dataclass(frozen=True)
class TD3Settings(OffPolicySettings):
    """Hyperparameters of TD3."""

    exploration_noise: float = _with_search_range(0.2, 0.05, 0.5)
    """Standard deviation of the noise on the action while samples are collected."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """Stable-Baselines3's TD3."""
        import numpy as np
        from stable_baselines3 import TD3
        from stable_baselines3.common.noise import NormalActionNoise

        noise = NormalActionNoise(np.zeros(1), np.full(1, self.exploration_noise))
        return TD3("MlpPolicy", action_noise=noise, **self._off_policy_arguments(envs, seed))


#: Name of an algorithm to the class of its hyperparameters.
ALGORITHMS: dict[str, type[AlgorithmSettings]] = {
    "ppo": PPOSettings,
    "sac": SACSettings,
    "td3": TD3Settings,
    "tqc": TQCSettings,
    "recurrent_ppo": RecurrentPPOSettings,
}


def _activation_class(activation: str) -> Any:
    """The class of an activation in torch."""
    from torch import nn

    return {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU}[activation]


def hyperparameters_to_dict(settings: AlgorithmSettings) -> dict[str, Any]:
    """Hyperparameters as values of JSON and TOML."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(settings).items()}
