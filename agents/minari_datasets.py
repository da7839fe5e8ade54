"""Datasets for offline learning, in Minari's format: episodes of policies of four grades on a track.

$ python -m agents.minari_datasets --grade random
$ python -m agents.minari_datasets --grade expert --env Amplitude-v0 --episodes 5000

A dataset is called duffing/TRACK/GRADE-v0, and lies where Minari keeps its own (MINARI_DATASETS_PATH). Its systems are
of the branch ``train`` of the seeds, so what learns from it has met none of those that it is evaluated on.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Literal

import numpy as np

from agents.cli import run_script
from agents.console_output import print_texts_and_tables
from agents.evaluation.comparison import default_policies
from agents.evaluation.track_batch import make_track_batch
from agents.policies import make_policy, trained_policies
from agents.track_ids import check_is_duffing_track, full_track_id
from agents.user_code import attribute_user_errors
from estimator.support.argument_checks import check_choice, check_integer
from estimator.support.optional_dependencies import require_packages
from estimator.support.progress import iterate_with_progress

#: Grade to the policy that plays it; the expert is the one that ships for the track.
POLICIES = {"random": "uniform", "medium": "velocity-sign", "planner": "efe"}

_MAX_BATCH = 256

#: Episodes, which are in memory together.
_MAX_EPISODES = 100_000


@dataclass(frozen=True)
class Config:
    """Make a dataset."""

    grade: Literal["random", "medium", "expert", "planner"] = "expert"
    """Who plays: uniform noise, the feedback law velocity-sign, the trained policy of the track, or the planner."""
    env: str = "duffing_env/Short-v0"
    """Track, such as Short-v0."""
    episodes: int = 1000
    """Number of episodes."""
    seed: int = 0
    """Seed of systems, noise and policy."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "env", full_track_id(self.env))
        check_is_duffing_track(self.env)
        check_choice("grade", self.grade, (*POLICIES, "expert"))
        check_integer("episodes", self.episodes, _MAX_EPISODES)
        check_integer("seed", self.seed, 2**32 - 1, 0)

    @property
    def policy(self) -> str:
        """The name of the policy; ValueError for an expert of a track that none ships for."""
        if self.grade != "expert":
            return POLICIES[self.grade]
        shipped = [name for name in default_policies(self.env, {}) if name in trained_policies()]
        if not shipped:
            raise ValueError(f"grade must not be expert on {self.env}, for which no policy ships; take planner")
        return shipped[0]

    @property
    def name(self) -> str:
        """Of the dataset."""
        return f"duffing/{self.env.split('/')[-1].lower()}/{self.grade}-v0"


def collect_episodes(config: Config) -> list[dict[str, Any]]:
    """Episodes as Minari's buffers hold them: an observation more than actions, rewards and ends."""
    name = config.policy
    envs = make_track_batch(config.env, min(_MAX_BATCH, config.episodes))
    with attribute_user_errors(name, "policy"):
        policy = make_policy(name, envs, seed=config.seed)
    episodes: list[dict[str, Any]] = []
    seeds = np.random.SeedSequence(config.seed).generate_state(-(-config.episodes // envs.num_envs))
    batches = [(f"batch {number} of {len(seeds)}", int(seed)) for number, seed in enumerate(seeds, start=1)]
    for seed in iterate_with_progress(batches):
        with attribute_user_errors(name, "policy"):
            episodes += _play(envs, policy, seed)
    envs.close()
    return episodes[: config.episodes]


def _play(envs: Any, policy: Any, seed: int) -> list[dict[str, Any]]:
    """One episode in every row, which all begin together."""
    n, state, start = envs.num_envs, None, np.ones(envs.num_envs, dtype=np.bool_)
    observation, _ = envs.reset(seed=seed)
    observations, steps = [observation], []
    length = np.zeros(n, dtype=np.intp)
    while not length.all():
        actions, state = policy.predict(observation, state, start, deterministic=True)
        observation, rewards, terminated, truncated, _ = envs.step(actions)
        observations.append(observation)
        steps.append((actions, rewards, terminated, truncated))
        start = terminated | truncated
        length[start & (length == 0)] = len(steps)  # a row that has ended plays on; what it plays is left out
    actions, rewards, terminated, truncated = (np.array(part) for part in zip(*steps, strict=True))
    observed = np.array(observations)
    return [
        {
            "observations": observed[: end + 1, row],
            "actions": actions[:end, row],
            "rewards": rewards[:end, row],
            "terminations": terminated[:end, row],
            "truncations": truncated[:end, row],
        }
        for row, end in enumerate(length)
    ]


def main(config: Config) -> None:
    """Collect, and hand over to Minari.

    Raises:
        ModuleNotFoundError: without the packages of the extra ``datasets``.
        ValueError: where there is a dataset of this name, before anything is played.
    """
    require_packages("minari", "h5py")
    import minari
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.storage import get_dataset_path

    place = get_dataset_path(config.name)
    if place.exists():
        raise ValueError(f"{config.name} must be a new dataset, but is in {place}; delete that folder to make it anew")
    buffers = [EpisodeBuffer(id=number, **episode) for number, episode in enumerate(collect_episodes(config))]
    with warnings.catch_warnings():
        # There is no author to write to, no page of its own, and no other environment to evaluate on.
        warnings.filterwarnings("ignore", ".* is set to None", UserWarning)
        dataset = minari.create_dataset_from_buffers(
            config.name,
            buffers,
            env=config.env,
            algorithm_name=config.policy,
            description=f"{config.policy} on {config.env}, seed {config.seed}, duffing-env {version('duffing-env')}",
            requirements=["duffing-env"],
            data_format="hdf5",
        )
    gained = [float(np.sum(buffer.rewards)) for buffer in buffers]
    counts = f"{dataset.total_episodes} episodes, {dataset.total_steps} samples"
    print_texts_and_tables(f"{config.name}: {counts}, return {np.mean(gained):.2f}")


if __name__ == "__main__":
    run_script(main, Config, __doc__)
