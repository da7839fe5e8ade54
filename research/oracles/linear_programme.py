"""Linear programme of a step of `research.oracles.slp_refinement`: the best small change of an input within its limits.

HiGHS solves it once for every step. The numbers change from one step to the next and the shape does not, so each
solution starts from the last basis, and takes far fewer pivots than a cold start.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from scipy import sparse

from agents.planning.projected_gradient import DesignLimits
from estimator.support.array_types import FloatArray

_INSTALL_HINT = "highspy is not installed; get it with: pip install 'highspy>=1.10,<1.16'"


def import_highspy() -> Any:
    """The package of HiGHS, which ``make`` installs in a checkout.

    Raises:
        ModuleNotFoundError: without it, with the command that installs it.
    """
    try:
        return importlib.import_module("highspy")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(_INSTALL_HINT, name="highspy") from error


class LinearProgramme:
    """The linear programmes of one refinement.

    Args:
        samples: number of samples T.
        n: number of states.
        output_state: index of the state that the first sensor measures, or n where it measures another output.
        limits: limits of the programmes; ``soft_limit`` is the limit of the signal.

    Raises:
        ModuleNotFoundError: as `import_highspy`.
    """

    def __init__(self, samples: int, n: int, output_state: int, limits: DesignLimits) -> None:
        self._highspy = highspy = import_highspy()
        self._solver = highspy.Highs()
        # Presolving costs more than it saves where the last basis is nearly optimal.
        for option, value in (("presolve", "off"), ("solver", "simplex"), ("threads", 1), ("output_flag", False)):
            self._solver.setOptionValue(option, value)
        self._basis: Any = None
        self._n, self._output_state, self._limits = n, output_state, limits
        self._n_quantities = max(n, output_state + 1)  # rows of a sample's result: the states and the output
        t, width = np.arange(samples), self._n_quantities
        rows, columns = [], []
        for i in range(width):
            rows.append(t * width + i)
            columns.append(samples + t * width + i)
            for j in range(n):
                rows.append(t[1:] * width + i)
                columns.append(samples + t[:-1] * width + j)
            for lag in range(3):
                rows.append(t[lag:] * width + i)
                columns.append(t[: samples - lag])
        rows.append(np.full(samples, samples * width))
        columns.append(t)
        self._index_arrays = np.concatenate(rows), np.concatenate(columns)

    def best_change(
        self, u: FloatArray, gradient: FloatArray, output_signal: FloatArray, jacobians: FloatArray, radius: float
    ) -> tuple[FloatArray, FloatArray] | None:
        """The best change (T,) of the inputs to first order, and the change of the states (T, n) before every sample.

        Args:
            u: (T,) inputs.
            gradient: (T,) gradient of the criterion.
            output_signal: (T,) output of the first sensor.
            jacobians: (T, n + 1, n + 3) as `research.oracles.slp_refinement.Linearisation`.
            radius: largest change of an input.

        Returns:
            None where no change of at most ``radius`` keeps the limits.
        """
        samples, n, width, limits = len(u), self._n, self._n_quantities, self._limits
        values = []
        for i in range(width):
            values.append(np.full(samples, -1.0))
            values += [jacobians[1:, i, j] for j in range(n)]
            values += [jacobians[lag:, i, n + lag] for lag in range(3)]
        values.append(2.0 * u)
        shape = (samples * width + 1, samples * (1 + width))
        matrix = sparse.csc_array((np.concatenate(values), self._index_arrays), shape=shape)
        matrix.eliminate_zeros()
        bounds = np.full((shape[1], 2), [-np.inf, np.inf])
        bounds[:samples, 0] = np.maximum(-limits.amplitude - u, -radius)
        bounds[:samples, 1] = np.minimum(limits.amplitude - u, radius)
        if np.isfinite(limits.soft_limit):
            bounds[samples + self._output_state :: width] = np.stack(
                [-limits.soft_limit - output_signal, limits.soft_limit - output_signal], axis=1
            )
        energy_left = limits.energy - float(u @ u)
        objective = np.concatenate([-gradient, np.zeros(samples * width)])
        found = self._solve(matrix, objective, bounds, energy_left)
        if found is None:
            return None
        states = np.zeros((samples, n))
        states[1:] = found[samples:].reshape(samples, width)[:-1, :n]
        return found[:samples], states

    def _solve(self, matrix: Any, objective: FloatArray, bounds: FloatArray, energy_left: float) -> FloatArray | None:
        """The optimal solution with the last row at most ``energy_left`` and the other rows equal to 0."""
        highspy, solver = self._highspy, self._solver
        rows = np.zeros((matrix.shape[0], 2))
        rows[-1] = -np.inf, energy_left
        model = highspy.HighsLp()
        model.num_row_, model.num_col_ = matrix.shape
        model.col_cost_, model.col_lower_, model.col_upper_ = objective, bounds[:, 0], bounds[:, 1]
        model.row_lower_, model.row_upper_ = rows[:, 0], rows[:, 1]
        sparse_matrix = model.a_matrix_
        sparse_matrix.format_ = highspy.MatrixFormat.kColwise
        sparse_matrix.start_, sparse_matrix.index_, sparse_matrix.value_ = matrix.indptr, matrix.indices, matrix.data
        solver.passModel(model)
        if self._basis is not None:
            solver.setBasis(self._basis)
        solver.run()
        if solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            self._basis = None
            return None
        self._basis = solver.getBasis()
        return np.array(solver.getSolution().col_value)
