"""The protocol with the peers' process, with our own Python in the place of theirs."""

import sys
from pathlib import Path

import pytest

from benchmarks import peer_process
from benchmarks.peer_process import NotAvailable, Peers
from benchmarks.timed_rounds import measure


@pytest.fixture
def peers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Peers:
    monkeypatch.setattr(peer_process, "ensure_environment", lambda: Path(sys.executable))
    return Peers(tmp_path / "samples.npz")


def test_it_answers_in_turn(peers: Peers) -> None:
    with peers:
        assert peers.versions()["numpy"].count(".") == 2
        assert peers.versions()["envpool"] == "not installed"


def test_a_missing_peer_is_a_row_that_says_so(peers: Peers) -> None:
    with peers:
        result = measure([peers.row("envpool 8", "EnvPool", "env-steps/s")], 2)["EnvPool"]
    assert result.values == ()
    assert "No module named 'envpool'" in result.reason


def test_a_process_that_dies_is_reported_and_started_anew(peers: Peers) -> None:
    with peers:
        peers.versions()
        assert peers._process is not None
        peers._process.kill()
        with pytest.raises(NotAvailable, match="ended with status -9"):
            peers.ask("versions", 0)
        assert "numpy" in peers.versions()


def test_without_peers_every_row_says_so(tmp_path: Path) -> None:
    with Peers(tmp_path / "samples.npz", wanted=False) as peers:
        assert peers.versions() == {}
        with pytest.raises(NotAvailable, match="--no-peers"):
            peers.ask("padasip", 1)


def test_an_environment_that_cannot_be_made_is_a_reason(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fail() -> Path:
        raise NotAvailable("no network")

    monkeypatch.setattr(peer_process, "ensure_environment", fail)
    with Peers(tmp_path / "samples.npz") as peers, pytest.raises(NotAvailable, match="no network"):
        peers.ask("padasip", 1)


def test_the_lock_pins_every_line() -> None:
    lines = [line for line in peer_process.LOCK.read_text().splitlines() if line and not line.startswith("#")]
    assert all("==" in line for line in lines)
    names = {line.split("==")[0].lower() for line in lines}
    assert names >= {"envpool", "gymnax", "six", "filterpy", "dynamax", "padasip", "jax"}
