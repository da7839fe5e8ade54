"""``duffing-env export``: write an excitation as CSV, or the network of a policy as ONNX."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class ExportCommand:
    """Write an excitation as CSV, for a real signal generator, or the network of a policy as ONNX.

    A signal's file has the columns "t [s]" and "u [V]"; each input is held for a sample of 1.6384 ms (610.35 Hz).

    $ duffing-env export prbs-4 --samples 1024 --output prbs.csv
    $ duffing-env export multisine --max-rms 0.0222 --output multisine.csv
    $ duffing-env export ppo/amplitude --output network.onnx
    """

    name: Annotated[str, tyro.conf.Positional]
    """Name of the excitation, or name or folder of a trained policy."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")]
    """Output file; for a policy it ends in .onnx."""
    samples: int = 1024
    """Length of the excitation [samples]."""
    max_input: float = 0.15
    """Amplitude limit [V]."""
    max_rms: float | None = None
    """Largest root mean square [V]."""
    seed: int = 0
    """Seed of the excitation."""
    force: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Write the file, and print a summary."""
        import numpy as np

        from agents.console_output import print_in_80_columns
        from agents.output_paths import check_not_overwritten
        from agents.policies.signal_export import export_signal
        from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP

        check_not_overwritten("-o/--output", self.output, self.force)
        if self.output.suffix == ".onnx":
            self._export_network()
            return
        limits = {name: value for name, value in vars(self).items() if name not in ("name", "output", "force")}
        volts = export_signal(self.name, self.output, **limits)
        peak, rms = np.abs(volts).max(), np.sqrt(np.mean(volts**2))
        seconds = volts.size * SILVERBOX_SAMPLING_STEP
        print_in_80_columns(f"{self.output}: {volts.size} samples, {seconds:.4g} s, peak {peak:.4g} V, RMS {rms:.4g} V")

    def _export_network(self) -> None:
        from agents.console_output import print_in_80_columns
        from agents.policies import TRAINED, trained_policies
        from agents.policies.networks.onnx_export import export_network
        from agents.policies.networks.trained_policy import load_policy

        policy = load_policy(TRAINED / self.name if self.name in trained_policies() else self.name)
        export_network(policy, self.output)
        sizes = " to ".join(str(size) for size in (policy.layers[0][0].shape[1], *(len(b) for _, b in policy.layers)))
        print_in_80_columns(
            f"{self.output}: {len(policy.layers)} layers, {sizes} numbers; the shield is not in the file"
        )
