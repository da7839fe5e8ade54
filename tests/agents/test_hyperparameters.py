"""Files of hyperparameters: what they may hold, what is refused, and what reaches a training."""

from dataclasses import fields, replace

import pytest
from tables import table

from agents.training import ALGORITHMS, PPOSettings, SACSettings, TrainConfig
from agents.training.hyperparameters import (
    HYPERPARAMETER_FOLDER,
    parse_hyperparameters,
    read_hyperparameters,
    track_name,
    write_hyperparameters,
)
from duffing_env import TRACKS
from estimator import Channel, Rig
from estimator.compilation.simd import LANES

SHORT = "duffing_env/Short-v0"


def written(tmp_path, text):
    path = tmp_path / "settings.toml"
    path.write_text(text)
    return path


def test_there_is_one_file_for_each_algorithm():
    assert sorted(path.stem for path in HYPERPARAMETER_FOLDER.iterdir()) == sorted(ALGORITHMS)


@pytest.mark.parametrize("algo", ALGORITHMS)
@table("env_id", TRACKS)
def test_every_file_is_sound_for_every_track(algo, env_id):
    assert type(read_hyperparameters(algo, env_id)) is ALGORITHMS[algo]


def test_ppo_is_as_its_class_says_where_its_file_is_silent():
    amplitude, power, short = (
        read_hyperparameters("ppo", f"duffing_env/{name}-v0") for name in ("Amplitude", "Power", "Short")
    )
    others = ("duffing_env/Amplitude-v1", "duffing_env/Rig-v0", "duffing_env/WienerHammerstein-v0")
    assert [read_hyperparameters("ppo", other) for other in others] == [amplitude] * 3
    assert (amplitude.features, amplitude.own, amplitude.levels, amplitude.gamma) == (True, True, 2, 1.0)
    assert (amplitude.n_epochs, amplitude.activation) == (PPOSettings().n_epochs, PPOSettings().activation)
    assert (power.levels, short.n_steps, amplitude.hidden) == (5, 48, (128, 128))
    assert read_hyperparameters("ppo", "family").num_envs % LANES == 0
    assert TrainConfig(env="duffing_env/Amplitude-v0").hyperparameters == amplitude


def test_a_track_goes_before_the_default(tmp_path):
    path = written(tmp_path, "[default]\ntau = 0.01\ngamma = 0.9\nhidden = [8, 4]\n[Short]\ngamma = 1\n")
    assert read_hyperparameters("sac", SHORT, path) == SACSettings(tau=0.01, gamma=1.0, hidden=(8, 4))
    assert read_hyperparameters("sac", "duffing_env/Power-v0", path) == SACSettings(tau=0.01, gamma=0.9, hidden=(8, 4))
    assert TrainConfig(algo="sac", env=SHORT, settings=path).hyperparameters.tau == 0.01


def test_hyperparameters_that_are_given_go_before_the_file(tmp_path):
    path = written(tmp_path, "[default]\ngamma = 0.9\n")
    given = PPOSettings(n_steps=3)
    assert TrainConfig(settings=path, hyperparameters=given).hyperparameters is given
    with pytest.raises(ValueError, match="hyperparameters must be SACSettings for sac, but are PPOSettings"):
        TrainConfig(algo="sac", hyperparameters=given)


@table(
    ("text", "message"),
    [
        (
            "[default]\ngama = 0.9",
            r"gama is no hyperparameter of SACSettings; did you mean 'gamma'\?; mend \[default\]",
        ),
        ("[Power]\ntaau = 0.9", r"did you mean 'tau'\?; mend \[Power\] of .*settings.toml"),
        ("[default]\nn_steps = 64", "n_steps is no hyperparameter of SACSettings"),
        ('["Short-v1"]\ngamma = 0.9', r"has \[Short-v1\]; did you mean 'Short'\?"),
        ("gamma = 0.9", r"must be in tables such as \[default\], but .* has gamma in none"),
        ('[default]\ngamma = "high"', "gamma must be a number, but is 'high'"),
        ("[default]\nnum_envs = 2.5", "num_envs must be a whole number, but is 2.5"),
        ("[default]\nnum_envs = true", "num_envs must be a whole number, but is True"),
        ("[default]\nhidden = 64", "hidden must be a list of whole numbers, but is 64"),
        ("[default]\nhidden = [64, 0.5]", "hidden must be a list of whole numbers"),
        ("[default]\ntau = 2", r"tau must be in \[0, 1\], but is 2.0"),
        ("[default]\nentropy_weight = 0", "entropy_weight must be positive, but is 0.0"),
        ("[default]\nlearning_starts = -1", "learning_starts must be at least 0, but is -1"),
        ("[default]\nlearning_rate =", "settings must be a TOML file, but .*settings.toml is not"),
    ],
)
def test_a_mistake_is_refused_by_name(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read_hyperparameters("sac", SHORT, written(tmp_path, text))


def test_an_unknown_algorithm_is_refused():
    with pytest.raises(ValueError, match=r"algo must be one of \['ppo', .* but is 'saac'; did you mean 'sac'\?"):
        read_hyperparameters("saac", SHORT)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_what_is_written_is_read(tmp_path, algo):
    settings = replace(ALGORITHMS[algo](), learning_rate=1.2345678901234567e-5, hidden=(3, 2, 1), gamma=1.0)
    write_hyperparameters(tmp_path / "best.toml", SHORT, settings, "a comment")
    assert read_hyperparameters(algo, SHORT, tmp_path / "best.toml") == settings
    with pytest.raises(ValueError, match=r"settings must have a table \[Power\] or \[default\].*has \[Short\]"):
        read_hyperparameters(algo, "duffing_env/Power-v0", tmp_path / "best.toml")


@pytest.mark.parametrize("kind", ALGORITHMS.values())
def test_a_search_stays_within_the_hyperparameters(kind):
    """Every name that a search chooses is a field, lies about the default, and makes sense at both ends."""

    class Trial:
        def __init__(self, end):
            self.end = end

        def suggest_float(self, name, low, high, log=False):
            assert low <= getattr(kind(), name) <= high, name
            return (low, high)[self.end]

        suggest_int = suggest_float

    Trial.suggest_int = lambda self, name, low, high, log=False, step=1: self.suggest_float(name, low, high)
    for end in (0, 1):
        found = kind.sample_hyperparameters(Trial(end))
        assert len(found) >= 5
        assert parse_hyperparameters(kind, found) != kind()
    assert {"learning_rate", "gamma"} < set(found) < {f.name for f in fields(kind)}


def test_the_name_of_a_table_is_that_of_the_track():
    assert track_name("duffing_env/Amplitude-v0") == "Amplitude-v0"
    assert track_name("Own-v3") == "Own-v3"


def test_a_rig_is_written_out_so_that_a_run_can_rebuild_itself(tmp_path):
    guess = dict.fromkeys("mcab", (1.0, 2.0))
    rig = Rig(1e-3, input=Channel("N", limit=6.0), output=Channel("m", range=0.03), guess=guess)
    lines = ["step = 1e-3", "[input]", 'unit = "N"', "limit = 6.0", "[output]", 'unit = "m"', "range = 0.03", "[guess]"]
    path = tmp_path / "rig.toml"
    path.write_text("\n".join([*lines, *(f"{name} = [1.0, 2.0]" for name in "mcab")]))
    config = TrainConfig(rig=str(path), options={"horizon": 64})
    path.unlink()
    assert (config.env, config.rig) == ("duffing_env/Rig-v0", None)
    assert config.options == {"horizon": 64, "rig": rig.to_dict()}
    assert config.hyperparameters == read_hyperparameters("ppo", "duffing_env/Rig-v0")
    with pytest.raises(FileNotFoundError, match="rig must be a file"):
        TrainConfig(rig=str(path))
