"""Joints whose motion a position controller gives: what the right effect explains is found."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from independent import prescribed
from independent.sensors import Conditions
from independent_runs import record_trials, run_short
from sessions import fit_from_priors

from bampipe.data.run_folder import RunFolder
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.select import change_set, gains_when_fitted, open_search
from bampipe.diagnosis.session import Session, system_of
from bampipe.physics.model_spec import ModelSpec
from bampipe.physics.registry import device_from
from bampipe.trials.linear_problem import pose_problem
from bampipe.trials.measured import MeasuredTrials, read_measured_trials
from bampipe.trials.replicates import keep_motion
from bampipe.trials.residuals import ModelOnTrial
from bampipe.trials.scale import log_scale, slopes_by_force


def plain_trials(trials: MeasuredTrials, spec: ModelSpec) -> list[ModelOnTrial]:
    """The model as given, at its priors, on each trial."""
    model, motions = system_of(spec), trials.motions
    return [ModelOnTrial(model, model.prior, motions, k) for k in range(len(motions))]


def test_delays_shorter_than_the_true_one_promise_what_they_can_at_their_bounds(
    tmp_path: Path,
) -> None:
    """Without that, the only shape within its bounds was never weighed beside two that were not."""
    conditions = Conditions(trials=2, seconds=8.0, rate_hz=500.0)
    prescribed.record(tmp_path / "logs", 7, {"actuator_delay": 2.0}, conditions)
    run = run_short(tmp_path / "logs", tmp_path, ("ingest", "filter"))
    spec = ModelSpec(device_from(tomllib.loads(prescribed.DEVICE)).declaration, (), ())
    trials = read_measured_trials(RunFolder(run.root), system_of(spec), every_input=True)
    # Replicates keep the motion of a machine that another one moves, as its drive does not.
    moved = tomllib.loads(prescribed.DEVICE.replace("drive =", "prescribed ="))
    by_another = replace(spec, device=device_from(moved).declaration)
    assert keep_motion(plain_trials(trials, by_another))
    assert not keep_motion(plain_trials(trials, spec))
    session = Session(trials, Criteria())
    fit = fit_from_priors(session, spec)
    with open_search(session, fit, only=("actuator_delay",)) as search:
        gains = search.gains(())
        shorter = [search.dictionary.values(key)[0] < 8e-3 for key in search.grid_keys]
        assert sum(shorter) >= 3
        assert (np.diff(gains[shorter]) > 0.0).all() and (gains[shorter] > 0.0).all()


def test_a_drive_that_hardly_acts_any_more_explains_nothing(tmp_path: Path) -> None:
    """Friction that falls with the speed left nearly one force, which a drive at its limit has."""
    trials, spec, _ = record_trials(tmp_path, "joint", 3)
    session, weak = Session(trials, Criteria()), change_set(spec, [("drive_sag:joint", ())])
    before = fit_from_priors(session, spec)
    p = before.linearisation.p
    same, weaker = (
        replace(before, spec=weak, linearisation=session.linearise(weak, np.append(p, sag)))
        for sag in (0.0, 1e3)
    )
    keys = (("drive_sag:joint", (0.5,)),)
    small = replace(weaker, problem=pose_problem(before.likelihood, weaker.linearisation))
    with open_search(session, before, only=("drive_sag:joint",)) as search:
        assert search.volume_where_fitted(keys, same.linearisation) == pytest.approx([0.0])
        assert search.volume_where_fitted(keys, weaker.linearisation) is None
        assert gains_when_fitted(before, small, search, keys)[0] == -np.inf
    ends = [session.fit_plainly(weak, np.append(p, sag)) for sag in (0.0, 0.02, 1.0)]
    for end in ends:
        assert end.linearisation.p[-1] == pytest.approx(
            ends[0].linearisation.p[-1], rel=1e-3, abs=1e-6
        )
        assert end.solution.cost <= before.solution.cost + 0.01


def test_a_sagging_drive_leaves_the_scale_that_its_curve_has(tmp_path: Path) -> None:
    """Of d = f/(1 + sag |f|) the slope is 1/(1 + sag |f|)^2; a smooth load rounds it near zero."""
    trials, spec, _ = record_trials(tmp_path, "joint", 3)
    model = system_of(change_set(spec, [("drive_sag:joint", ())]))
    p = np.append(system_of(spec).prior, 0.01)
    used = [np.abs(r.applied) > 0.5 * np.abs(r.applied).max() for r in plain_trials(trials, spec)]
    used = [u[trials.band.thinned_rows(len(u))] for u in used]
    added = [r[..., 0] for r in slopes_by_force(model, trials.motions, trials.band, [p])]
    scale, slopes = log_scale(model, trials.motions, trials.band, used, p, [0, len(p) - 1], added)
    applied = [np.abs(r.applied) for r in plain_trials(trials, spec)]
    thinned = [a[trials.band.thinned_rows(len(a))] for a in applied]
    force = np.concatenate([a[u] for a, u in zip(thinned, used, strict=True)])
    assert scale == pytest.approx([np.mean(-2.0 * np.log(1.0 + 0.01 * force))], rel=1e-3)
    by_sag = np.mean(-2.0 * force / (1.0 + 0.01 * force))
    assert slopes == pytest.approx(np.array([[0.0, by_sag]]), rel=1e-2)
