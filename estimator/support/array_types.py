"""Parameters of a plant by name, and those of the Silverbox circuit.

Displacement and input of the circuit are both in volts, as in its record.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
