"""Writing files: in one piece, or not at all."""

import os
import stat
from pathlib import Path

import pytest
from tables import table

from estimator.support.file_io import append_atomically, check_writable, write_atomically


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


@table("content", [b"\x00\xffbytes\r\n", "θ and\nη\n", b""])
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


@table("write", [write_atomically, append_atomically])
def test_a_directory_or_device_is_refused_and_stays(tmp_path, write):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "linked").symlink_to("pipe")
    (tmp_path / "round").symlink_to("round")
    before = {name: (tmp_path / name).lstat() for name in names(tmp_path)}
    for name in before:
        with pytest.raises(OSError, match=rf"name another place: '.*/{name}'"):
            write(tmp_path / name, "new")
    with pytest.raises(OSError, match="It is a device or a pipe, and no file; name another place: '/dev/null'"):
        write(Path("/dev/null"), "new")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    assert {name: (tmp_path / name).lstat() for name in names(tmp_path)} == before


@table("write", [write_atomically, append_atomically])
def test_a_read_only_file_is_refused_also_to_root(tmp_path, write):
    path = tmp_path / "file"
    path.write_text("old")
    path.chmod(0o444)
    with pytest.raises(OSError, match=r"It is read-only; allow to write there, or name another place: '.*/file'"):
        write(path, "new")
    assert path.read_text() == "old"
    assert names(tmp_path) == ["file"]


@table("write", [write_atomically, append_atomically])
def test_a_link_is_followed_and_a_mode_is_kept(tmp_path, write):
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "file", tmp_path / "link"
    link.symlink_to(Path("there") / "file")
    write(link, "first")
    assert stat.S_IMODE(target.stat().st_mode) & 0o700 == 0o600
    target.chmod(0o640)
    write(link, "second")
    assert link.is_symlink()
    assert target.read_text() == ("second" if write is write_atomically else "firstsecond")
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    assert names(tmp_path / "there") == ["file"]


def test_a_place_that_can_be_written_is_left_as_it_was(tmp_path):
    (tmp_path / "file").write_text("old")
    for place in (tmp_path, tmp_path / "file", tmp_path / "new", tmp_path / "on the way" / "to" / "new"):
        check_writable(place)
    assert names(tmp_path) == ["file"]
    assert (tmp_path / "file").read_text() == "old"


def test_a_place_that_cannot_be_written_is_refused_before_it_is(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    (tmp_path / "file").chmod(0o444)
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "file", tmp_path / "pipe", tmp_path / "pipe" / "new"):
        with pytest.raises(OSError, match="name another place"):
            check_writable(place)

    def refuse(dir):
        raise PermissionError(13, "Permission denied", f"{dir}/a temporary name")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    for place in (tmp_path, tmp_path / "new", tmp_path / "on the way" / "new"):
        with pytest.raises(PermissionError) as raised:
            check_writable(place)
        message = "[Errno 13] Permission denied; allow to write there, or name another place"
        assert str(raised.value) == f"{message}: '{place}'"
