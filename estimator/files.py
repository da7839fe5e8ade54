"""Files: written so that none is ever half-written, and looked at before any is read."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name beside its place, then rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode() if isinstance(content, str) else content
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def whole_file(path: str | Path, must: str, largest: int, missing: str = "") -> Path:
    """A file that can be read: no folder, nor a pipe or device, which might never end, and none that is too large.

    Args:
        path: of the file.
        must: begins the message: what the argument must be.
        largest: bytes.
        missing: ends the message where there is no such file: how to come by one.

    Raises:
        ValueError: for anything else, or a name that no file can have.
        FileNotFoundError: if there is no such file.
    """
    place = Path(path)
    try:
        found = place.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{must}, but there is no {place}{missing and '; '}{missing}") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"{must}, but {str(place)!r:.80} cannot be opened: {error!r:.80}; name another") from error
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{must}, but {place} is none; name the file itself")
    if found.st_size > largest:
        raise ValueError(f"{must}, but {place} has {found.st_size} bytes, more than {largest}; name another")
    return place
