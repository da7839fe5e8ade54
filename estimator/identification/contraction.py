"""How the posterior contracts: what the first samples of the records leave open."""

from __future__ import annotations

from estimator.identification.problem import Problem
from estimator.identification.search import Found
from estimator.rig_prior import about

#: The records are halved so often, and shorter ones are left out.
_HALVINGS, _SHORTEST = 7, 50

#: Steps of a fit at most.
_STEPS = 12

#: Outputs that were used, with the mean and standard deviation of each parameter that they leave.
History = tuple[tuple[int, dict[str, tuple[float, float]]], ...]


def contraction(problem: Problem, found: Found, parameters: dict[str, tuple[float, float]]) -> History:
    """The parameters that the first half of every record leaves, the first quarter, and so on; shortest first.

    Each is a fit of its own from what all samples say, with the noises in the best ratio. One that runs away is left
    out. Last come the ``parameters`` that all leave.
    """
    longest, history = max(len(u) for u in problem.u), []
    for halvings in range(_HALVINGS, 0, -1):
        count = longest >> halvings
        if count < _SHORTEST:
            continue
        short = problem.shortened(count)
        fits = found.fitter.on(short).fit([found.best], found.mean, found.level, _STEPS)
        if fits.free_energy[0] < float("inf"):
            belief = about(problem.rig, problem.scales, fits.mean[0], fits.cov[0])
            told = {name: (mean, std) for name, (mean, std, _) in belief.parameters().items()}
            history.append((short.samples, told))
    return (*history, (problem.samples, parameters))
