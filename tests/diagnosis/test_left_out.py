"""The estimate without a trial, or without a block of a single one, is that of a fit without it."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import bam, folds, made

from bampipe.diagnosis.session import system_of
from bampipe.identification.least_squares_estimate import fit_squares
from bampipe.trials.residuals import rms

STRIBECK = {"stribeck.yaw.force": 1.1, "stribeck.yaw.speed": 0.05}


@pytest.mark.parametrize(
    ("values", "count"), [pytest.param({}, 4, marks=pytest.mark.long), (STRIBECK, 4), (STRIBECK, 1)]
)
def test_an_estimate_moves_and_errs_as_a_fit_to_the_rest(values, count):
    """To first order: no part may hold most of what is known of a parameter."""
    spec = bam(["stribeck:yaw"] if values else [])
    system = system_of(spec)
    trials = made(spec, values, trials=count, seconds=8.0 if count > 1 else 16.0)
    fit = fit_squares(trials, spec, system, system.prior, 2.0)
    assert len(fit.parts) == (count if count > 1 else 12)
    step, refits, band = 1 if count > 1 else 4, [], trials.band
    for part in fit.parts[::step]:
        rest = [m for m in trials.motions if m.trial_id != part.trial_id]
        if count == 1:
            judged = part.t[band.thinned_rows(len(part.t))]
            gone = np.abs(rest[0].t - judged[[0, -1]].mean()) < 0.5 * np.ptp(judged) + 1.0 / 8.0
            rest = [replace(rest[0], left_out=rest[0].left_out | gone[:, None])]
        others = replace(trials, motions=rest, folds=folds(len(rest)))
        refits.append(fit_squares(others, spec, system, fit.p[:-1], 2.0).p)
    moved = (np.array(refits) - fit.p)[:, fit.free]
    np.testing.assert_allclose(fit.moves[::step] / fit.sd, moved / fit.sd, atol=0.5)
    if count > 1:
        used, residual = fit.fit.linearisation.used, fit.problem.residual
        error = rms((band.thin(residual(k, p)) for k, p in enumerate(refits)), used)
        np.testing.assert_allclose(fit.held_out_rmse(fit.p), error, rtol=0.02)
