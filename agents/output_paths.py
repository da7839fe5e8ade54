"""Checks of output files and folders before the work begins: writable, not an input, not an older file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from estimator.support.file_io import check_writable


def check_distinct_files(outputs: Mapping[str, Path | None], inputs: Iterable[str | Path]) -> None:
    """Refuse an output that is also an input, and two outputs in one file.

    Args:
        outputs: option to its file, or None.
        inputs: files that the command reads; names of shipped rigs may be among them.

    Raises:
        ValueError: naming the option.
    """
    reasons = {Path(path).resolve(): "it is read" for path in inputs}
    for name, path in outputs.items():
        if path is not None:
            if path.resolve() in reasons:
                raise ValueError(
                    f"{name} must be a separate file, but is {path}, and {reasons[path.resolve()]}; name another"
                )
            reasons[path.resolve()] = f"so is {name}"


def check_not_overwritten(name: str, path: Path | None, force: bool) -> None:
    """Refuse to replace an existing file, which may be a measurement, unless ``force`` is set.

    Raises:
        ValueError: naming the option.
    """
    if path is not None and not force and path.exists():
        raise ValueError(f"{name} must be a new file, but there is {path}; name another, or add --force")


def check_output_file(name: str, path: Path | None) -> None:
    """Refuse an output file that is a folder or cannot be written, before the work begins.

    Raises:
        IsADirectoryError: naming the argument.
        OSError: naming the path, where it cannot be written.
    """
    if path is None:
        return
    if path.is_dir():
        raise IsADirectoryError(f"{name} must be a file, but is the folder {path}; name a file in it")
    check_writable(path)


def check_output_folder(name: str, path: Path) -> None:
    """Refuse an output folder that is a file or cannot be written to, before the work begins.

    Raises:
        NotADirectoryError: naming the argument.
        OSError: naming the path, where it cannot be written to.
    """
    for place in (path, *path.parents):
        if place.exists() and not place.is_dir():
            raise NotADirectoryError(f"{name} must be a folder, but {place} is a file; name another folder")
    check_writable(path)
