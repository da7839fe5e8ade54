"""Kills: what counts as half a file, and a kill of one command."""

import json

import numpy as np
import pytest
from safetensors.numpy import save_file

from benchmarks.kills.__main__ import Config, main
from benchmarks.kills.file_integrity import READERS, half_written


def test_half_of_any_file_is_noticed(tmp_path):
    (tmp_path / "a.json").write_text('{"steps": 1024}')
    (tmp_path / "a.jsonl").write_text('{"name": 1}\n{"name": 2}\n')
    (tmp_path / "a.log").write_text('{"op_code": 0}\n')
    (tmp_path / "a.csv").write_text("u,y\n1,2\n")
    (tmp_path / "a.toml").write_text('[ppo]\nsteps = "many"\n')
    save_file({"weight": np.ones(9)}, tmp_path / "a.safetensors")
    np.savez(tmp_path / "a.npz", weight=np.ones(9))
    pyplot = pytest.importorskip("matplotlib.image")
    pyplot.imsave(tmp_path / "a.png", np.zeros((4, 4)))
    (tmp_path / "a.html").write_text("<html>\n</html>\n")
    kinds = {path.suffix for path in tmp_path.iterdir()}
    assert kinds == READERS.keys() - {".count"}
    assert half_written(tmp_path) == []
    for path in sorted(tmp_path.iterdir()):
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2 + 1])
        ((name, _),) = half_written(tmp_path)
        assert name == path.name
        path.rename(tmp_path / f".{path.name}.x7")  # a temporary name
        assert half_written(tmp_path) == []


def test_unknown_commands_are_refused():
    with pytest.raises(ValueError, match=r"commands must be of \['train', .*nothing"):
        main(Config(commands=("nothing",)))


@pytest.mark.slow
def test_two_kills_of_a_run(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(Config(kills=2, commands=("run", "train --ray"), json=tmp_path / "found.json"))
    assert ended.value.code == 0
    found = json.loads((tmp_path / "found.json").read_text())["run"]
    assert (found["kills"], found["resumed"], found["half-written"], found["faults"]) == (2, 2, 0, [])
    assert found["lost"] <= 1
