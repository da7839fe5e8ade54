"""Files: written so that none is ever half-written, and looked at before any is read."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from estimator.support.argument_checks import short_repr

#: Errors of a disk, or a share of one, that has no room.
_DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

#: Errors of a place that is protected.
_PERMISSION_ERRORS = (errno.EACCES, errno.EPERM, errno.EROFS)

#: Mode of a file that was not there: not the 0600 of a temporary one.
_NEW_FILE_MODE = 0o644


@contextmanager
def explain_write_errors(path: Path) -> Iterator[None]:
    """Let what the system says while a file is written name that file, and what to do."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        first = "make room, or " if error.errno in _DISK_FULL_ERRORS else ""
        first = "allow to write there, or " if error.errno in _PERMISSION_ERRORS else first
        raise OSError(error.errno, f"{error.strerror}; {first}name another place", str(path)) from error


def _resolve_target(path: Path) -> tuple[Path, int]:
    """The file that is to be written, which a link only names, and the mode that it has or is to have.

    Raises:
        OSError: for what is there and is no file, or is read-only, also to root, who may write it all the same.
    """
    target = Path(os.path.realpath(path))
    try:
        found = target.stat()
    except FileNotFoundError:
        return target, _NEW_FILE_MODE
    if stat.S_ISDIR(found.st_mode):
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "It is a device or a pipe, and no file")
    if not found.st_mode & stat.S_IWUSR or not os.access(target, os.W_OK):
        raise OSError(errno.EACCES, "It is read-only")
    return target, stat.S_IMODE(found.st_mode)


def check_writable(path: Path) -> None:
    """Refuse a place where no file can be written, or a folder in which none can, before the work for it begins.

    Nothing is left there; what has to be made on the way is not made yet.

    Raises:
        OSError: as `write_atomically`.
    """
    with explain_write_errors(path):
        within = path if path.is_dir() else _resolve_target(path)[0].parent
        while not within.exists():
            within = within.parent
        with tempfile.TemporaryFile(dir=within):
            pass


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name beside its place, then rename it.

    A link stays, and what it names is written. A file that was there keeps its mode.

    Raises:
        OSError: where it cannot be written, such as a device, a pipe, a folder or a read-only file; what was there
            before still is.
    """
    data = content.encode() if isinstance(content, str) else content
    with explain_write_errors(path):
        target, mode = _resolve_target(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name[:100]}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            os.chmod(temporary, mode)
            os.replace(temporary, target)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise


def append_atomically(path: Path, text: str) -> None:
    """Add text to a file, all of it or nothing: what a full disk cut off is taken back.

    Of two programs that add at once, each adds its text in one piece.

    Raises:
        OSError: where it cannot be written, such as a device, a pipe, a folder or a read-only file.
    """
    data, written = text.encode(), 0
    with explain_write_errors(path):
        place = os.open(_resolve_target(path)[0], os.O_WRONLY | os.O_APPEND | os.O_CREAT, _NEW_FILE_MODE)
        try:
            before = os.fstat(place).st_size
            while written < len(data):
                written += os.write(place, data[written:])
        except BaseException:
            if written and os.fstat(place).st_size == before + written:  # nobody else has added to it
                os.ftruncate(place, before)
            raise
        finally:
            os.close(place)


def lock_folder(name: str, folder: Path) -> int | None:
    """Hold a folder against every other that asks for it so, until the descriptor that is returned is closed.

    The kernel lets go of it where the process is killed. None where the system or the disk has no such locks.

    Args:
        name: of the argument that the folder is, in the message.
        folder: must be there.

    Raises:
        ValueError: where it is held already.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    is_unlocked = True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Whoever had it before may have removed it.
        is_unlocked = os.path.samestat(os.fstat(descriptor), os.stat(folder))
    except (BlockingIOError, FileNotFoundError):
        is_unlocked = False
    except OSError:  # such as of a network's disk
        os.close(descriptor)
        return None
    if not is_unlocked:
        os.close(descriptor)
        raise ValueError(
            f"{name} must be a folder that nobody else writes to, but another process does to {folder}; wait for its "
            "end, or name another"
        )
    return descriptor


@contextmanager
def locked_folder(name: str, folder: Path) -> Iterator[None]:
    """`lock_folder` a folder meanwhile."""
    descriptor = lock_folder(name, folder)
    try:
        yield
    finally:
        if descriptor is not None:
            with suppress(OSError):
                os.close(descriptor)


def to_path(name: str, value: object) -> Path:
    """The path that an argument is, of a file or folder to be written.

    Raises:
        ValueError: for what is not a path, or a name that no file can have.
    """
    try:
        path = Path(value)  # type: ignore[arg-type]
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return path
    except (TypeError, ValueError, OSError) as error:
        raise ValueError(f"{name} must be the name of a file, but is {short_repr(value)}: {error!s:.80}") from error
    return path


def check_readable_file(path: str | Path, requirement: str, max_bytes: int, remedy_if_absent: str = "") -> Path:
    """A file that can be read: no folder, nor a pipe or device, which might never end, and none that is too large.

    Args:
        path: of the file.
        requirement: begins the message: what the argument must be.
        max_bytes: bytes.
        remedy_if_absent: ends the message where there is no such file: how to come by one.

    Raises:
        ValueError: for anything else, or a name that no file can have.
        FileNotFoundError: if there is no such file.
    """
    try:
        file = Path(path)
    except TypeError as error:
        raise ValueError(f"{requirement}, but {short_repr(path)} is not a path; name one") from error
    try:
        found = file.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(
            f"{requirement}, but there is no {file}{remedy_if_absent and '; '}{remedy_if_absent}"
        ) from None
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{requirement}, but {str(file)!r:.80} cannot be opened: {error!r:.80}; name another"
        ) from error
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{requirement}, but {file} is not one; name the file itself")
    if found.st_size > max_bytes:
        raise ValueError(f"{requirement}, but {file} has {found.st_size} bytes, more than {max_bytes}; name another")
    return file
