"""File input and output: atomic writes, locked folders, and checks before reading and writing."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from estimator.support.argument_checks import short_repr

#: Errors of a full disk or quota.
_DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

#: Errors of missing permission.
_PERMISSION_ERRORS = (errno.EACCES, errno.EPERM, errno.EROFS)

#: Mode of a new file, in place of the mode 0600 of a temporary one.
_NEW_FILE_MODE = 0o644


@contextmanager
def explain_write_errors(path: Path) -> Iterator[None]:
    """Add the file and the remedy to the system's errors while a file is written."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        first = "make room, or " if error.errno in _DISK_FULL_ERRORS else ""
        first = "allow to write there, or " if error.errno in _PERMISSION_ERRORS else first
        raise OSError(error.errno, f"{error.strerror}; {first}name another place", str(path)) from error


def _resolve_target(path: Path) -> tuple[Path, int]:
    """The file to write, with links resolved, and its mode.

    Raises:
        OSError: for a path that is no file, or for a read-only file, also as root, who could write it.
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
    """Refuse a path where no file can be written, or a folder in which none can, before the work begins.

    The check leaves nothing behind, and creates no folders.

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
    """Write a file under a temporary name in the same folder, then rename it.

    A link stays, and its target is written. An existing file keeps its mode.

    Raises:
        OSError: for a path that cannot be written, such as a device, a pipe, a folder or a read-only file; an existing
            file stays as it was.
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
    """Append text to a file, all of it or nothing: a part that a full disk cut off is removed.

    Two programs that append at once each append their text in one piece.

    Raises:
        OSError: for a path that cannot be written, such as a device, a pipe, a folder or a read-only file.
    """
    data, written = text.encode(), 0
    with explain_write_errors(path):
        place = os.open(_resolve_target(path)[0], os.O_WRONLY | os.O_APPEND | os.O_CREAT, _NEW_FILE_MODE)
        try:
            before = os.fstat(place).st_size
            while written < len(data):
                written += os.write(place, data[written:])
        except BaseException:
            if written and os.fstat(place).st_size == before + written:  # no other program has appended
                os.ftruncate(place, before)
            raise
        finally:
            os.close(place)


def lock_folder(name: str, folder: Path) -> int | None:
    """Lock a folder against other processes that lock it, until the returned descriptor is closed.

    The kernel unlocks it when the process ends. None where the system or the disk has no such locks.

    Args:
        name: name of the argument, for messages.
        folder: the folder, which must exist.

    Raises:
        ValueError: where another process has locked it.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    is_unlocked = True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # The process that had locked it may have removed it.
        is_unlocked = os.path.samestat(os.fstat(descriptor), os.stat(folder))
    except (BlockingIOError, FileNotFoundError):
        is_unlocked = False
    except OSError:  # such as on a network disk
        os.close(descriptor)
        return None
    if not is_unlocked:
        os.close(descriptor)
        raise ValueError(
            f"{name} must be a folder that no other process writes to, but one writes to {folder}; wait for its end, "
            f"or name another"
        )
    return descriptor


@contextmanager
def locked_folder(name: str, folder: Path) -> Iterator[None]:
    """Lock a folder within the context (`lock_folder`)."""
    descriptor = lock_folder(name, folder)
    try:
        yield
    finally:
        if descriptor is not None:
            with suppress(OSError):
                os.close(descriptor)


def to_path(name: str, value: object) -> Path:
    """The path of a file or folder to write.

    Args:
        name: name of the argument, for messages.
        value: its value.

    Raises:
        ValueError: for a value that is no path, or a name that no file can have.
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
    """The path of a readable file: no folder, no pipe or device, which might never end, and not too large.

    Args:
        path: the file.
        requirement: begin of the message, with the requirement on the argument.
        max_bytes: largest size [bytes].
        remedy_if_absent: end of the message for a missing file, with a way to get one.

    Raises:
        ValueError: for anything else, or a name that no file can have.
        FileNotFoundError: for a file that does not exist.
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
