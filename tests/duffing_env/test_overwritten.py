"""The message about a package of ours that another distribution has overwritten."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from duffing_env.package_overwrite import overwrite_message

ROOT = Path(__file__).parents[2]


@pytest.fixture
def site(tmp_path):
    """A folder of installed packages: links to ours."""
    for package in ("agents", "duffing_env", "estimator"):
        (tmp_path / package).mkdir()
        for part in (ROOT / package).iterdir():
            (tmp_path / package / part.name).symlink_to(part)
    return tmp_path


def write_over(site, package, text="from .run import Agent  # theirs\n"):
    (site / package / "__init__.py").unlink()
    if text is not None:
        (site / package / "__init__.py").write_text(text)


def run(site, code, *before):
    path = os.pathsep.join(map(str, (*before, site)))
    return subprocess.run(
        [sys.executable, "-P", "-c", code], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )


def test_packages_of_ours_are_ours(site, monkeypatch):
    monkeypatch.syspath_prepend(site)
    assert [overwrite_message(package, site) for package in ("agents", "estimator")] == [None, None]


@pytest.mark.parametrize("text", ["from .run import Agent  # theirs\n", None])
def test_a_package_that_is_overwritten_is_reported(site, monkeypatch, text):
    write_over(site, "agents", text)
    monkeypatch.setattr(sys, "path", [str(site)])
    message = overwrite_message("agents", site)
    assert f"{site / 'agents'} is no longer duffing-env's" in message
    assert "pip install --force-reinstall --no-deps duffing-env" in message


def test_agents_of_another_distribution_are_a_warning(site):
    write_over(site, "agents")
    done = run(site, "import duffing_env; print(len(duffing_env.TRACKS) > 5)")
    assert done.stdout == "True\n"
    assert "UserWarning: " in done.stderr
    assert "has written a package 'agents' over it" in done.stderr


def test_an_estimator_of_another_distribution_is_an_error(site):
    write_over(site, "estimator")
    done = run(site, "import duffing_env")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(f"ImportError: {site / 'estimator'} is no longer duffing-env's")


def test_a_folder_of_the_user_s_own_is_no_fault(site, tmp_path_factory):
    own = tmp_path_factory.mktemp("project")
    (own / "agents").mkdir()
    (own / "agents" / "__init__.py").write_text("mine = 1\n")
    done = run(site, "import duffing_env, agents; print(agents.mine)", own)
    assert (done.stdout, done.stderr) == ("1\n", "")
