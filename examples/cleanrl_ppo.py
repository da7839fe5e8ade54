"""PPO in one file, as CleanRL's ``ppo_continuous_action.py`` has it: its loop, its defaults, plain torch.

$ python examples/cleanrl_ppo.py --seed 0
$ duffing-env evaluate --protocol Short-v0 --policies "mine=runs/cleanrl-ppo-short-v0-*" --submit mine

Ours are the environment, by its id, and the policy folder at the end. Needs the extra ``train``, and Gymnasium 1.4. In
earlier versions the wrappers `RecordEpisodeStatistics` and `NormalizeReward` leave out the first step after every end
where environments are reset in the same step, as here (Gymnasium #1017, #1451): printed returns and the scale of
rewards are then a little off.
"""

import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers.utils import RunningMeanStd
from gymnasium.wrappers.vector import ClipAction, NormalizeReward, RecordEpisodeStatistics, TransformReward
from torch import nn
from torch.distributions import Normal

from agents import save_policy
from agents.cli import run_script
from agents.policies.networks.policy_saving import check_policy_folder
from agents.result_files import package_versions
from agents.track_ids import full_track_id


@dataclass(frozen=True)
class Args:
    """CleanRL's PPO on an environment of duffing_env."""

    env_id: str = "duffing_env/Short-v0"
    """Id of the environment; of ours the name of the track will do, such as Short-v0."""
    seed: int = 0
    """Seed of everything."""
    output: Path | None = None
    """Policy folder; runs/cleanrl-ppo-TRACK-SEED where it is not given."""
    total_timesteps: int = 1_000_000
    """Samples; a roll-out that would pass them is not begun."""
    learning_rate: float = 3e-4
    """Step size at the start; it falls linearly to 0."""
    num_envs: int = 1
    """Environments that are stepped together."""
    num_steps: int = 2048
    """Samples of each environment between two updates."""
    gamma: float = 0.99
    """Discount factor."""
    gae_lambda: float = 0.95
    """Trade-off of bias and variance in the advantage."""
    num_minibatches: int = 32
    """Gradient steps in a pass over the samples."""
    update_epochs: int = 10
    """Passes over the samples in an update."""
    clip_coef: float = 0.2
    """How far the ratio of probabilities, and the value, may move."""
    ent_coef: float = 0.0
    """Weight of the entropy."""
    vf_coef: float = 0.5
    """Weight of the value's loss."""
    max_grad_norm: float = 0.5
    """Largest norm of a gradient."""


class Observations:
    """Observations as the networks see them: normalised by their running mean and variance, and clipped."""

    def __init__(self, features: int) -> None:
        self.rms = RunningMeanStd(shape=(features,))

    def __call__(self, observations: np.ndarray) -> torch.Tensor:
        """Normalised observations (n, features); they count in the statistics."""
        self.rms.update(observations)
        return torch.as_tensor(((observations - self.rms.mean) / self.std).clip(-10, 10), dtype=torch.float32)

    @property
    def std(self) -> np.ndarray:
        """The standard deviation (features,)."""
        return np.sqrt(self.rms.var + 1e-8)


def layer_init(layer: nn.Linear, std: float = 2**0.5) -> nn.Linear:
    """Orthogonal weights, no bias."""
    nn.init.orthogonal_(layer.weight, std)
    nn.init.constant_(layer.bias, 0.0)
    return layer


def network(inputs: int, outputs: int, std: float) -> nn.Sequential:
    """Two hidden layers of 64."""
    hidden = (layer_init(nn.Linear(inputs, 64)), nn.Tanh(), layer_init(nn.Linear(64, 64)), nn.Tanh())
    return nn.Sequential(*hidden, layer_init(nn.Linear(64, outputs), std))


class Agent(nn.Module):
    """Actor and critic."""

    def __init__(self, features: int, actions: int) -> None:
        super().__init__()
        self.critic = network(features, 1, std=1.0)
        self.actor_mean = network(features, actions, std=0.01)
        self.actor_logstd = nn.Parameter(torch.zeros(1, actions))

    def get_value(self, x: torch.Tensor) -> torch.Tensor:
        """The value (n,) of observations (n, features)."""
        return self.critic(x).squeeze(-1)

    def get_action_and_value(self, x: torch.Tensor, action: torch.Tensor | None = None) -> tuple[torch.Tensor, ...]:
        """An action, drawn where none is given, its log probability, the entropy and the value."""
        mean = self.actor_mean(x)
        spread = Normal(mean, self.actor_logstd.expand_as(mean).exp())
        action = spread.sample() if action is None else action
        return action, spread.log_prob(action).sum(1), spread.entropy().sum(1), self.get_value(x)


def advantages_of(
    args: Args, rewards: torch.Tensor, values: torch.Tensor, dones: torch.Tensor, next_value: torch.Tensor
) -> torch.Tensor:
    """Generalised advantages (steps, envs); ``dones`` (steps, envs) are of the steps themselves."""
    advantages, last = torch.zeros_like(rewards), torch.zeros_like(next_value)
    for t in reversed(range(len(rewards))):
        following = next_value if t == len(rewards) - 1 else values[t + 1]
        delta = rewards[t] + args.gamma * following * (1 - dones[t]) - values[t]
        advantages[t] = last = delta + args.gamma * args.gae_lambda * (1 - dones[t]) * last
    return advantages


def update(args: Args, agent: Agent, optimizer: torch.optim.Optimizer, batch: tuple[torch.Tensor, ...]) -> None:
    """Clipped gradient steps on a batch of observations, actions, log probabilities, advantages and values."""
    size = len(batch[0])
    for _ in range(args.update_epochs):
        for rows in torch.randperm(size).chunk(args.num_minibatches):
            obs, actions, logprobs, advantages, values = (part[rows] for part in batch)
            returns = advantages + values
            _, newlogprob, entropy, newvalue = agent.get_action_and_value(obs, actions)
            ratio = (newlogprob - logprobs).exp()
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
            clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
            policy_loss = torch.max(-advantages * ratio, -advantages * clipped).mean()
            kept = values + (newvalue - values).clamp(-args.clip_coef, args.clip_coef)
            value_loss = 0.5 * torch.max((newvalue - returns) ** 2, (kept - returns) ** 2).mean()
            loss = policy_loss - args.ent_coef * entropy.mean() + args.vf_coef * value_loss
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
            optimizer.step()


def main(args: Args) -> Path:
    """Train, write the policy folder, and give its path."""
    track = args.env_id.split("/")[-1].lower()
    folder = check_policy_folder("output", args.output or Path("runs") / f"cleanrl-ppo-{track}-{args.seed}")
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    # Our vector environment, in CleanRL's wrappers; observations are normalised in `Observations`.
    envs = gym.make_vec(f"duffing_env:{full_track_id(args.env_id)}", num_envs=args.num_envs, autoreset_mode="SameStep")
    episodes = RecordEpisodeStatistics(envs)
    envs = NormalizeReward(ClipAction(episodes), gamma=args.gamma)
    envs = TransformReward(envs, lambda reward: np.clip(reward, -10, 10))
    features, actions = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    agent, observe = Agent(features, actions), Observations(features)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)

    shape = (args.num_steps, args.num_envs)
    obs, acted = torch.zeros((*shape, features)), torch.zeros((*shape, actions))
    logprobs, rewards, dones, values = (torch.zeros(shape) for _ in range(4))
    begun, iterations = time.perf_counter(), args.total_timesteps // (args.num_steps * args.num_envs)
    if iterations == 0:
        least = args.num_steps * args.num_envs
        raise ValueError(
            f"total_timesteps must be at least a roll-out, {least}, but are {args.total_timesteps}; take more"
        )
    next_obs = observe(envs.reset(seed=args.seed)[0])
    for iteration in range(iterations):
        optimizer.param_groups[0]["lr"] = args.learning_rate * (1 - iteration / iterations)
        for step in range(args.num_steps):
            obs[step] = next_obs
            with torch.no_grad():
                acted[step], logprobs[step], _, values[step] = agent.get_action_and_value(next_obs)
            seen, reward, terminated, truncated, _ = envs.step(acted[step].numpy())
            rewards[step] = torch.as_tensor(reward)
            dones[step] = torch.as_tensor(terminated | truncated)
            next_obs = observe(seen)
        with torch.no_grad():
            advantages = advantages_of(args, rewards, values, dones, agent.get_value(next_obs))
        update(args, agent, optimizer, tuple(x.flatten(0, 1) for x in (obs, acted, logprobs, advantages, values)))
        steps = (iteration + 1) * args.num_steps * args.num_envs
        rate, mean = steps / (time.perf_counter() - begun), np.mean(episodes.return_queue)
        print(f"{steps:9,} samples, {rate:,.0f}/s, return {mean:.2f}", flush=True)

    card = {
        "algorithm": "ppo",
        "steps": steps,
        "config": asdict(args) | {"output": str(folder)},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": package_versions("torch"),
    }
    save_policy(folder, agent.actor_mean, card, normalizer=(observe.rms.mean, observe.std, 10.0))
    print(folder)
    return folder


if __name__ == "__main__":
    run_script(main, Args, __doc__)
