"""Rows of the compatibility table: one class for each library, with a method for each cell."""

import gymnasium as gym
import numpy as np

ID = "duffing_env:duffing_env/Short-v0"

#: Keys of the info of every step.
KEYS = {"information_gain", "log_posterior_gain", "diverged"}

#: Environments of a vector environment.
ROWS = 4

#: Columns of the table: one environment, a vector environment, a short training, the infos.
CELLS = ("single", "vector", "train", "infos")


def make_vector(autoreset_mode="SameStep"):
    """Make this project's vector environment of Gymnasium."""
    return gym.make_vec(ID, num_envs=ROWS, vectorization_mode="vector_entry_point", autoreset_mode=autoreset_mode)


class Gymnasium:
    """Gymnasium: its checker, wrappers and vector environments."""

    package = "gymnasium"

    def single(self):
        """Check the environment; make it again from its specification, with another time limit."""
        from gymnasium.utils.env_checker import check_env

        check_env(gym.make(ID).unwrapped, skip_render_check=True)
        env = gym.wrappers.TimeAwareObservation(gym.make(gym.make(ID, max_episode_steps=20).spec))
        env.reset(seed=0)
        steps = [env.step(env.action_space.sample()) for _ in range(20)]
        assert [step[3] for step in steps] == [False] * 19 + [True]

    def vector(self):
        """Step our vector environment under wrappers in every autoreset mode, and the two of Gymnasium."""
        from gymnasium.vector import AutoresetMode
        from gymnasium.wrappers.vector import NormalizeReward, RecordEpisodeStatistics

        for mode in AutoresetMode:
            envs = NormalizeReward(RecordEpisodeStatistics(make_vector(mode)))
            envs.reset(seed=0)
            for _ in range(48):
                *_, infos = envs.step(envs.action_space.sample())
            assert "episode" in infos
        for mode in ("sync", "async"):
            envs = gym.make_vec(ID, num_envs=2, vectorization_mode=mode)
            envs.reset(seed=0)
            envs.step(envs.action_space.sample())
            envs.close()

    train = None

    def infos(self):
        """Find the same keys after a reset and every step, and belief and truth at the end of an episode."""
        env = gym.make(ID)
        infos = [env.reset(seed=0)[1], *(env.step(env.action_space.sample())[4] for _ in range(48))]
        assert all(info.keys() == KEYS for info in infos)
        assert env.unwrapped.belief.physical()[0].shape == (len(env.unwrapped.truth),)
        envs = make_vector()
        envs.reset(seed=0)
        for _ in range(48):
            *_, last = envs.step(envs.action_space.sample())
        assert {"belief", "truth"} | KEYS <= last["final_info"].keys()


class TorchRL:
    """TorchRL: ``GymEnv``, ``GymWrapper``, its collector and PPO."""

    package = "torchrl"

    def single(self):
        """Make the environment by its id, check it and play it."""
        from torchrl.envs import GymEnv
        from torchrl.envs.utils import check_env_specs

        env = GymEnv(ID)
        check_env_specs(env)
        assert env.rollout(100)["next", "done"].sum() == 1

    def vector(self):
        """Wrap our vector environment, with autoreset off: TorchRL takes no ``NextStep``."""
        from torchrl.envs import GymWrapper

        rolled = GymWrapper(make_vector("Disabled")).rollout(100, break_when_any_done=False)
        assert rolled["next", "done"].sum() == 2 * ROWS

    def train(self):
        """Train with its collector, advantage estimate and clipped loss."""
        import torch
        from tensordict.nn import TensorDictModule
        from torchrl.collectors import Collector
        from torchrl.envs import GymEnv
        from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
        from torchrl.objectives import ClipPPOLoss
        from torchrl.objectives.value import GAE

        env = GymEnv(ID)
        net = torch.nn.Sequential(MLP(22, 2, num_cells=[16]), NormalParamExtractor())
        actor = ProbabilisticActor(
            TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]), in_keys=["loc", "scale"],
            distribution_class=TanhNormal, return_log_prob=True, spec=env.action_spec,
        )  # fmt: skip
        critic = ValueOperator(MLP(22, 1, num_cells=[16]), in_keys=["observation"])
        advantage = GAE(gamma=1.0, lmbda=0.95, value_network=critic)
        loss = ClipPPOLoss(actor, critic)
        optimiser = torch.optim.Adam(loss.parameters())
        iterations = 0
        for batch in Collector(env, actor, frames_per_batch=96, total_frames=288):
            advantage(batch)
            terms = loss(batch.reshape(-1))
            optimiser.zero_grad()
            sum(value for name, value in terms.items() if name.startswith("loss_")).backward()
            optimiser.step()
            iterations += 1
        assert iterations == 3

    def infos(self):
        """Read infos of a vector environment by its own reader, of one environment by a reader of Python's numbers."""
        from torchrl.data import Unbounded
        from torchrl.envs import GymEnv, GymWrapper, default_info_dict_reader

        class Reader(default_info_dict_reader):
            def __call__(self, info, tensordict):
                return super().__call__({name: np.asarray(value) for name, value in info.items()}, tensordict)

        numbers = dict.fromkeys(sorted(KEYS), Unbounded((ROWS,)))
        many = GymWrapper(make_vector("Disabled"))
        many.set_info_dict_reader(default_info_dict_reader(sorted(KEYS), numbers))
        for envs in (GymEnv(ID).auto_register_info_dict(info_dict_reader=Reader()), many):
            rolled = envs.rollout(10)
            assert set(rolled["next"].keys()) >= KEYS
            assert float(rolled["next", "information_gain"].sum()) != 0


class Tianshou:
    """Tianshou: its vector environments, collector and PPO."""

    package = "tianshou"

    def _collector(self, rows, size):
        from tianshou.data import Collector, VectorReplayBuffer
        from tianshou.env import DummyVectorEnv

        envs, buffer = DummyVectorEnv([lambda: gym.make(ID)] * rows), VectorReplayBuffer(size, rows)
        algorithm = self._algorithm(envs)
        collector = Collector(algorithm, envs, buffer)
        collector.reset()
        return collector, algorithm, buffer

    def _algorithm(self, envs):
        import torch
        from tianshou.algorithm import PPO
        from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
        from tianshou.algorithm.optim import AdamOptimizerFactory
        from tianshou.utils.net.common import Net
        from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

        space, actions = envs.observation_space[0], envs.action_space[0]
        actor = ContinuousActorProbabilistic(
            preprocess_net=Net(state_shape=space.shape, hidden_sizes=[16]), action_shape=actions.shape, unbounded=True
        )
        critic = ContinuousCritic(preprocess_net=Net(state_shape=space.shape, hidden_sizes=[16]))
        policy = ProbabilisticActorPolicy(
            actor=actor, action_space=actions,
            dist_fn=lambda moments: torch.distributions.Independent(torch.distributions.Normal(*moments), 1),
        )  # fmt: skip
        return PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-3))

    def single(self):
        """Collect an episode of one environment."""
        collector, *_ = self._collector(1, 100)
        assert collector.collect(n_episode=1).lens[0] == 48

    def vector(self):
        """Collect episodes of several environments."""
        collector, *_ = self._collector(ROWS, 1000)
        assert collector.collect(n_episode=8).n_collected_episodes == 8

    def train(self):
        """Collect and update three times."""
        from tianshou.utils.torch_utils import policy_within_training_step

        collector, algorithm, buffer = self._collector(ROWS, 400)
        for _ in range(3):
            with policy_within_training_step(algorithm.policy):
                collector.collect(n_step=192)
                algorithm.update(buffer=buffer, batch_size=64, repeat=2)
            collector.reset_buffer(keep_statistics=True)

    def infos(self):
        """Find infos in its replay buffer."""
        collector, _, buffer = self._collector(ROWS, 400)
        collector.collect(n_episode=4)
        info = buffer.sample(0)[0].info
        assert set(info.keys()) >= KEYS
        assert np.count_nonzero(info.information_gain)


class StableBaselines3:
    """Stable-Baselines3: its checker, and its PPO on one environment and on our vector environment."""

    package = "stable-baselines3"

    def _envs(self):
        from agents.sb3_vec_env import DuffingVecEnv

        return DuffingVecEnv(ID, ROWS, seed=0)

    def _ppo(self, envs):
        from stable_baselines3 import PPO

        return PPO("MlpPolicy", envs, n_steps=48, batch_size=48, policy_kwargs={"net_arch": [16]}, device="cpu")

    def single(self):
        """Check the environment, and train on it as Stable-Baselines3 wraps it."""
        from stable_baselines3.common.env_checker import check_env

        check_env(gym.make(ID))
        self._ppo(gym.make(ID)).learn(48)

    def vector(self):
        """Take a vector environment under a wrapper of the user's."""
        from gymnasium.wrappers.vector import TransformReward

        from agents.sb3_vec_env import DuffingVecEnv

        envs = DuffingVecEnv(TransformReward(make_vector(), lambda reward: 0.1 * reward))
        envs.reset()
        envs.step(np.zeros((ROWS, 1), dtype=np.float32))
        assert envs.get_attr("truth", 2)[0].m == envs.envs.unwrapped.truth.m[2]

    def train(self):
        """Train on our vector environment."""
        self._ppo(self._envs()).learn(3 * 48 * ROWS)

    def infos(self):
        """Find belief, truth and episode statistics in the last info of each episode."""
        envs = self._envs()
        envs.reset()
        for _ in range(48):
            _, _, _, infos = envs.step(np.zeros((ROWS, 1), dtype=np.float32))
        assert all({"belief", "truth", "episode"} | KEYS <= info.keys() for info in infos)


class RLlib:
    """RLlib: its PPO, on one environment and on our vector environment."""

    package = "ray"

    def _algorithm(self, vector=False):
        import ray
        from ray.rllib.algorithms.ppo import PPOConfig

        ray.init(num_cpus=1, include_dashboard=False, object_store_memory=10**8, ignore_reinit_error=True)
        options = {"num_envs_per_env_runner": ROWS, "gym_env_vectorize_mode": "vector_entry_point"} if vector else {}
        config = PPOConfig().environment(ID).env_runners(num_env_runners=0, **options)
        return config.training(train_batch_size=192, minibatch_size=96, num_epochs=1).build_algo()

    def single(self):
        """Sample an episode of one environment with its runner."""
        assert self._algorithm().env_runner.sample(num_episodes=1)[0].is_done

    def vector(self):
        """Sample episodes of our vector environment with its runner."""
        algorithm = self._algorithm(vector=True)
        assert len(algorithm.env_runner.sample(num_episodes=ROWS)) >= ROWS

    def train(self):
        """Train on our vector environment."""
        algorithm = self._algorithm(vector=True)
        results = [algorithm.train() for _ in range(3)]
        assert np.isfinite(results[-1]["env_runners"]["episode_return_mean"])

    def infos(self):
        """Find infos in its episodes."""
        (episode, *_) = self._algorithm().env_runner.sample(num_episodes=1)
        assert all(info.keys() >= KEYS for info in episode.get_infos())


class Minari:
    """Minari: its collector, which takes one environment."""

    package = "minari"

    def _dataset(self, infos):
        import minari

        collector = minari.DataCollector(gym.make(ID), record_infos=infos)
        for episode in range(3):
            collector.reset(seed=episode)
            done = False
            while not done:
                _, _, terminated, truncated, _ = collector.step(collector.action_space.sample())
                done = terminated or truncated
        about = {"algorithm_name": "random", "code_permalink": "none", "author": "none", "author_email": "none@none"}
        return collector.create_dataset(dataset_id=f"duffing/short-{infos}/random-v0", **about)

    def single(self):
        """Collect episodes into a data set."""
        assert self._dataset(False).total_steps == 3 * 48

    vector = train = None

    def infos(self):
        """Record infos of the reset and of every step, with ``record_infos``."""
        for episode in self._dataset(True).iterate_episodes():
            assert episode.infos.keys() == KEYS
            assert len(episode.infos["information_gain"]) == 49
