"""The protocol, and the boards that its figures go into."""

import json
import multiprocessing
import sys

import gymnasium as gym
import numpy as np
import pytest
from tables import table

from agents.commands import main
from agents.evaluation.oracle import Oracle, TrackSystems
from agents.leaderboard import leaderboard_file, leaderboard_tables, protocol
from agents.policies import POLICIES

SHORT = "duffing_env/Short-v0"
PRBS = ("--protocol", "Short-v0", "--policies", "prbs")


@pytest.fixture(scope="module")
def entry():
    """The entry of uniform noise, on few systems."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "N_SYSTEMS", 8)
        return protocol.measure_policy("uniform", SHORT, "noise")


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(protocol, "N_SYSTEMS", 8)

    def run(*words):
        try:
            main(list(words))
        except SystemExit as stop:
            return stop.code, *capsys.readouterr()
        return 0, *capsys.readouterr()

    return run


def test_a_policy_of_one_s_own_reaches_the_board_with_one_command(command, tmp_path):
    (tmp_path / "lab.py").write_text("def push(seen):\n    return seen[:, 0] * 0 + 1\n")
    words = ("evaluate", "--protocol", "Short-v0", "--policies", "lab:push", "--submit", "push", "--samples", "90000")
    status, printed, messages = command(*words)
    assert status == 0, messages
    assert "push is on the board runs/leaderboard.jsonl" in printed
    (entry,) = leaderboard_file.read_entries(tmp_path / "runs/leaderboard.jsonl")
    assert (entry["name"], entry["track"], entry["budget"], entry["seeds"]) == ("push", SHORT, "0.1M", 1)
    assert entry["policies"]["lab:push"].startswith("sha256:")
    assert 0 < entry["score"]["low"] <= entry["score"]["iqm"] <= entry["score"]["high"] < 1
    assert entry["shifted"].keys() == {"parameters", "noises", "limits", "equation"}
    status, printed, _ = command("report", "--output", "board.html")
    assert status == 0
    assert any(line.split()[:1] == ["push"] for line in printed.splitlines())
    assert "<td>push</td>" in (tmp_path / "board.html").read_text()


def test_what_the_protocol_fixes_may_be_said(command, entry, monkeypatch):
    monkeypatch.setattr(protocol, "measure_policy", lambda *arguments: entry)
    said = ("--env", "Short-v0", "--systems", "256", "--seed", "0", "--options", "{}")
    assert command("evaluate", *PRBS, *said)[0] == 0


def test_the_score_is_against_the_bound_where_there_is_one(entry):
    oracle = Oracle.of(TrackSystems.of(SHORT, 8))
    evaluation = protocol._evaluate_on_track("uniform", SHORT, {"branch": "test"}, lambda share, at="": None)
    rows = np.swapaxes(evaluation.outputs, 0, 1)[:8]
    best, least = oracle.efficiency(evaluation.inputs.T[:8], rows)
    certified = np.isfinite(oracle.bounds)
    score = protocol._efficiency_scores(evaluation, oracle)
    assert certified.any()
    np.testing.assert_array_equal(score[certified], least[certified])
    np.testing.assert_array_equal(score[~certified], best[~certified])
    assert (least[certified] <= best[certified]).all()
    assert entry["reference"]["systems"] == 8
    assert entry["reference"]["certified"] == certified.sum()


def test_what_is_measured_twice_is_the_same(entry, monkeypatch):
    monkeypatch.setattr(protocol, "N_SYSTEMS", 8)
    again = protocol.measure_policy("uniform", SHORT, "noise")
    for part in (entry, again):
        part["metrics"].pop("decision_time", None)
    assert again == entry


@table("track", protocol.PROTOCOL_TRACKS)
def test_shifted_sets_are_other_sets(track):
    usual = gym.spec(track).kwargs
    for env_id, options in protocol.shifted_test_sets(track).values():
        assert env_id != track or any(usual.get(name) != value for name, value in options.items())
        gym.make_vec(env_id, num_envs=2, vectorization_mode="vector_entry_point", branch="test", **options)


@table(
    ("samples", "budget"),
    [
        (0, "none"),
        (1, "0.1M"),
        (100_352, "0.1M"),
        (1_048_576, "1M"),
        (1_060_000, "10M"),
        (10_485_760, "10M"),
        (12_058_624, "open"),
    ],
)
def test_budgets(samples, budget):
    assert protocol._budget_name(samples) == budget


@table(
    ("words", "message"),
    [
        (("--protocol", "Short-v0"), "policies must name one for the protocol"),
        (("--submit", "mine"), "submit goes with a protocol"),
        (("--protocol", "Drift-v0", "--policies", "prbs"), "protocol must be one of duffing_env/Short-v0"),
        (("--protocol", "Short-v0", "--policies", "prbs", "--submit", " "), "submit must be a name"),
        (("--protocol", "Short-v0", "--policies", "prbz"), "did you mean 'prbs'"),
        ((*PRBS, "--systems", "8"), "protocol fixes all but the policy, but systems is 8; leave it out"),
        ((*PRBS, "--seed", "3"), "protocol fixes all but the policy, but seed is 3; leave it out"),
        ((*PRBS, "--env", "Amplitude-v0"), "protocol fixes all but the policy, but env is Amplitude-v0; leave it out"),
        ((*PRBS, "--options", '{"horizon": 6}'), "but options is {'horizon': 6}; leave it out"),
        ((*PRBS, "--rig", "beam"), "but rig is beam; leave it out"),
        ((*PRBS, "--report", "out"), "but report is out; leave it out"),
        (
            ("--protocol", "Short-v0", "--policies", "prbs", "--samples", "-5"),
            "samples must be a whole number from 0 to",
        ),
    ],
)
def test_what_is_no_submission_is_refused(command, words, message, tmp_path):
    status, _, messages = command("evaluate", *words)
    assert status == 2
    assert message in messages
    assert list(tmp_path.iterdir()) == []


def test_blanks_around_a_name_do_not_make_it_another(tmp_path, monkeypatch, entry):
    monkeypatch.setattr(leaderboard_file, "SHIPPED_LEADERBOARD", tmp_path / "shipped.jsonl")
    leaderboard_file.append_entry(leaderboard_file.SHIPPED_LEADERBOARD, entry | {"name": " push "})
    for name in ("push", "push "):
        with pytest.raises(ValueError, match="which the board that ships has; name another"):
            leaderboard_file.check_new_entry(tmp_path / "board.jsonl", name)


@table("steps", [-5, "many", 1.5, None])
def test_steps_of_a_card_that_are_no_number_of_samples_are_refused(tmp_path, steps):
    (tmp_path / "policy.json").write_text(json.dumps({"steps": steps}))
    with pytest.raises(ValueError, match=r"steps of .*policy.json must be a whole number from 0 to .*, but is"):
        protocol.measure_policy(str(tmp_path), SHORT, "mine")


def test_the_latest_entry_of_a_name_counts(monkeypatch, tmp_path, entry):
    path = tmp_path / "made" / "board.jsonl"
    for seeds in (1, 2):
        leaderboard_file.append_entry(path, entry | {"seeds": seeds})
    leaderboard_file.append_entry(path, entry | {"name": "other", "protocol": 0})
    monkeypatch.setattr(leaderboard_tables, "file_digest", None)  # to read is not to compare with the oracles
    (found,) = leaderboard_file.read_entries(path)
    assert found["seeds"] == 2


@table("line", ["{", "[]", '{"name": "x"}', '{"name": "x", "track": "y", "score": 3}'])
def test_a_damaged_board_is_reported(tmp_path, entry, line):
    path = tmp_path / "board.jsonl"
    path.write_text(json.dumps(entry) + "\n" + line + "\n")
    with pytest.raises(ValueError, match=r"board must hold an entry a line, but .*board.jsonl:2 is not one"):
        leaderboard_file.read_entries(path)
    path.write_bytes(json.dumps({**entry, "reference": {}}).encode() + b"\n\xff\n")
    with pytest.raises(ValueError, match=r"board must hold an entry a line, but .*board.jsonl:1 is not one"):
        leaderboard_file.read_entries(path)


def test_an_entry_begins_a_line(tmp_path, entry):
    path = tmp_path / "board.jsonl"
    path.write_text(json.dumps(entry))  # as some editors leave it
    leaderboard_file.append_entry(path, entry | {"name": "other"})
    leaderboard_file.append_entry(path, entry | {"name": "third"})
    assert [found["name"] for found in leaderboard_file.read_entries(path)] == ["noise", "other", "third"]
    assert path.read_text().count("\n") == 3


def test_names_of_the_board_that_ships_are_taken(command, tmp_path):
    words = ("evaluate", "--protocol", "Short-v0", "--policies", "uniform", "--submit")
    status, _, messages = command(*words, "efe")
    assert status == 2
    assert "submit must be a name of your own, but is efe, which the board that ships has; name another" in messages
    assert list(tmp_path.iterdir()) == []
    assert leaderboard_file.check_new_entry(leaderboard_file.SHIPPED_LEADERBOARD, "efe") == {SHORT}


def test_a_name_that_is_submitted_twice_is_reported(tmp_path, command, entry, monkeypatch):
    monkeypatch.setattr(protocol, "measure_policy", lambda *arguments: entry)
    words = ("evaluate", "--protocol", "Short-v0", "--policies", "uniform", "--submit", "noise", "--board", "b.jsonl")
    first, second = command(*words)[1], command(*words)[1]
    message = f"The board had noise on {SHORT} before; the report shows the latest entry of a name."
    assert message not in " ".join(first.split())
    assert message in " ".join(second.split())


def test_a_board_is_looked_at_before_the_measurement(command, monkeypatch, tmp_path, entry):
    def measure(*arguments):
        raise AssertionError("it is refused before")

    monkeypatch.setattr(protocol, "measure_policy", measure)
    words = ("evaluate", "--protocol", "Short-v0", "--policies", "prbs", "--submit", "mine", "--board")
    (tmp_path / "broken.jsonl").write_text(json.dumps(entry) + "\n" + json.dumps(entry)[:200])
    before = (tmp_path / "broken.jsonl").read_bytes()
    for path, message in {
        "broken.jsonl": "board must hold an entry a line, but broken.jsonl:2 is not one",
        "broken.jsonl/mine.jsonl": "folder of board must be a folder, but broken.jsonl is a file; name another folder",
        str(tmp_path): "board must be a file, but is the folder",
    }.items():
        status, _, messages = command(*words, path)
        assert status == 2
        assert message in messages
    assert (tmp_path / "broken.jsonl").read_bytes() == before


def _append(path, entry, name):
    for k in range(50):
        leaderboard_file.append_entry(path, entry | {"name": f"{name}-{k}"})


def test_two_programs_may_add_at_once(tmp_path, entry):
    path = tmp_path / "board.jsonl"
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=_append, args=(path, entry, name)) for name in "ab"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert len(leaderboard_file.read_entries(path)) == 100


def test_the_board_that_ships_is_of_what_ships():
    entries = leaderboard_file.read_entries(leaderboard_file.SHIPPED_LEADERBOARD)
    shown = {entry["name"] for entry in entries if entry["track"] == SHORT}
    assert {"ppo/short", "shield", "efe", "prbs", "uniform", "multisine", "velocity-sign"} <= shown
    for entry in entries:
        # Names without a training have not learned.
        assert (entry["budget"] == "none") == (entry["name"] in POLICIES), entry["name"]
        for policy, found in entry["policies"].items():
            if policy in protocol.trained_policies():
                assert found == protocol.policy_fingerprint(policy), policy


def test_a_score_against_another_oracle_is_marked(entry, monkeypatch):
    ((row,),) = leaderboard_tables.leaderboard_rows([entry]).values()
    assert "*" not in row[1]
    monkeypatch.setattr(leaderboard_tables, "stored_oracle_digests", set)
    ((row,),) = leaderboard_tables.leaderboard_rows([entry]).values()
    assert row[1].endswith("] *")
