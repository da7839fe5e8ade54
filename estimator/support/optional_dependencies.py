"""Packages that only some tasks need, each brought by an extra: ``pip install 'duffing-env[train]'``."""

from __future__ import annotations

from importlib.util import find_spec

#: Name that a package is imported by, to the extra that brings it.
EXTRA_OF_PACKAGE = {
    "h5py": "datasets",
    "highspy": "oracle",
    "matplotlib": "report",
    "minari": "datasets",
    "onnx": "onnx",
    "optuna": "tune",
    "pygame": "human",
    "pyvisa": "instrument",
    "ray": "ray",
    "sb3_contrib": "train",
    "stable_baselines3": "train",
    "tensorboard": "train",
    "torch": "train",
}


def is_not_installed(package: str) -> bool:
    """Whether a package is not installed."""
    return find_spec(package) is None


def require_packages(*packages: str) -> None:
    """Refuse to go on without packages that an extra brings, before the work begins.

    Raises:
        ModuleNotFoundError: of the first that is missing, naming its extra.
    """
    for package in packages:
        if is_not_installed(package):
            raise ModuleNotFoundError(install_hint(package), name=package)


def install_hint(package: str) -> str:
    """One line that says which extra brings a package."""
    return f"{package} is not installed; get it with: pip install 'duffing-env[{EXTRA_OF_PACKAGE[package]}]'"
