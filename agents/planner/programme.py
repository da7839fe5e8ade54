"""The linear programme of a step of `agents.planner.polish`: the best small change of an input, within exact limits.

HiGHS solves it once for every step. From one step to the next its numbers change and its shape does not, so each
solution starts from the basis of the last, and takes far fewer pivots than from nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from agents.planner.ascent import Limits
from estimator.extras import need
from estimator.parameters import FloatArray


class Programme:
    """The programmes of one polishing.

    Args:
        samples: T.
        n: states.
        shown: the state that the first sensor shows, or n where it shows another output.
        limits: to be kept; ``aim`` is the limit of the signal.

    Raises:
        ModuleNotFoundError: without highspy, which the extra ``oracle`` brings.
    """

    def __init__(self, samples: int, n: int, shown: int, limits: Limits) -> None:
        need("highspy")
        import highspy

        self._highspy = highspy
        self._solver = highspy.Highs()
        # Presolving costs more than it saves where the last basis is nearly optimal.
        for option, value in (("presolve", "off"), ("solver", "simplex"), ("threads", 1), ("output_flag", False)):
            self._solver.setOptionValue(option, value)
        self._basis: Any = None
        self._n, self._shown, self._limits = n, shown, limits
        self._width = max(n, shown + 1)  # of what a sample leads to: states, and what is shown
        t, width = np.arange(samples), self._width
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
        self._places = np.concatenate(rows), np.concatenate(columns)

    def best(
        self, u: FloatArray, gradient: FloatArray, shown: FloatArray, slopes: FloatArray, radius: float
    ) -> tuple[FloatArray, FloatArray] | None:
        """The best change (T,) of the inputs to first order, and that of the states (T, n) before every sample.

        Args:
            u: (T,) the inputs.
            gradient: (T,) of the worth.
            shown: (T,) what the first sensor shows.
            slopes: (T, n + 1, n + 3) as `agents.planner.polish.Line`.
            radius: of the change.

        Returns:
            None where no change of at most ``radius`` keeps the limits.
        """
        samples, n, width, limits = len(u), self._n, self._width, self._limits
        values = []
        for i in range(width):
            values.append(np.full(samples, -1.0))
            values += [slopes[1:, i, j] for j in range(n)]
            values += [slopes[lag:, i, n + lag] for lag in range(3)]
        values.append(2.0 * u)
        shape = (samples * width + 1, samples * (1 + width))
        matrix = sparse.csc_array((np.concatenate(values), self._places), shape=shape)
        matrix.eliminate_zeros()
        bounds = np.full((shape[1], 2), [-np.inf, np.inf])
        bounds[:samples, 0] = np.maximum(-limits.amplitude - u, -radius)
        bounds[:samples, 1] = np.minimum(limits.amplitude - u, radius)
        if np.isfinite(limits.aim):
            bounds[samples + self._shown :: width] = np.stack([-limits.aim - shown, limits.aim - shown], axis=1)
        spared = limits.energy - float(u @ u)
        price = np.concatenate([-gradient, np.zeros(samples * width)])
        found = self._solve(matrix, price, bounds, spared)
        if found is None:
            return None
        states = np.zeros((samples, n))
        states[1:] = found[samples:].reshape(samples, width)[:-1, :n]
        return found[:samples], states

    def _solve(self, matrix: Any, price: FloatArray, bounds: FloatArray, spared: float) -> FloatArray | None:
        """The solution that costs least, where the last row is at most ``spared`` and the others are 0."""
        highspy, solver = self._highspy, self._solver
        rows = np.zeros((matrix.shape[0], 2))
        rows[-1] = -np.inf, spared
        model = highspy.HighsLp()
        model.num_row_, model.num_col_ = matrix.shape
        model.col_cost_, model.col_lower_, model.col_upper_ = price, bounds[:, 0], bounds[:, 1]
        model.row_lower_, model.row_upper_ = rows[:, 0], rows[:, 1]
        held = model.a_matrix_
        held.format_ = highspy.MatrixFormat.kColwise
        held.start_, held.index_, held.value_ = matrix.indptr, matrix.indices, matrix.data
        solver.passModel(model)
        if self._basis is not None:
            solver.setBasis(self._basis)
        solver.run()
        if solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            self._basis = None
            return None
        self._basis = solver.getBasis()
        return np.array(solver.getSolution().col_value)
