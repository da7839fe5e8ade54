"""Writing files: in one piece, or not at all."""

import os
import stat
from pathlib import Path

import pytest

from estimator.files import write_atomically


def names(folder):
    return sorted(path.name for path in folder.iterdir())


class FullDisk:
    """A file whose first write stops half way."""

    def __init__(self, handle, mode):
        self.handle = handle

    def __enter__(self):
        return self

    def __exit__(self, *reason):
        os.close(self.handle)

    def write(self, data):
        os.write(self.handle, data[:1])
        raise OSError("no space left on device")


@pytest.mark.parametrize("content", [b"\x00\xffbytes\r\n", "θ and\nη\n", b""])
def test_content_arrives_byte_by_byte_and_alone(tmp_path, content):
    path = tmp_path / "made" / "on the way" / "file"
    write_atomically(path, content)
    assert path.read_bytes() == (content.encode("utf-8") if isinstance(content, str) else content)
    assert names(path.parent) == ["file"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o644  # not the 0600 of a temporary file


def test_old_content_stays_until_the_new_is_complete(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("a longer old content")
    really_replace = os.replace
    seen = []

    def replace(source, target):
        seen.append((Path(target).read_text(), Path(source).read_text()))
        really_replace(source, target)

    monkeypatch.setattr(os, "replace", replace)
    write_atomically(path, "new")
    assert seen == [("a longer old content", "new")]
    assert path.read_text() == "new"
    assert names(tmp_path) == ["file"]


def test_a_failing_write_keeps_the_old_content_and_leaves_nothing_behind(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("old")
    monkeypatch.setattr(os, "fdopen", FullDisk)
    with pytest.raises(OSError, match="no space left"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert names(tmp_path) == ["file"]


def test_an_interrupt_before_the_renaming_leaves_nothing_behind(tmp_path, monkeypatch):
    def interrupt(source, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "file", "new")
    assert names(tmp_path) == []
