"""The command lines of `train.py` and `evaluate.py`, as a user meets them."""

import ast
import json
import os
import runpy
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import tyro
from tables import table

from agents.cli import run_script
from agents.commands import main
from agents.json_options import JsonOptions
from agents.track_ids import options_with_rig
from agents.training import TrainConfig
from agents.training.hyperparameters import track_name
from estimator import Rig

ROOT = Path(__file__).parents[2]
#: Where the options of each script are declared: file and class.
DECLARED = {
    "train.py": [("agents/commands/train_command.py", "TrainCommand", ""),
                 ("agents/training/training_config.py", "TrainingSubject", ""),
                 ("agents/training/training_config.py", "TrainConfig", ""),
                 ("agents/training/algorithms.py", "AlgorithmSettings", "ppo."),
                 ("agents/training/algorithms.py", "OnPolicySettings", "ppo.")],
    "evaluate.py": [("agents/commands/evaluate_command.py", "EvaluateCommand", "")],
}  # fmt: skip


@pytest.fixture
def script(tmp_path, monkeypatch, capsys):
    """Runs a script as the shell would, in an empty folder, but within this process: returns status, out and err."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        status = 0
        try:
            runpy.run_path(str(ROOT / name), run_name="__main__")
        except SystemExit as stop:
            status = stop.code
        printed, said = capsys.readouterr()
        # What is wrong with a value stands in a box, broken into lines.
        return status, printed, " ".join(said.replace("│", " ").replace("|", " ").split()) if "----" in said else said

    return run


def declared_options(file, name):
    """Name and explanation of every field of a configuration class, read from its source."""
    tree = ast.parse((ROOT / file).read_text())
    (cls,) = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name]
    for statement, following in zip(cls.body, [*cls.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign):
            assert isinstance(following, ast.Expr), f"{name}.{statement.target.id} has no explanation"
            yield statement.target.id, following.value.value


@pytest.mark.parametrize("name", DECLARED)
def test_help_explains_every_option(script, name):
    status, printed, messages = script(name, "--help")
    assert (status, messages) == (0, "")
    assert max(map(len, printed.splitlines())) <= 80
    lines = [line.strip("│ ") for line in printed.splitlines()]
    begins = [i for i, line in enumerate(lines) if line.startswith("-") or set(line) & set("╭╰")]
    explained = 0
    for file, cls, prefix in DECLARED[name]:
        for option, explanation in declared_options(file, cls):
            if option == "hyperparameters":
                continue  # those of the last classes
            flag = f"--{prefix}{option}".replace("_", "-")
            (index,) = [i for i, line in enumerate(lines) if line.split(" ")[0].rstrip(",") == flag]
            end = next((i for i in begins if i > index), len(lines))
            here = "".join(lines[index:end]).replace(" ", "")
            assert explanation.replace(" ", "") in here, flag
            assert "(default:" in here, flag
            explained += 1
    assert explained == {"train.py": 36, "evaluate.py": 12}[name]


@table(
    ("name", "arguments", "message"),
    [
        ("train.py", ["--steps", "0"], "steps must be a whole number from 1 to 1000000000000, but is 0"),
        ("train.py", ["--steps", "many"], "many"),
        ("train.py", ["--stepps", "5"], "--stepps"),
        ("train.py", ["--reward", "free_energie"], "did you mean 'free_energy'"),
        ("train.py", ["--systems", "1"], "systems must be 0 or at least 2, but is 1"),
        ("train.py", ["--ppo.batch-size", "0"], "batch_size must be at least 1, but is 0"),
        ("train.py", ["--options", '{"reward": "log_posterior"}'], "options must not hold reward"),
        ("train.py", ["--options", '{"horizon": 0}'], "horizon must be a whole number from 1 to 1000000000, but is 0"),
        ("train.py", ["--env", "duffing_env/Amplitud-v0"], "Amplitud"),
        ("train.py", ["--env", "Shrt-v1"], "`Shrt` doesn't exist; did you mean 'duffing_env/Short-v1'?"),
        ("train.py", ["--env", "CartPole-v1"], "env must be a track, which has a vector environment of duffing_env"),
        ("train.py", ["--algo", "sacc"], "invalid choice 'sacc'"),
        ("train.py", ["--algo", "sac", "--sac.tau", "2"], "tau must be in [0, 1], but is 2.0"),
        ("train.py", ["--algo", "sac", "--ppo.gamma", "0.9"], "--ppo.gamma"),
        ("train.py", ["--algo", "sac", "--steps", "5000"], "learning_starts must be below steps, but is 5000 of 5000"),
        ("train.py", ["--settings", "none.toml"], "none.toml"),
        ("train.py", ["--eval-every", "-1"], "eval_every must be a whole number from 0 to 1000000000000, but is -1"),
        ("train.py", ["--tune", "-1"], "tune must be a whole number from 0 to 1000000, but is -1"),
        ("train.py", ["--resume", "none"], "resume takes all settings but systems from the run"),
        ("train.py", ["--rig", "silverbox", "--env", "Short-v0"], "env must be left out with rig"),
        ("evaluate.py", ["--rig", "r.toml", "--env", "Short-v0"], "env must be left out with rig"),
        ("evaluate.py", ["--env", "CartPole-v1"], "env must be a track, which has a vector environment of duffing_env"),
        ("evaluate.py", ["--systems", "1"], "systems must be a whole number from 2 to 100000, but is 1"),
        ("evaluate.py", ["--systems", "a few"], "a few"),
        ("evaluate.py", ["--policies", "unifrom"], "did you mean 'uniform'"),
        ("evaluate.py", ["--options", "[1]"], "options must be a JSON object, but are [1]"),
        ("evaluate.py", ["--options", "[" * 100_000], "options must be a JSON object, but are nested too deeply"),
        ("evaluate.py", ["--options", '{"num_envs": 3}'], "options must not hold num_envs"),
        ("evaluate.py", ["--options", '{"autoreset_mode": "x"}'], "options must not hold autoreset_mode"),
        ("train.py", ["--options", '{"max_episode_steps": "x"}'], "options must not hold max_episode_steps"),
        ("train.py", ["--options", '{"seed": 3}'], "options must not hold seed, but seed is 3; leave it out"),
        ("train.py", ["--options", '{"levels": 3}'], "options must not hold levels, but levels is 3; leave it out"),
        ("train.py", ["--options", '{"id": "x"}'], "options must not hold id, but id is 'x'; leave it out"),
        ("evaluate.py", ["--options", '{"id": "x"}'], "options must not hold id, but id is 'x'; leave it out"),
        ("evaluate.py", ["--options", '{"vectorization_mode": "sync"}'], "options must not hold vectorization_mode"),
        ("evaluate.py", ["--options", '{"horizon"'], "JSON"),
        ("evaluate.py", ["--options", '{"horizn": 3}'], "did you mean 'horizon'"),
        ("evaluate.py", ["--env", "duffing_env/Amplitude-v7"], "Did you mean: `Amplitude-v1`?"),
    ],
)
def test_a_bad_value_is_one_message_and_exit_status_2(script, name, arguments, message):
    status, _, messages = script(name, *arguments, "--output", "out")
    assert status == 2
    assert message in messages
    assert list(Path().iterdir()) == []


def test_a_rig_may_be_one_that_ships(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert options_with_rig({"horizon": 9}, "beam") == {"horizon": 9, "rig": Rig.shipped("beam").to_dict()}


def test_a_bad_value_shows_no_traceback(tmp_path):
    """In a process of its own; other output may come before."""
    finished = subprocess.run(
        [sys.executable, ROOT / "evaluate.py", "--policies", "foo"],
        env=os.environ | {"COLUMNS": "400"}, capture_output=True, text=True, timeout=600, cwd=tmp_path,
    )  # fmt: skip
    assert (finished.returncode, finished.stdout) == (2, "")
    (line,) = (line for line in finished.stderr.splitlines() if not line.startswith("duffing-env is compiling"))
    assert line.startswith("evaluate.py: ")
    assert "'foo'" in line
    assert list(tmp_path.iterdir()) == []


def test_a_bad_reward_is_one_line(script, tmp_path):
    status, printed, messages = script("train.py", "--reward", "foo")
    assert status == 2
    note = "An update takes 32,768 samples, so 5,013,504 will be learned from, not 5,000,000."
    assert " ".join(printed.split()) == note
    (line,) = (line for line in messages.splitlines() if not line.startswith("duffing-env is compiling"))
    assert line.startswith("train.py: ")
    assert "'foo'" in line
    assert list(tmp_path.iterdir()) == []


@table(
    ("name", "arguments", "package", "extra"),
    [
        ("train.py", ["--output", "out"], "torch", "train"),
        ("train.py", ["--tune", "2", "--output", "out"], "optuna", "tune"),
        ("train.py", ["--algo", "tqc", "--output", "out"], "sb3_contrib", "train"),
        ("evaluate.py", ["--policies", "prbs", "--report", "out"], "matplotlib", "report"),
    ],
)
def test_a_missing_extra_is_one_line(script, name, arguments, package, extra, monkeypatch):
    monkeypatch.setattr(
        "estimator.support.optional_dependencies.find_spec", lambda name: None if name == package else name
    )
    status, _, messages = script(name, *arguments)
    assert status == 2
    assert messages == f"{name}: {package} is not installed; get it with: pip install 'duffing-env[{extra}]'\n"
    assert list(Path().iterdir()) == []


def test_figures_are_left_out_without_matplotlib(script, monkeypatch, tmp_path):
    monkeypatch.setattr("estimator.support.optional_dependencies.find_spec", lambda name: None)
    arguments = ["--policies", "prbs", "--systems", 2, "--options", '{"horizon": 4}', "--output", "out"]
    assert script("evaluate.py", *arguments)[0] == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["evaluation.json"]


@pytest.mark.parametrize("name", ["train.py", "evaluate.py"])
def test_examples_in_the_help_keep_lines_of_their_own(script, name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    _, printed, _ = script(name, "--help")
    lines = [line.strip() for line in printed.splitlines() if "duffing-env " in line]
    assert len(lines) >= 7
    assert all(line.startswith("$ duffing-env ") and line.count("$") == 1 and len(line) < 80 for line in lines)


def test_the_list_of_commands_has_no_examples_that_would_be_broken(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main(["--help"])
    printed = capsys.readouterr().out
    assert "$" not in printed
    assert "• evaluate  Compare policies on common random numbers" in printed
    assert "• rig       Describe your rig in a file" in printed


def test_help_of_the_command_is_quick():
    """It imports nothing that computes, neither for the list of commands nor for one of them."""
    code = (
        "import sys\nfrom agents.commands import main\n"
        "for words in (['--help'], ['identify', '--help']):\n"
        "    try:\n        main(words)\n    except SystemExit:\n        pass\n"
        "    heavy = {'numba', 'scipy', 'torch', 'gymnasium', 'numpy', 'sympy', 'matplotlib'} & sys.modules.keys()\n"
        "    print(words, *heavy - ({'numpy', 'sympy'} if len(words) > 1 else set()), file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert "train" in done.stdout
    assert done.stderr == "['--help']\n['identify', '--help']\n"


def test_a_folder_that_is_a_file_is_one_message(script, tmp_path):
    (tmp_path / "out").write_text("precious")
    arguments = ["--policies", "uniform", "--systems", 2, "--options", '{"horizon": 4}', "--output", "out"]
    status, _, messages = script("evaluate.py", *arguments)
    assert status == 2
    assert messages.startswith("evaluate.py: ")
    assert "out" in messages
    assert (tmp_path / "out").read_text() == "precious"


def test_the_module_that_registers_a_track_may_stand_before_its_id(script, tmp_path, monkeypatch):
    (tmp_path / "own_of_tests.py").write_text(
        "import gymnasium as gym\n"
        "gym.register('mine/OfTests-v0', entry_point='duffing_env.env:DuffingEnv',\n"
        "             vector_entry_point='duffing_env.vector_env:DuffingVectorEnv', kwargs={'horizon': 4})\n"
    )
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    env = "own_of_tests:mine/OfTests-v0"
    status, _, messages = script("evaluate.py", "--env", env, "--policies", "uniform", "--systems", 2)
    assert status == 0, messages
    document = json.loads((tmp_path / "runs" / "evaluation" / "evaluation.json").read_text())
    assert document["settings"]["env"] == env
    config = TrainConfig(env=env)
    assert (config.env, track_name(config.env)) == (env, "OfTests-v0")
    assert TrainConfig(env="duffing_env:duffing_env/Short-v0") == TrainConfig(env="Short-v0")
    status, _, messages = script("evaluate.py", "--env", "no_such_module:mine/OfTests-v0")
    assert status == 2
    assert "env must be the id of a track such as duffing_env/Short-v0, but is no_such_module:mine/OfT" in messages


def test_train_then_evaluate(script, tmp_path):
    """The way through both scripts: a policy that one wrote, the other compares."""
    status, printed, messages = script(
        "train.py", "--steps", 512, "--seed", 4, "--options", '{"horizon": 32}', "--output", "made", "--systems", 4,
        "--torch-threads", 1, "--ppo.num-envs", 16, "--ppo.n-steps", 16, "--ppo.batch-size", 128, "--ppo.hidden", 6, 5,
    )  # fmt: skip
    assert status == 0, messages
    # On a machine that has not compiled its kernels yet it says so, and on a slow one how far it is.
    lines = messages.splitlines()
    said = [line for line in lines if not line.startswith(("duffing-env is compiling ", "Training ", "Evaluating "))]
    assert " ".join(said) == (
        "duffing-env: warning: a training of 2 updates may leave a policy worse than it began; take more steps than 512"
    )
    assert max(map(len, (*lines, *printed.splitlines()))) <= 80
    assert "The run is in made" in printed
    made = {path.name for path in (tmp_path / "made").iterdir()}
    pictures = {"contraction.png", "excitations.png", "learning_curve.png"}
    assert made == pictures | {
        "checkpoints", "config.json", "evaluation.json", "policy.json", "policy.safetensors", "progress.csv",
        "untrained",
    }  # fmt: skip
    assert any(line.startswith("shield ") for line in printed.splitlines())
    for name in (*pictures, "evaluation.json"):
        assert str(Path("made") / name) in printed.splitlines()
    description = json.loads((tmp_path / "made" / "config.json").read_text())
    assert description["config"]["options"] == {"horizon": 32}
    assert description["config"]["hyperparameters"]["hidden"] == [6, 5]
    assert description["command"][:5] == ["train.py", "--steps", "512", "--seed", "4"]
    compared = json.loads((tmp_path / "made" / "evaluation.json").read_text())
    assert list(compared["policies"]) == ["made/untrained", "made", "ppo/amplitude", "shield", "efe", "prbs", "uniform"]

    arguments = ["--policies", "made", "prbs", "--options", '{"horizon": 32}', "--systems", 4]
    status, _, messages = script("evaluate.py", *arguments)
    assert status == 0, messages
    evaluated = json.loads((tmp_path / "runs" / "evaluation" / "evaluation.json").read_text())
    assert evaluated["settings"] == {
        "env": "duffing_env/Amplitude-v0", "systems": 4, "seed": 0, "options": {"horizon": 32},
    }  # fmt: skip
    for name, metrics in evaluated["policies"].items():
        timed = {"decision_time": metrics["decision_time"]}
        assert metrics == {**compared["policies"][name], **timed}
    assert list(evaluated["policies"]) == ["made", "prbs"]


@dataclass(frozen=True)
class Config:
    """A script's configuration."""

    options: JsonOptions = field(default_factory=lambda: {"a": 1})
    """Options."""


@table(
    ("text", "expected"),
    [
        ("{}", {}),
        ('{"spread": 0.2, "horizon": 128}', {"spread": 0.2, "horizon": 128}),
        ('{"as_published": true, "data": null}', {"as_published": True, "data": None}),
        ('{"a": {"b": [1, 2]}}', {"a": {"b": [1, 2]}}),
    ],
)  # fmt: skip
def test_options_are_read_as_json(text, expected):
    options = tyro.cli(Config, args=["--options", text]).options
    assert options == expected
    assert [type(value) for value in options.values()] == [type(value) for value in expected.values()]


def test_options_keep_their_default():
    assert tyro.cli(Config, args=[]).options == {"a": 1}


@table("text", ["[1]", "3", '"spread"', "null", "spread=0.2", "{'spread': 0.2}", ""])
def test_options_that_are_no_json_object_are_refused(text, capsys):
    with pytest.raises(SystemExit) as caught:
        tyro.cli(Config, args=["--options", text])
    assert caught.value.code == 2
    assert "options" in capsys.readouterr().err


def test_errors_of_the_program_are_not_hidden(monkeypatch):
    def fail(config):
        raise KeyError("a defect")

    monkeypatch.setattr(sys, "argv", ["script.py"])
    with pytest.raises(KeyError, match="a defect"):
        run_script(fail, Config, "A script.")


@table("error", [ValueError("mend this"), FileNotFoundError("mend this")])
def test_errors_of_the_user_are_one_line(monkeypatch, capsys, error):
    def fail(config):
        raise error

    monkeypatch.setattr(sys, "argv", ["folder/script.py"])
    with pytest.raises(SystemExit) as caught:
        run_script(fail, Config, "A script.")
    assert caught.value.code == 2
    assert capsys.readouterr().err == "script.py: mend this\n"
