"""RLlib's PPO with its defaults on an environment of duffing_env, by its id; its network becomes a policy folder.

Only the environments that a runner steps at once are eight instead of one, which samples four times as fast.

$ python examples/rllib_ppo.py --seed 0
$ duffing-env evaluate --protocol Short-v0 --policies "mine=runs/rllib-ppo-short-v0-*" --submit mine

Needs ``ray[rllib]``; benchmarks/compat.lock has the versions that this runs with.
"""

import os
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from agents import save_policy
from agents.cli import run_script
from agents.policies.networks.policy_saving import check_policy_folder
from agents.result_files import package_versions
from agents.track_ids import full_track_id

try:
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
except ModuleNotFoundError as missing:
    sys.exit(f"rllib_ppo.py: {missing.name} is not installed; get it with: pip install 'ray[rllib]'")


@dataclass(frozen=True)
class Args:
    """RLlib's PPO on an environment of duffing_env."""

    env_id: str = "duffing_env/Short-v0"
    """Id of the environment; of ours the name of the track will do, such as Short-v0."""
    seed: int = 0
    """Seed of everything."""
    output: Path | None = None
    """Policy folder; runs/rllib-ppo-TRACK-SEED where it is not given."""
    total_timesteps: int = 1_000_000
    """Samples; a roll-out that would pass them is not begun."""


def mean_network(module: torch.nn.Module) -> torch.nn.Sequential:
    """The mean of the action, which RLlib's network gives before the logarithm of its standard deviation."""
    (head,) = module.pi.net.mlp
    mean = torch.nn.Linear(head.in_features, head.out_features // 2)
    mean.load_state_dict({name: rows[: mean.out_features] for name, rows in head.state_dict().items()})
    return torch.nn.Sequential(*module.encoder.actor_encoder.net.mlp, mean)


def main(args: Args) -> Path:
    """Train, write the policy folder, and give its path."""
    track = args.env_id.split("/")[-1].lower()
    folder = check_policy_folder("output", args.output or Path("runs") / f"rllib-ppo-{track}-{args.seed}")
    torch.set_num_threads(1)  # more than one are slower, and many times so on a busy machine
    config = PPOConfig().environment(f"duffing_env:{full_track_id(args.env_id)}").debugging(seed=args.seed)
    config.env_runners(num_envs_per_env_runner=8)
    if (least := config.train_batch_size) > args.total_timesteps:
        raise ValueError(
            f"total_timesteps must be at least a roll-out, {least}, but are {args.total_timesteps}; take more"
        )
    ray.init(os.environ.get("RAY_ADDRESS", "local"))  # else Ray joins a cluster that runs on this machine
    algorithm, steps = config.build_algo(), 0
    while steps + config.train_batch_size <= args.total_timesteps:
        result = algorithm.train()
        steps = int(result["num_env_steps_sampled_lifetime"])
        print(f"{steps:9,} samples, return {result['env_runners']['episode_return_mean']:.2f}", flush=True)

    card = {
        "algorithm": "ppo",
        "steps": steps,
        "config": asdict(args) | {"output": str(folder)},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": package_versions("ray", "torch"),
    }
    # RLlib normalises no observations by default, and an action of ours, in [-1, 1], is the clipped mean.
    save_policy(folder, mean_network(algorithm.get_module()), card)
    algorithm.stop()
    print(folder)
    return folder


if __name__ == "__main__":
    run_script(main, Args, __doc__)
