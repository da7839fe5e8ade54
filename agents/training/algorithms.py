"""The algorithms: their hyperparameters, the model that these make, and where a search for better ones looks.

The defaults suit a batched environment, where a sample is cheap and a gradient step is not: many environments, large
batches, few gradient steps. `agents/hyperparameters/ALGORITHM.toml` has what differs from them on a track.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

# Hyperparameters by what they may be; whole numbers that are not named here are at least 1.
_FROM_ZERO = ("learning_starts", "exploration_noise", "dropped_quantiles", "levels", "entropy_bonus")
_POSITIVE = ("learning_rate", "entropy_weight")
_SHARES = ("gamma", "gae_lambda", "tau")


@dataclass(frozen=True)
class AlgorithmSettings(ABC):
    """Hyperparameters that every algorithm has."""

    num_envs: int = 512
    """Environments that are stepped together."""
    batch_size: int = 8192
    """Samples of a gradient step."""
    learning_rate: float = 1e-3
    """Step size at the start; it falls linearly to 0."""
    gamma: float = 0.99
    """Discount factor."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers of actor and critic."""
    foresight: bool = False
    """Whether the network sees what its belief expects of simple inputs, and is shielded (docs/training.md)."""

    def __post_init__(self) -> None:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values |= {f"hidden[{i}]": units for i, units in enumerate(values.pop("hidden"))}
        for name, value in values.items():
            least = 0 if name in _FROM_ZERO else 1
            if (type(value) is int or name in _FROM_ZERO) and value < least:
                raise ValueError(f"{name} must be at least {least}, but is {value}")
            if name in _POSITIVE and value <= 0:
                raise ValueError(f"{name} must be positive, but is {value}")
            if name in _SHARES and not 0 <= value <= 1:
                raise ValueError(f"{name} must be in [0, 1], but is {value}")

    @property
    @abstractmethod
    def log_interval(self) -> int:
        """Updates (on-policy) or episodes (off-policy) between two rows of Stable-Baselines3's log."""

    @abstractmethod
    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """A model with these hyperparameters; ValueError where its package is not installed."""

    @classmethod
    @abstractmethod
    def suggest(cls, trial: Any) -> dict[str, Any]:
        """Hyperparameters that Optuna's ``trial`` chooses from the search space of this algorithm."""

    def _common(self, envs: VecEnv, seed: int) -> dict[str, Any]:
        """Arguments that every model takes."""
        start = self.learning_rate
        return {
            "env": envs,
            "batch_size": self.batch_size,
            "learning_rate": lambda left: start * left,
            "gamma": self.gamma,
            "stats_window_size": self.num_envs,
            "seed": seed,
            "device": "cpu",
        }


@dataclass(frozen=True)
class OnPolicySettings(AlgorithmSettings):
    """Hyperparameters of algorithms that learn from the samples of the present policy only."""

    n_steps: int = 64
    """Samples that each environment collects between two updates."""
    n_epochs: int = 4
    """Passes over the collected samples in an update."""
    gae_lambda: float = 0.95
    """Trade-off of bias and variance in the advantage (generalised advantage estimation)."""
    log_std_init: float = -0.5
    """Log standard deviation of the action at the start, where it is not one of some levels."""
    entropy_bonus: float = 0.0
    """Weight of the action's entropy at the start; it falls linearly to 0."""
    levels: int = 0
    """Evenly spaced inputs from one limit to the other that the policy chooses from; 0 for all between."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.levels == 1:
            raise ValueError("levels must be 0 or at least 2, but is 1; there is nothing to choose from one")
        if self.batch_size == 1 or self.num_envs * self.n_steps == 1:
            raise ValueError("batch_size and num_envs * n_steps must be at least 2; PPO normalises over a batch")

    @property
    def log_interval(self) -> int:
        """Every update."""
        return 1

    @classmethod
    def suggest(cls, trial: Any) -> dict[str, Any]:
        """Step size, horizon and exploration, and how much is made of a sample."""
        return {
            "n_steps": trial.suggest_int("n_steps", 16, 128, step=16),
            "n_epochs": trial.suggest_int("n_epochs", 2, 10),
            "learning_rate": trial.suggest_float("learning_rate", 2e-4, 5e-3, log=True),
            "gamma": trial.suggest_float("gamma", 0.95, 0.999),
            "gae_lambda": trial.suggest_float("gae_lambda", 0.85, 1.0),
            "log_std_init": trial.suggest_float("log_std_init", -1.5, 0.0),
        }

    def _on_policy(self, envs: VecEnv, seed: int) -> dict[str, Any]:
        return self._common(envs, seed) | {
            "n_steps": self.n_steps,
            "n_epochs": self.n_epochs,
            "gae_lambda": self.gae_lambda,
            "policy_kwargs": {"net_arch": list(self.hidden)}
            | ({} if self.levels else {"log_std_init": self.log_std_init}),
        }


@dataclass(frozen=True)
class PPOSettings(OnPolicySettings):
    """Hyperparameters of PPO; chosen for a batched environment: large batches, few epochs."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """Stable-Baselines3's PPO."""
        from stable_baselines3 import PPO

        return PPO("MlpPolicy", **self._on_policy(envs, seed))


@dataclass(frozen=True)
class RecurrentPPOSettings(OnPolicySettings):
    """Hyperparameters of PPO with a memory; fewer environments, because a gradient step follows whole sequences."""

    num_envs: int = 128
    """Environments that are stepped together."""
    batch_size: int = 2048
    """Samples of a gradient step."""
    lstm_units: int = 32
    """Units of the LSTM before the hidden layers, in actor and critic."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """sb3-contrib's RecurrentPPO."""
        arguments = self._on_policy(envs, seed)
        arguments["policy_kwargs"]["lstm_hidden_size"] = self.lstm_units
        return _contrib().RecurrentPPO("MlpLstmPolicy", **arguments)


@dataclass(frozen=True)
class OffPolicySettings(AlgorithmSettings):
    """Hyperparameters of algorithms that learn from a buffer of past samples."""

    num_envs: int = 64
    """Environments that are stepped together."""
    batch_size: int = 256
    """Samples of a gradient step."""
    buffer_size: int = 200_000
    """Samples that are kept, over all environments."""
    learning_starts: int = 5_000
    """Samples with random inputs at the start, over all environments."""
    train_freq: int = 4
    """Samples that each environment collects between two updates."""
    gradient_steps: int = 32
    """Gradient steps in an update."""
    tau: float = 0.005
    """How far the target networks follow in a gradient step."""

    @property
    def log_interval(self) -> int:
        """About every time that all environments have ended an episode."""
        return self.num_envs

    @classmethod
    def suggest(cls, trial: Any) -> dict[str, Any]:
        """Step size, horizon, and how much is made of a sample."""
        return {
            "batch_size": trial.suggest_int("batch_size", 128, 1024, log=True),
            "gradient_steps": trial.suggest_int("gradient_steps", 8, 64, log=True),
            "learning_rate": trial.suggest_float("learning_rate", 2e-4, 5e-3, log=True),
            "gamma": trial.suggest_float("gamma", 0.95, 0.999),
            "tau": trial.suggest_float("tau", 2e-3, 2e-2, log=True),
        }

    def _off_policy(self, envs: VecEnv, seed: int) -> dict[str, Any]:
        names = ("buffer_size", "learning_starts", "train_freq", "gradient_steps", "tau")
        return self._common(envs, seed) | {
            **{name: getattr(self, name) for name in names},
            "policy_kwargs": {"net_arch": list(self.hidden)},
        }


@dataclass(frozen=True)
class SACSettings(OffPolicySettings):
    """Hyperparameters of SAC."""

    entropy_weight: float = 0.1
    """Weight of the action's entropy at the start; it is learned."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """Stable-Baselines3's SAC."""
        from stable_baselines3 import SAC

        return SAC("MlpPolicy", ent_coef=f"auto_{self.entropy_weight}", **self._off_policy(envs, seed))


@dataclass(frozen=True)
class TQCSettings(SACSettings):
    """Hyperparameters of TQC: SAC with critics of the return's distribution, without its upper end."""

    dropped_quantiles: int = 2
    """Upper quantiles of 25 that each critic drops, against overestimation."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """sb3-contrib's TQC."""
        return _contrib().TQC(
            "MlpPolicy",
            ent_coef=f"auto_{self.entropy_weight}",
            top_quantiles_to_drop_per_net=self.dropped_quantiles,
            **self._off_policy(envs, seed),
        )

    @classmethod
    def suggest(cls, trial: Any) -> dict[str, Any]:
        """As for SAC, and the quantiles."""
        return super().suggest(trial) | {"dropped_quantiles": trial.suggest_int("dropped_quantiles", 0, 5)}


@dataclass(frozen=True)
class TD3Settings(OffPolicySettings):
    """Hyperparameters of TD3."""

    exploration_noise: float = 0.2
    """Standard deviation of the noise on the action while samples are collected."""

    def make(self, envs: VecEnv, seed: int) -> BaseAlgorithm:
        """Stable-Baselines3's TD3."""
        import numpy as np
        from stable_baselines3 import TD3
        from stable_baselines3.common.noise import NormalActionNoise

        noise = NormalActionNoise(np.zeros(1), np.full(1, self.exploration_noise))
        return TD3("MlpPolicy", action_noise=noise, **self._off_policy(envs, seed))

    @classmethod
    def suggest(cls, trial: Any) -> dict[str, Any]:
        """As for all off-policy algorithms, and the exploration."""
        return super().suggest(trial) | {"exploration_noise": trial.suggest_float("exploration_noise", 0.05, 0.5)}


#: Name of an algorithm to the class of its hyperparameters.
ALGORITHMS: dict[str, type[AlgorithmSettings]] = {
    "ppo": PPOSettings,
    "sac": SACSettings,
    "td3": TD3Settings,
    "tqc": TQCSettings,
    "recurrent_ppo": RecurrentPPOSettings,
}


def as_written(settings: AlgorithmSettings) -> dict[str, Any]:
    """Hyperparameters as JSON and TOML hold them."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(settings).items()}


def _contrib() -> Any:
    try:
        import sb3_contrib
    except ImportError as error:
        raise ValueError(
            "algo must be ppo, sac or td3 without sb3-contrib; install it with: pip install 'duffing-env[contrib]'"
        ) from error
    return sb3_contrib
