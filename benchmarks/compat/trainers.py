"""Stable-Baselines3, RLlib and Minari."""

# The libraries are not installed where types are checked.
# mypy: ignore-errors

from __future__ import annotations

import numpy as np

from benchmarks.compat.common import ID, KEYS, ROWS, made


class StableBaselines3:
    """Its checker, PPO on one environment and on ours, wrapped."""

    package = "stable-baselines3"

    def _ppo(self, envs):
        from stable_baselines3 import PPO

        return PPO("MlpPolicy", envs, n_steps=48, batch_size=48, policy_kwargs={"net_arch": [16]}, device="cpu")

    def single(self):
        """Checked, and in its own way to many."""
        import gymnasium as gym
        from stable_baselines3.common.env_checker import check_env

        check_env(gym.make(ID))
        self._ppo(gym.make(ID)).learn(48)

    def vector(self):
        """Ours, made and wrapped by the user."""
        from gymnasium.wrappers.vector import TransformReward

        from agents.vec_env import DuffingVecEnv

        envs = DuffingVecEnv(TransformReward(made(), lambda reward: 0.1 * reward))
        envs.reset()
        envs.step(np.zeros((ROWS, 1), dtype=np.float32))
        assert envs.get_attr("truth", 2)[0].m == envs.envs.unwrapped.truth.m[2]

    def train(self):
        """On ours."""
        from agents.vec_env import DuffingVecEnv

        self._ppo(DuffingVecEnv(ID, ROWS, seed=0)).learn(3 * 48 * ROWS)

    def infos(self):
        """The last step's of each episode."""
        from agents.vec_env import DuffingVecEnv

        envs = DuffingVecEnv(ID, ROWS, seed=0)
        envs.reset()
        for _ in range(48):
            _, _, _, infos = envs.step(np.zeros((ROWS, 1), dtype=np.float32))
        assert all({"belief", "truth", "episode"} | KEYS <= info.keys() for info in infos)


class RLlib:
    """Its PPO, on one environment and on ours."""

    package = "ray"

    def _algorithm(self, **told):
        import ray
        from ray.rllib.algorithms.ppo import PPOConfig

        ray.init(num_cpus=1, include_dashboard=False, object_store_memory=10**8, ignore_reinit_error=True)
        config = PPOConfig().environment(ID).env_runners(num_env_runners=0, **told)
        return config.training(train_batch_size=192, minibatch_size=96, num_epochs=1).build_algo()

    def single(self):
        """One environment in its runner."""
        assert self._algorithm().env_runner.sample(num_episodes=1)[0].is_done

    def vector(self):
        """Ours in its runner."""
        algorithm = self._algorithm(num_envs_per_env_runner=ROWS, gym_env_vectorize_mode="vector_entry_point")
        assert len(algorithm.env_runner.sample(num_episodes=ROWS)) >= ROWS

    def train(self):
        """On ours."""
        algorithm = self._algorithm(num_envs_per_env_runner=ROWS, gym_env_vectorize_mode="vector_entry_point")
        results = [algorithm.train() for _ in range(3)]
        assert np.isfinite(results[-1]["env_runners"]["episode_return_mean"])

    def infos(self):
        """In its episodes."""
        (episode, *_) = self._algorithm().env_runner.sample(num_episodes=1)
        assert all(info.keys() >= KEYS for info in episode.get_infos())


class Minari:
    """Its collector; it takes single environments."""

    package = "minari"

    def _dataset(self, infos):
        import gymnasium as gym
        import minari

        collector = minari.DataCollector(gym.make(ID), record_infos=infos)
        for episode in range(3):
            collector.reset(seed=episode)
            done = False
            while not done:
                _, _, terminated, truncated, _ = collector.step(collector.action_space.sample())
                done = terminated or truncated
        told = {"algorithm_name": "random", "code_permalink": "none", "author": "none", "author_email": "none@none"}
        return collector.create_dataset(dataset_id=f"duffing/short-{infos}/random-v0", **told)

    def single(self):
        """Episodes into a data set."""
        assert self._dataset(False).total_steps == 3 * 48

    vector = train = None

    def infos(self):
        """With ``record_infos``: of the reset and of every step."""
        for episode in self._dataset(True).iterate_episodes():
            assert episode.infos.keys() == KEYS
            assert len(episode.infos["information_gain"]) == 49
