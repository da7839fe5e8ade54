"""Optional dependencies: packages that only some tasks need, with the extra of each: ``duffing-env[train]``."""

from __future__ import annotations

from importlib.util import find_spec

#: Import name of a package to the extra that installs it.
EXTRA_OF_PACKAGE = {
    "h5py": "datasets",
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
    """Refuse to start without packages of an extra.

    Raises:
        ModuleNotFoundError: naming the first missing package and its extra.
    """
    for package in packages:
        if is_not_installed(package):
            raise ModuleNotFoundError(install_hint(package), name=package)


def install_hint(package: str) -> str:
    """One line with the command that installs a package."""
    return f"{package} is not installed; get it with: pip install 'duffing-env[{EXTRA_OF_PACKAGE[package]}]'"
