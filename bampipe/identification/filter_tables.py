"""Tables and summaries of a filter's results: states, convergence, consistency, innovations."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd

from bampipe.arrays import Array, Flags, Indices
from bampipe.estimate.innovations import (
    InnovationTest,
    average_stretches,
    check_independence,
    check_whiteness,
)
from bampipe.estimate.unscented import FilterModel
from bampipe.identification.filter_run import STRETCH_S, FilterRun, Pass
from bampipe.physics import System
from bampipe.results.identify import (
    Consistency,
    Convergence,
    Independence,
    InnovationTests,
    StateBound,
    Whiteness,
)
from bampipe.trials.motion import Motion, trial_names
from bampipe.trials.residuals import ModelOnTrial

_LAGS_S = (0.0, 0.25, 0.5)
"""Lags of the inputs in the test of independence."""
WHITE_SHARE = 0.2
"""A channel counts as white if the past predicts less than this fraction of its variance."""
INPUT_SHARE = 0.05
"""A channel counts as independent if the inputs predict less than this fraction of its variance."""
_SIGNIFICANT = 0.01


def tabulate_nis(found: FilterRun, motions: Sequence[Motion]) -> Consistency:
    """Return the normalised innovation squared, which is near 1 if the noise levels are right."""
    names, of_parts = trial_names(motions), dict[str, list[Pass]]()
    for place, trial in zip(found.order, found.trials, strict=True):
        of_parts.setdefault(names[place], []).append(trial)

    def mean(parts: Sequence[Pass]) -> float:
        total = np.average([one.nis for one in parts], weights=[one.counted for one in parts])
        return float(total) / found.settings.observed.size

    by_trial = {name: mean(parts) for name, parts in of_parts.items()}
    return Consistency(mean=mean(found.trials), by_trial=by_trial)


def state_3sigma(system: System, trials: Sequence[Pass]) -> dict[str, StateBound]:
    """Return three standard deviations of position and velocity, median over time (Table VI)."""
    n = len(system.coordinates)
    variance = np.concatenate([trial.variance[:, : 2 * n] for trial in trials])
    bound = 3.0 * np.sqrt(np.median(variance, axis=0))
    return {
        axis: StateBound(position=bound[i], velocity=bound[n + i])
        for i, axis in enumerate(system.coordinates)
    }


def convergence(
    names: Sequence[str], model: FilterModel, found: FilterRun, covariance: Array
) -> Convergence:
    """Return the time after which every estimate stays within 2 % or 3 sd of its final value.

    Time counts from the start of the first run; the last run alone decides on convergence.
    """
    nx = model.n_states
    value, slope = model.to_physical(np.concatenate([p.mean[:, nx:] for p in found.passes]))
    elapsed = np.concatenate(_elapsed(found.passes))
    final = value[-1]
    band = np.maximum(0.02 * np.abs(final), 3.0 * slope[-1] * np.sqrt(np.diag(covariance)))
    outside = np.abs(value - final) > band
    settled = {}
    for place, name in enumerate(names):
        late = np.flatnonzero(outside[:, place])
        settled[name] = float(elapsed[late[-1]]) if late.size else 0.0
    total = float(elapsed[-1])
    began = float(elapsed[sum(p.t.size for p in found.first) - 1]) if found.first else 0.0
    late_s = max(settled.values(), default=0.0) - began
    converged = late_s < 0.9 * (total - began)
    return Convergence(settled_s=settled, total_s=total, converged=converged)


def _elapsed(passes: Sequence[Pass]) -> list[Array]:
    """Return the time of each pass, counted from the start of the first."""
    clock, times = 0.0, []
    for trial in passes:
        times.append(clock + trial.t - trial.t[0])
        clock += float(trial.t[-1] - trial.t[0])
    return times


def _thinned(count: int, rows: int) -> Indices:
    """Return indices of at most ``rows`` of ``count`` samples, the last one included."""
    step = -(-count // rows)
    return np.arange(count - 1, -1, -step)[::-1]


def tabulate_states(
    system: System, motions: Sequence[Motion], found: FilterRun, p: Array, rows: int
) -> pd.DataFrame:
    """Tabulate the filtered motion of every trial, at most ``rows`` rows each, at ``p`` (n_p,)."""
    n = len(system.coordinates)
    frames: dict[int, pd.DataFrame] = {}
    for place, trial in zip(found.order, found.trials, strict=True):
        keep = _thinned(trial.t.size, rows)
        t, mean = trial.t[keep], trial.mean[keep]
        sd = np.sqrt(trial.variance[keep])
        columns = {}
        for i, axis in enumerate(system.coordinates):
            columns[f"q_{axis}"], columns[f"q_sd_{axis}"] = mean[:, i], sd[:, i]
            columns[f"qd_{axis}"], columns[f"qd_sd_{axis}"] = mean[:, n + i], sd[:, n + i]
        frames[place] = with_torques(system, motions[place], t, columns, p)
    return pd.concat([frames[i] for i in range(len(motions))], ignore_index=True)


def with_torques(
    system: System, motion: Motion, t: Array, columns: Mapping[str, Array], p: Array
) -> pd.DataFrame:
    """Add the trial, the torque of the hand and that against gravity to a motion (Fig. 6).

    Rows are at times ``t`` (K,), and so are the columns, each (K,).
    """
    found = ModelOnTrial(system, p, [motion])
    true, hand = found.mechanism, found.applied
    gravity = system.compensation(true.q, true.qd, found.memory, found.inputs, p)
    frame = pd.DataFrame({"trial_id": motion.trial_id, "t": t, **columns})
    for i, axis in enumerate(system.coordinates):
        frame[f"torque_user_{axis}"] = np.interp(t, motion.t, hand[:, i])
    for i in system.compensated:
        axis = system.coordinates[i]
        frame[f"torque_gravity_{axis}"] = np.interp(t, motion.t, gravity[:, i])
    return frame


def as_filtered(system: System, motion: Motion, p: Array) -> pd.DataFrame:
    """Tabulate the states of a trial whose motion the estimate, ``p`` (n_p,), does not change."""
    columns = {}
    for i, axis in enumerate(system.coordinates):
        columns[f"q_{axis}"], columns[f"qd_{axis}"] = motion.q[:, i], motion.qd[:, i]
        columns[f"qd_sd_{axis}"] = motion.qd_sd[:, i]
    return with_torques(system, motion, motion.t, columns, p)


def tabulate_trace(
    names: Sequence[str], model: FilterModel, motions: Sequence[Motion], found: FilterRun, rows: int
) -> pd.DataFrame:
    """Tabulate how the parameters converged, trial by trial, starting with the search.

    The first ``len(names)`` of the filter's parameters are stored, at most ``rows`` rows per trial.
    The column ``run`` is 0 in the first run and 1 in the restart around its answer.
    """
    frames, trial_ids = [], trial_names(motions)
    passes = zip(found.steps, found.passes, _elapsed(found.passes), strict=True)
    for place, (step, trial, elapsed) in enumerate(passes):
        keep = _thinned(trial.t.size, rows)
        value, slope = model.to_physical(trial.mean[keep, model.n_states :])
        value = np.clip(value, model.lower, model.upper)
        variance = trial.variance[keep, model.n_states :]
        run = int(bool(found.first) and place >= len(found.first))
        frame = pd.DataFrame({"t_total": elapsed[keep], "trial_id": trial_ids[step], "run": run})
        for k, name in enumerate(names):
            frame[name] = value[:, k]
            frame[f"{name}_sd"] = slope[:, k] * np.sqrt(variance[:, k])
        frames.append(frame)
    return pd.concat(frames, ignore_index=True)


def check_innovations(
    system: System, found: FilterRun, moving: Callable[[int], Flags]
) -> dict[str, InnovationTests]:
    """Test innovations of each position for whiteness and independence of the inputs.

    ``moving`` returns, for the index of a trial, the samples at which each axis is clear of
    standstill and reversal, (T, n_q).
    """
    n, lags = len(system.coordinates), [round(lag / STRETCH_S) for lag in _LAGS_S]
    channels = [i for i, name in enumerate(system.inputs) if name != "t"]
    by_trial, inputs = [], []
    for place, trial in zip(found.order, found.trials, strict=True):
        clear = average_stretches(moving(place).astype(float), trial.stretch_samples) == 1.0
        by_trial.append(np.where(clear, trial.stretches[:, :n], np.nan))
        inputs.append(trial.inputs[:, channels])
    tests = {}
    for axis, name in enumerate(system.coordinates):
        records = [stretches[:, axis] for stretches in by_trial]
        own, driven = check_whiteness(records), check_independence(records, inputs, lags)
        tests[name] = InnovationTests(
            sentence=_sentence(own, driven),
            whiteness=Whiteness(**vars(own), white=not _fails(own, WHITE_SHARE)) if own else None,
            inputs=Independence(**vars(driven), independent=not _fails(driven, INPUT_SHARE))
            if driven
            else None,
        )
    return tests


def _fails(test: InnovationTest, limit: float) -> bool:
    return test.p_value < _SIGNIFICANT and test.share > limit


def _sentence(own: InnovationTest | None, driven: InnovationTest | None) -> str:
    """Describe both outcomes in a sentence."""
    if own is None or driven is None:
        return "Too little motion to test the innovations."
    past = f"their past predicts {100.0 * own.share:.0f} % of their variance"
    force = f"the inputs {100.0 * driven.share:.0f} %"
    if not _fails(own, WHITE_SHARE) and not _fails(driven, INPUT_SHARE):
        return f"White and independent of the inputs: {past}, {force}; no sign of a missing effect."
    if _fails(driven, INPUT_SHARE):
        return (
            f"Not independent of the inputs: {past}, {force}. The model responds wrongly to the"
            " force: look for a delay, a gain, an inertia or a load path."
        )
    return (
        f"Not white: {past}, {force}. The model lacks an effect that does not follow the force,"
        " such as another form of friction."
    )
