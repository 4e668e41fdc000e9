"""The estimate without a trial, or without a block of a single one, is that of a fit without it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from sessions import bam, folds, made

from bampipe.diagnosis.session import system_of
from bampipe.estimate.standstill import find_moving_samples
from bampipe.identification.least_squares_estimate import SquaresFit, fit_squares
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.residuals import problem_of, rms

CASES = {
    "linear": ([], {}),
    "shape": (["stribeck:yaw"], {"stribeck.yaw.force": 1.1, "stribeck.yaw.speed": 0.05}),
}


def without_trials(trials: MeasuredTrials) -> Iterator[MeasuredTrials]:
    """The session without each of its trials."""
    count = len(trials.motions)
    for out in range(count):
        others = [k for k in range(count) if k != out]
        motions = [trials.motions[k] for k in others]
        yield replace(trials, motions=motions, folds=folds(count - 1))


def without_blocks(fit: SquaresFit) -> Iterator[MeasuredTrials]:
    """The session without each block of its only trial, and a period of the band around it."""
    (motion,), band = fit.trials.motions, fit.trials.band
    for part in fit.parts:
        judged = part.t[band.thinned_rows(len(part.t))]
        period = 1.0 / min(band.cutoff_hz)
        inside = (motion.t >= judged[0] - period) & (motion.t <= judged[-1] + period)
        left_out = np.tile(inside[:, None], (1, 3)) | motion.left_out
        yield replace(fit.trials, motions=[replace(motion, left_out=left_out)])


@pytest.mark.parametrize(("case", "count"), [("linear", 4), ("shape", 3), ("shape", 1)])
def test_an_estimate_moves_and_errs_as_a_fit_to_the_rest(case: str, count: int) -> None:
    """Up to what fresh replicates change of the weights of samples."""
    effects, values = CASES[case]
    recipe = bam(effects)
    system = system_of(recipe)
    trials = made(recipe, values, trials=count, seconds=8.0 if count > 1 else 16.0)
    fit = fit_squares(trials, recipe, system, system.prior, 2.0)
    assert len(fit.parts) == (count if count > 1 else 12)
    judged = problem_of(system, fit.parts, trials.band)
    rest = list(without_trials(trials) if count > 1 else without_blocks(fit))
    residuals, used = [], []
    for number in range(0, len(rest), 3 if count == 1 else 1):
        refit = fit_squares(rest[number], recipe, system, fit.p[:-1], 2.0).p
        moved = (refit - fit.p)[fit.free] / fit.sd
        np.testing.assert_allclose(fit.moves[number] / fit.sd, moved, atol=0.5)
        residuals.append(trials.band.thin(judged.residual(number, refit)))
        used.append(find_moving_samples(judged.standstill[number], trials.band))
    if count > 1:
        np.testing.assert_allclose(fit.held_out_rmse(fit.p), rms(residuals, used), rtol=0.02)


def test_a_trial_too_short_for_blocks_moves_nothing() -> None:
    trials = made(bam(), {}, trials=1, seconds=4.0)
    system = system_of(bam())
    fit = fit_squares(trials, bam(), system, system.prior, 2.0)
    assert [m.trial_id for m in fit.parts] == ["t01"] and not fit.moves[0].any()
    np.testing.assert_allclose(fit.held_out_rmse(fit.p), fit.fit.evidence.rmse(), rtol=0.05)
