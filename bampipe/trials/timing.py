"""Delay of a robot's inputs behind its positions, from all drives together."""

from collections.abc import Sequence

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.bounded import invert_scaled
from bampipe.estimate.least_squares import as_measured, stacked_residual
from bampipe.estimate.low_pass import Band
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.physics import System
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import problem_of


def find_robot_timing(
    system: System, motions: Sequence[Motion], band: Band, p: Array
) -> tuple[float, float]:
    """Delay of the sampling of a robot's inputs behind its positions, and its sd, s.

    One clock reads all drives, so the delay is the median over the joints: in a common fit, one
    drive that acts late would move the delay, and with it all other joints. Samples near reversals
    do not count: friction that truly stops a joint appears milliseconds late there, and would
    outweigh the rest of the path. Nor do joints whose drive has a delay of its own in the model.

    The residual is linearised at the fitted parameters ``p`` (n_p,). If no joint determines the
    delay, the result is zero and infinity.
    """
    problem = problem_of(system, motions, band, timing=True, turning=False)
    at = np.append(p, 0.0)
    stacked = [stacked_residual(problem, trial, at) for trial in range(len(motions))]
    slopes = [each.slope for each in as_measured(problem, at, stacked)]
    own, axes = problem.free.size - 1, range(len(system.coordinates))
    # Replace the column of the common delay by one for each joint.
    split = [
        np.concatenate([slope[:, :, :own], slope[:, :, own:] * np.eye(len(axes))], axis=2)
        for slope in slopes
    ]
    sums = NormalEquations.from_samples(
        split, [each.residual for each in stacked], [each.used for each in stacked],
        problem.precision[:own], problem.known[:own] - at[problem.free[:own]],
    )  # fmt: skip
    anywhere = np.full(len(axes), np.inf)
    lower = np.append(problem.lower[:own] - at[problem.free[:own]], -anywhere)
    upper = np.append(problem.upper[:own] - at[problem.free[:own]], anywhere)
    weight = 1.0 / np.maximum(sums.mean_square(np.zeros(lower.size)), 1e-24)
    step = sums.solve(weight, lower, upper)
    weight = band.independent_share / np.maximum(sums.mean_square(step), 1e-24)
    normal = np.tensordot(weight, sums.xx.sum(axis=0), 1) + np.diag(sums.precision)
    late = sums.solve(weight, lower, upper)[own:]
    variance = np.diag(invert_scaled(normal))[own:]
    determined = np.flatnonzero((variance > 0.0) & (variance < problem.upper[-1] ** 2))
    if not determined.size:
        return 0.0, np.inf
    count = determined.size
    middle = determined[np.argsort(late[determined])][(count - 1) // 2 : count // 2 + 1]
    chosen = middle[np.argmin(np.abs(late[middle]))]
    return float(late[chosen]), float(np.sqrt(variance[chosen]))
