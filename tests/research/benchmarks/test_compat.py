"""Other libraries on the environments: the rows of the locked ones, and a missing library."""

import sys

import gymnasium as gym
import pytest

from benchmarks.compat.__main__ import LIBRARIES, cell, main
from benchmarks.compat.library_rows import CELLS

INSTALLED = ("Gymnasium", "StableBaselines3")


@pytest.mark.parametrize("name", INSTALLED)
@pytest.mark.parametrize("part", CELLS)
@pytest.mark.filterwarnings("ignore")
def test_a_library_that_is_installed_takes_the_environments(name, part):
    assert cell(getattr(LIBRARIES[name](), part)) == ("-" if (name, part) == ("Gymnasium", "train") else "yes")


def test_a_keyword_that_is_none_is_refused_in_the_words_that_torchrl_looks_for():
    for make in (gym.make, gym.make_vec):
        with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'") as caught:
            make("duffing_env:duffing_env/Short-v0", frameskip=1)
        assert isinstance(caught.value, ValueError)


def test_failures_are_printed_and_counted(monkeypatch, capsys):
    def fails():
        raise LookupError("no such thing\nand more")

    assert cell(fails) == "LookupError: no such thing"
    monkeypatch.setattr(sys, "argv", ["compat", "Nobody"])
    assert main() == 4
    assert "| Nobody |" in capsys.readouterr().out
