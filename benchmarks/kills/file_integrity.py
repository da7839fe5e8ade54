"""Finds damaged or half-written files in a folder, by reading each in its format."""

import csv
import json
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np


def half_written(folder: Path) -> list[tuple[str, str]]:
    """Files that cannot be read, and why; without temporary files, whose path has a part that begins with a dot."""
    bad = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        # Optuna's lock is a link that may lead nowhere; Optuna removes it after half a minute.
        if path.is_symlink() or not path.is_file() or any(part.startswith(".") for part in name.parts):
            continue
        try:
            READERS[path.suffix](path)
        except Exception as error:  # a reader may raise anything at half a file
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
        raise ValueError("the page does not end with </html>")


def _arrays(path: Path) -> None:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        for name in arrays.files:
            arrays[name]


#: Reader of each suffix. A file with another suffix counts as a fault.
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
