"""Finds damaged or half-written files in a folder, by reading each in its format."""

import csv
import json
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np


def half_written(folder: Path) -> list[tuple[str, str]]:
    """Files that cannot be read, and why. Temporary ones begin with a dot, or lie in a folder that does."""
    bad = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        # Optuna's lock is a link, and is broken after half a minute.
        if path.is_symlink() or not path.is_file() or any(part.startswith(".") for part in name.parts):
            continue
        try:
            READERS[path.suffix](path)
        except Exception as error:  # whatever a reader makes of half a file
            bad.append((str(name), f"{type(error).__name__}: {error}"))
    return bad


def _lines(path: Path) -> None:
    for line in path.read_text().splitlines():
        json.loads(line)


def _rows(path: Path) -> None:
    text = path.read_text()
    widths = {len(row) for row in csv.reader(text.splitlines())}
    if text and (len(widths) > 1 or not text.endswith("\n")):
        raise ValueError(f"rows of {sorted(widths)} columns, ending in {text[-10:]!r}")


def _tensors(path: Path) -> None:
    from safetensors.numpy import load_file

    load_file(path)


def _picture(path: Path) -> None:
    import matplotlib.image

    matplotlib.image.imread(path)


def _page(path: Path) -> None:
    if not path.read_text().endswith("</html>\n"):
        raise ValueError("it does not end as a page does")


def _arrays(path: Path) -> None:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        for name in arrays.files:
            arrays[name]


#: How each kind of file is read; another kind is a fault of this program, and says so.
READERS: dict[str, Callable[[Path], object]] = {
    ".json": lambda path: json.loads(path.read_text()),
    ".jsonl": _lines,
    ".log": _lines,
    ".csv": _rows,
    ".toml": lambda path: tomllib.loads(path.read_text()),
    ".safetensors": _tensors,
    ".npz": _arrays,
    ".png": _picture,
    ".count": lambda path: path.stat().st_size,
    ".html": _page,
}
