"""Training: the run folder, its reproducibility, and whether anything is learned."""

import csv
import json
import platform
import subprocess
import sys
from dataclasses import asdict, replace
from importlib.metadata import version
from itertools import pairwise

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from tables import table

import agents.sb3_vec_env
from agents import make_policy
from agents.commands.train_command import TrainCommand
from agents.evaluation.metric_summary import summarise_metrics
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.evaluation.track_batch import TEST_OPTIONS, make_track_batch
from agents.policies.networks.feature_names import FEATURE_NAMES
from agents.result_files import write_json
from agents.training import PPOSettings, TrainConfig, resume, train
from agents.training.environments.training_envs import make_training_envs
from agents.training.hyperparameters import parse_hyperparameters
from agents.training.training_config import describe_run

PNG = b"\x89PNG\r\n\x1a\n"
SMALL = PPOSettings(num_envs=64, n_steps=64, batch_size=1024, hidden=(16,))
TINY = PPOSettings(num_envs=8, n_steps=16, batch_size=64, hidden=(4,))


@pytest.fixture(scope="module", autouse=True)
def torch_threads():
    """Training sets them for the whole process."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs of five updates: twice with seed 0, once with seed 1."""
    folder = tmp_path_factory.mktemp("runs")
    seeds = {"first": 0, "again": 0, "other": 1}
    return {
        name: train(TrainConfig(steps=20_000, seed=seed, output=folder / name, torch_threads=1, hyperparameters=SMALL))
        for name, seed in seeds.items()
    }


def tiny(output=None, **settings):
    return train(TrainConfig(output=output, **{"steps": 256, "torch_threads": 1, "hyperparameters": TINY, **settings}))


def test_the_same_seed_gives_the_same_policy_byte_by_byte(runs):
    first, again = (runs[name].folder for name in ("first", "again"))
    weights = sorted(path.relative_to(first) for path in first.rglob("policy.safetensors"))
    assert len(weights) == 7
    for path in weights:
        assert (first / path).read_bytes() == (again / path).read_bytes()
    returns = [[(steps, value) for steps, _, value in runs[name].curve] for name in ("first", "again")]
    np.testing.assert_array_equal(*returns)


def test_another_seed_gives_another_policy(runs):
    first, other = (load_file(runs[name].folder / "policy.safetensors") for name in ("first", "other"))
    assert first.keys() == other.keys()
    for name in first.keys() - {"setting"}:  # that of the track
        assert not np.array_equal(first[name], other[name]), name


def test_the_run_folder_holds_what_it_promises(runs):
    folder = runs["first"].folder
    files = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    checkpoints = [f"checkpoints/{steps:09d}/policy" for steps in (4096, 8192, 12288, 16384, 20480)]
    checkpoints += ["untrained/policy"]
    assert files == sorted(
        ["config.json", "learning_curve.png", "policy.json", "policy.safetensors", "progress.csv"]
        + [f"{checkpoint}.{ending}" for checkpoint in checkpoints for ending in ("json", "safetensors")]
    )
    picture = (folder / "learning_curve.png").read_bytes()
    assert picture.startswith(PNG)
    assert len(picture) > 5000


def test_the_configuration_can_rebuild_the_run(runs, tmp_path):
    description = json.loads((runs["first"].folder / "config.json").read_text())
    assert set(description) == {"config", "command", "versions"}
    settings = description["config"]
    assert settings.pop("output") == str(runs["first"].folder)
    settings["hyperparameters"] = parse_hyperparameters(PPOSettings, settings["hyperparameters"])
    rebuilt = TrainConfig(**settings, output=tmp_path / "rebuilt")
    assert replace(rebuilt, output=None) == TrainConfig(steps=20_000, seed=0, torch_threads=1, hyperparameters=SMALL)
    assert description["command"][1:] == sys.argv[1:]
    versions = description["versions"]
    assert versions.pop("python") == platform.python_version()
    assert {"numpy", "numba", "torch", "stable-baselines3", "duffing-env"} <= set(versions)
    assert versions == {name: version(name) for name in versions}


def test_the_card_says_what_the_policy_was_trained_on(runs):
    folder = runs["first"].folder
    description = json.loads((folder / "config.json").read_text())
    card = make_policy(str(folder)).card
    assert card.pop("network")["layers"] == ["mlp_extractor.policy_net.0", "action_net"]
    assert card.pop("features").keys() == {"own", "model", "degree", "lag"}
    assert card == {"format": 4, "observation": "posterior", "algorithm": "ppo", "steps": 20_480, **description}
    assert make_policy(str(folder / "checkpoints" / "000008192")).card["steps"] == 8192


def test_checkpoints_are_policies_on_the_way(runs):
    folders = sorted((runs["first"].folder / "checkpoints").iterdir())
    observations = np.random.default_rng(0).normal(size=(50, 22))
    *actions, trained = (
        make_policy(str(folder)).predict(observations, deterministic=True)[0]
        for folder in [*folders, runs["first"].folder]
    )
    for earlier, later in pairwise(actions):
        assert not np.array_equal(earlier, later)
    np.testing.assert_array_equal(actions[-1], trained)  # each comes after the update of its samples


def test_the_curve_and_the_log_agree(runs):
    run = runs["first"]
    steps, seconds, returns = np.array(run.curve, dtype=float).T
    np.testing.assert_array_equal(steps, [4096, 8192, 12288, 16384, 20480])
    assert np.all(np.diff(seconds) > 0)
    assert 0 < seconds[0] < seconds[-1] < run.seconds
    # The first episodes end with the fourth update; a few that reach the limit end before.
    rows = list(csv.DictReader((run.folder / "progress.csv").read_text().splitlines()))
    assert [int(row["time/total_timesteps"]) for row in rows] == steps.tolist()
    logged = [float(row["rollout/ep_rew_mean"]) for row in rows if row["rollout/ep_rew_mean"]]
    np.testing.assert_allclose(returns[np.isfinite(returns)], logged, rtol=1e-6)
    assert np.isfinite(returns[-2:]).all()


def test_reward_and_options_reach_the_environment(tmp_path, monkeypatch):
    made = []

    class Spy(agents.sb3_vec_env.DuffingVecEnv):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            made.append(self)

    monkeypatch.setattr("agents.training.environments.training_envs.DuffingVecEnv", Spy)
    run = tiny(tmp_path / "run", reward="parameter_error", options={"horizon": 8, "max_output": 3.0, "spread": 0.1})
    envs, examples = made  # these show how the features vary
    assert examples.envs.experiment.horizon == 8
    experiment = envs.envs.experiment
    assert (experiment.reward, experiment.horizon, experiment.max_output) == ("parameter_error", 8, 3.0)
    assert (experiment.spread, envs.num_envs) == (0.1, 8)
    rows = list(csv.DictReader((run.folder / "progress.csv").read_text().splitlines()))
    assert float(rows[-1]["rollout/ep_len_mean"]) == 8
    assert all(-1 <= mean_return <= 1 for _, _, mean_return in run.curve)


def test_no_training_meets_a_system_that_policies_are_compared_on():
    def begun(options):
        envs = make_track_batch("duffing_env/Short-v0", 256, options)
        envs.reset(seed=0)
        return envs.truth.m

    for seed in range(3):
        envs = make_training_envs(TrainConfig(env="duffing_env/Short-v0", seed=seed, hyperparameters=SMALL), seed)
        envs.reset()
        met = {*envs.envs.truth.m.tolist()}
        if seed == 0:
            assert met <= {*begun({}).tolist()}  # what TESTED is for
        for _ in range(200):
            envs.step(np.ones((64, 1), dtype=np.float32))
            met |= {*envs.envs.truth.m.tolist()}
        assert len(met) > 4 * 64
        assert not met & {*begun(TEST_OPTIONS).tolist()}


def test_a_training_can_begin_with_the_network_of_a_policy(runs, tmp_path):
    settings = {"output": tmp_path / "on", "begin": runs["first"].folder, "steps": 4096}
    begun = train(TrainConfig(**settings, hyperparameters=replace(SMALL, learning_rate=1e-12)))
    before, after = (load_file(folder / "policy.safetensors") for folder in (runs["first"].folder, begun.folder))
    for name, tensor in before.items():
        np.testing.assert_allclose(after[name], tensor, atol=1e-6)
    # All samples count that it ever learned from, and again where it is gone on with.
    steps = [make_policy(str(place)).card["steps"] for place in (runs["first"].folder, *begun.folder.glob("**/0*"))]
    assert steps[0] == 20480
    assert make_policy(str(begun.folder)).card["steps"] == max(steps[1:]) == 20480 + 4096
    again = replace(SMALL, learning_rate=1e-12)
    settings |= {"output": tmp_path / "further", "begin": begun.folder}
    further = train(TrainConfig(**settings, hyperparameters=again))
    assert make_policy(str(further.folder)).card["steps"] == 20480 + 2 * 4096
    with pytest.raises(ValueError, match="begin must be a policy with the network of the training"):
        tiny(tmp_path / "other", begin=runs["first"].folder)
    with pytest.raises(ValueError, match=r"begin must be the folder of a policy, but .*nowhere has no policy"):
        tiny(tmp_path / "another", begin=tmp_path / "nowhere")


def test_hyperparameters_reach_the_algorithm(tmp_path):
    ppo = replace(TINY, n_steps=32, n_epochs=3, log_std_init=-1.25, hidden=(5, 7), learning_rate=1e-9)
    run = tiny(tmp_path / "run", steps=512, hyperparameters=ppo)
    weights = load_file(run.folder / "policy.safetensors")
    assert weights["mlp_extractor.policy_net.0.weight"].shape == (5, len(FEATURE_NAMES) + 22)
    assert weights["mlp_extractor.policy_net.2.weight"].shape == (7, 5)
    assert weights["action_net.weight"].shape == (1, 7)
    np.testing.assert_allclose(weights["log_std"], -1.25, atol=1e-5)
    rows = list(csv.DictReader((run.folder / "progress.csv").read_text().splitlines()))
    assert [int(row["time/total_timesteps"]) for row in rows] == [256, 512]
    # The second row tells of the first update: half of the samples are left then.
    assert float(rows[1]["train/learning_rate"]) == pytest.approx(0.5e-9)
    assert int(rows[1]["train/n_updates"]) == 3


@table(("checkpoints", "expected"), [(1, [512]), (2, [256, 512]), (4, [128, 256, 384, 512])])
def test_checkpoints_are_evenly_spaced(tmp_path, checkpoints, expected):
    run = tiny(tmp_path / "run", steps=512, checkpoints=checkpoints)
    assert sorted(int(path.name) for path in (run.folder / "checkpoints").iterdir()) == expected


def test_a_folder_that_holds_something_else_is_refused(tmp_path):
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match=r"output must be a new or empty folder, but .* holds manifest.json, "):
        tiny(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.json"]


def test_a_folder_that_holds_a_run_is_refused_untouched(runs):
    folder = runs["other"].folder
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=r"output must be a new folder, but .*other holds a run; remove it or name"):
        tiny(folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_training_in_which_no_episode_ended_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("estimator.support.progress.REPORT_INTERVAL", 0.0)
    settings = {"hyperparameters": TINY, "systems": 0, "reward": "information_gain"}
    TrainCommand(steps=256, output=tmp_path / "run", options={"max_output": 10.0}, **settings).run()
    printed, said = capsys.readouterr()
    assert "left: no episode has ended" in " ".join(said.split())
    assert "No episode ended, so there is no learning curve" in printed
    assert "nan" not in printed
    assert not (tmp_path / "run" / "learning_curve.png").exists()


def test_runs_without_a_name_are_numbered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = [tiny(seed=seed).folder for seed in (7, 7, 3, 7)]
    names = ["ppo-amplitude-v0-7", "ppo-amplitude-v0-7-2", "ppo-amplitude-v0-3", "ppo-amplitude-v0-7-3"]
    assert [str(folder) for folder in folders] == [f"runs/{name}" for name in names]
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == sorted(names)
    assert json.loads((folders[0] / "config.json").read_text())["config"]["output"] is None


@pytest.mark.parametrize("seen", ["history", "privileged"])
def test_another_observation_than_the_posterior_has_no_features(tmp_path, seen):
    with pytest.raises(
        ValueError, match=f"observation must be 'posterior' with features, but is '{seen}'; add --ppo.no-features"
    ):
        TrainConfig(env="Short-v0", options={"observation": seen})
    settings = {"options": {"observation": seen}, "hyperparameters": replace(TINY, features=False)}
    run = tiny(tmp_path / "run", env="Short-v0", **settings)
    assert (run.folder / "policy.json").exists()


@table(
    ("settings", "message"),
    [
        ({"algo": np.ones(2)}, r"algo must be one of \['ppo', .*\], but is array"),
        ({"env": np.ones(2)}, "env must be the id of a track such as duffing_env/Short-v0, but is array"),
        ({"steps": 0}, "steps must be a whole number from 1 to 1000000000000, but is 0"),
        ({"checkpoints": 0}, "checkpoints must be a whole number from 1 to 10000, but is 0"),
        ({"torch_threads": -1}, "torch_threads must be a whole number from 1 to 1024, but is -1"),
        ({"options": {"reward": "log_posterior"}}, "options must not hold reward"),
        ({"options": {"horizons": 3}}, "did you mean 'horizon'"),
        ({"reward": "information_gian"}, "did you mean 'information_gain'"),
        ({"seed": -1}, "[Ss]eed"),
    ],
)
def test_senseless_settings_are_refused_before_anything_is_written(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        tiny(tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


@table(
    ("settings", "message"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, but is 0"),
        ({"n_steps": 0}, "n_steps must be at least 1, but is 0"),
        ({"n_epochs": 0}, "n_epochs must be at least 1, but is 0"),
        ({"batch_size": 0}, "batch_size must be at least 1, but is 0"),
        ({"batch_size": 1}, "must be at least 2"),
        ({"num_envs": 1, "n_steps": 1}, "must be at least 2"),
        ({"hidden": (8, 0)}, r"hidden\[1\] must be at least 1, but is 0"),
        ({"learning_rate": float("nan")}, "learning_rate must be finite, but is nan; give a number"),
        ({"learning_rate": 0.0}, "learning_rate must be positive, but is 0.0"),
        ({"gamma": 1.5}, r"gamma must be in \[0, 1\], but is 1.5"),
        ({"gae_lambda": -0.1}, r"gae_lambda must be in \[0, 1\], but is -0.1"),
    ],
)
def test_senseless_hyperparameters_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        PPOSettings(**{**asdict(TINY), **settings})


@pytest.mark.slow  # a training that has to be long enough to learn something
def test_training_beats_open_loop_signals(tmp_path):
    """Clearly: on the same systems, 95 % intervals apart, after 600,000 samples."""
    ppo = PPOSettings(num_envs=256, n_steps=32, batch_size=2048, learning_rate=3e-3, hidden=(32,))
    run = train(TrainConfig(steps=600_000, output=tmp_path / "run", torch_threads=1, hyperparameters=ppo))
    learned, uniform, multisine = (
        summarise_metrics(evaluation)["log_posterior_gain"]
        for evaluation in evaluate_policies([str(run.folder), "uniform", "silverbox-multisine"], systems=128, seed=1)
    )
    assert learned["low"] > uniform["high"] > multisine["high"]
    assert run.curve[-1][2] > uniform["mean"]


@pytest.mark.slow
def test_sac_beats_open_loop_signals(tmp_path):
    """With the file's hyperparameters, on the same systems, 95 % intervals apart, after 30,000 samples."""
    env = "duffing_env/Short-v0"
    run = train(TrainConfig(algo="sac", env=env, steps=30_000, output=tmp_path / "run"))
    learned, uniform = (
        summarise_metrics(evaluation)["log_posterior_gain"]
        for evaluation in evaluate_policies([str(run.folder), "uniform"], env, systems=128, seed=1)
    )
    assert learned["low"] > uniform["high"]


@pytest.mark.skipif(sys.platform == "win32", reason="this system has no such locks")
@pytest.mark.parametrize("begin", [train, lambda config: resume(config.output)], ids=["train", "resume"])
def test_a_folder_that_another_trains_in_is_refused_untouched(tmp_path, begin):
    (tmp_path / "run").mkdir()
    holds = "import sys; from pathlib import Path; from estimator.support.file_io import lock_folder\n"
    holds += "held = lock_folder('output', Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    words = [sys.executable, "-c", holds, tmp_path / "run"]
    other = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "held\n"
    config = TrainConfig(steps=256, output=tmp_path / "run", torch_threads=1, hyperparameters=TINY)
    if begin is not train:
        write_json(tmp_path / "run" / "config.json", describe_run(config))
    before = {path: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    with pytest.raises(ValueError, match="must be a folder that no other process writes to, but one writes to"):
        begin(config)
    assert {path: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before
    other.kill()  # the kernel lets go of the folder
    other.communicate()
    assert begin(config).folder == tmp_path / "run"


def test_of_two_trainings_in_one_folder_the_second_refuses(tmp_path):
    seen = []

    def second(steps, found):
        with pytest.raises(ValueError, match="output must be a new"):
            tiny(tmp_path / "run", seed=1)
        with pytest.raises(ValueError, match="resume must be a folder that no other process writes to"):
            resume(tmp_path / "run")
        seen.append(steps)

    train(
        TrainConfig(steps=256, output=tmp_path / "run", torch_threads=1, hyperparameters=TINY, eval_every=256), second
    )
    assert seen == [0, 256]
    assert json.loads((tmp_path / "run" / "policy.json").read_text())["config"]["seed"] == 0


def test_settings_that_make_no_sense_leave_no_folder(tmp_path):
    with pytest.raises(ValueError, match="begin must be the folder of a policy"):
        tiny(tmp_path / "a" / "run", begin=tmp_path)
    assert not list(tmp_path.iterdir())
