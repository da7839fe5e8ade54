"""PPO of TorchRL's parts on our vector environment, with the hyperparameters that TorchRL's example for MuJoCo has.

$ python examples/torchrl_ppo.py --seed 0
$ duffing-env evaluate --protocol Short-v0 --policies "mine=runs/torchrl-ppo-short-v0-*" --submit mine

Needs ``torchrl``; benchmarks/compat.lock has the versions that this runs with.
"""

import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import gymnasium as gym
import torch
from torch import nn

from agents import save_policy
from agents.cli import run_script
from agents.policies.networks.policy_saving import check_policy_folder
from agents.result_files import package_versions
from agents.track_ids import full_track_id

try:
    from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
    from torchrl.collectors import Collector
    from torchrl.envs import GymWrapper
    from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE
except ModuleNotFoundError as missing:
    sys.exit(f"torchrl_ppo.py: {missing.name} is not installed; get it with: pip install torchrl")


@dataclass(frozen=True)
class Args:
    """TorchRL's PPO on an environment of duffing_env."""

    env_id: str = "duffing_env/Short-v0"
    """Id of the environment; of ours the name of the track will do, such as Short-v0."""
    seed: int = 0
    """Seed of everything."""
    output: Path | None = None
    """Policy folder; runs/torchrl-ppo-TRACK-SEED where it is not given."""
    total_timesteps: int = 1_000_000
    """Samples; a roll-out that would pass them is not begun."""
    num_envs: int = 8
    """Environments that are stepped together."""
    batch: int = 2048
    """Samples of a roll-out, over all environments."""
    minibatch: int = 64
    """Samples of a gradient step."""
    epochs: int = 10
    """Passes over a roll-out."""
    learning_rate: float = 3e-4
    """Step size at the start; it falls linearly to 0."""


def main(args: Args) -> Path:
    """Train, write the policy folder, and give its path."""
    track = args.env_id.split("/")[-1].lower()
    folder = check_policy_folder("output", args.output or Path("runs") / f"torchrl-ppo-{track}-{args.seed}")
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    total = args.total_timesteps // args.batch * args.batch
    if total == 0:
        raise ValueError(
            f"total_timesteps must be at least a roll-out, {args.batch}, but are {args.total_timesteps}; take more"
        )
    # TorchRL resets the rows that have ended itself.
    envs = gym.make_vec(f"duffing_env:{full_track_id(args.env_id)}", num_envs=args.num_envs, autoreset_mode="Disabled")
    env = GymWrapper(envs)
    env.set_seed(args.seed)
    features = envs.single_observation_space.shape[0]
    layers = {"num_cells": [64, 64], "activation_class": nn.Tanh}
    mean = MLP(features, 1, **layers)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(mean, AddStateIndependentNormalScale(1)), in_keys=["observation"], out_keys=["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
        spec=env.action_spec,
    )
    critic = ValueOperator(MLP(features, 1, **layers), in_keys=["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(
        actor, critic, clip_epsilon=0.2, entropy_bonus=False, critic_coeff=0.25, loss_critic_type="l2",
        normalize_advantage=True,
    )  # fmt: skip
    optimiser = torch.optim.Adam(loss.parameters(), lr=args.learning_rate, eps=1e-5)

    steps = 0
    for rolled in Collector(
        env, actor, frames_per_batch=args.batch, total_frames=total, auto_register_policy_transforms=True
    ):
        optimiser.param_groups[0]["lr"] = args.learning_rate * (1 - steps / total)
        for _ in range(args.epochs):
            with torch.no_grad():
                advantage(rolled)
            samples = rolled.reshape(-1)
            for rows in torch.randperm(len(samples)).split(args.minibatch):
                terms = loss(samples[rows])
                optimiser.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        steps += rolled.numel()
        print(f"{steps:9,} samples, mean reward {rolled['next', 'reward'].mean():.3f}", flush=True)

    card = {
        "algorithm": "ppo",
        "steps": steps,
        "config": asdict(args) | {"output": str(folder)},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": package_versions("torch", "torchrl"),
    }
    # The most probable action of a TanhNormal, as TorchRL plays it without exploration, is the tanh of its mean.
    save_policy(folder, nn.Sequential(*mean, nn.Tanh()), card)
    print(folder)
    return folder


if __name__ == "__main__":
    run_script(main, Args, __doc__)
