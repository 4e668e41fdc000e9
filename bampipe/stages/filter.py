"""Stage filter: velocity and acceleration from encoders, on a uniform grid, with error bands."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.arrays import Array, Flags
from bampipe.data.refusals import refusal
from bampipe.data.run_folder import FILTERED, INGESTED, MOVING, RunFolder
from bampipe.data.store import ParquetAppender, read_parquet
from bampipe.declarations.model_file import load_device
from bampipe.errors import InputError
from bampipe.estimate import kalman_smoother
from bampipe.estimate.differentiation import uniform_grid
from bampipe.estimate.low_pass import Band
from bampipe.estimate.white_noise import white_noise_sd
from bampipe.lists import count_noun
from bampipe.phrases.results import describe_dead_stretch, list_setup_faults
from bampipe.physics import Model, System, compile_model
from bampipe.progress import Progress
from bampipe.results.filter import (
    AxisDifferentiation,
    Disturbance,
    FilterResult,
    ForceFilter,
    ResidualBand,
)
from bampipe.results.ingest import IngestResult
from bampipe.results.setup import SetupResult
from bampipe.schema import STRICT, NotNegative
from bampipe.setup.inspection import inspect_setup
from bampipe.setup.search import HIGHEST_HZ, MOST_TRIALS, shorten
from bampipe.trials.band import LEAST_HZ, find_band
from bampipe.trials.disturbances import find_disturbances
from bampipe.trials.folds import Folds
from bampipe.trials.force_offsets import find_force_offsets
from bampipe.trials.kept import MOST_OF_TRIALS, KeptItems
from bampipe.trials.kinematics import AxisFilter, Kinematics
from bampipe.trials.motion import Motion, input_derivatives
from bampipe.trials.reading import held_out_trials, read_motion
from bampipe.trials.sensors import Sensors

SUMMARY = "Velocity and acceleration from the encoders, with error bands"
INPUTS = (*INGESTED, "ingest/device.toml?")
OUTPUTS = (*FILTERED, "filter/setup.json")

_FORCE_CUTOFF_HZ = 25.0
_CUTOFF_OVER_BAND = 4.0
"""Least cut-off of an input's derivatives over the band: at a quarter of their cut-off they are 0.4
% too small, at two thirds 17 %, which biases a delay of 2 ms by 5 %."""
_HIGHEST_CUTOFF = 0.4
"""Share of the sampling rate: twice the highest frequency of a residual, with a loss of 0.3 %."""
_NO_NOISE, _UNFOLLOWED = 30.0, 0.1
"""A motion is too fast for the rate of the log if differences of position exceed so many times the
noise of the quietest trial, and of the steps from sample to sample."""
_SHORTEST = 32
"""Fewest samples of a trial that can be differentiated."""
_INSPECTED, _TUNING_PART = 12_000, 2000
"""Samples of all trials on which the set-up is judged; least length of the parts of many trials
that determine the bandwidth."""
_TRIALS_OF_BAND = 5


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        method: ``kalman`` (fixed-interval smoother), ``butterworth`` (zero-phase filter and
            central differences), or ``auto``, which is the Kalman smoother: it alone bridges
            gaps with honest error bands and has its bandwidth set by the likelihood of the
            samples.
        cutoff_hz: bandwidth, Hz, for all axes; 0 takes it from the data, axis by axis: the maximum
            likelihood over order and process noise of the Kalman smoother.
        minimum_bandwidth_hz: a bandwidth taken from the data is held at this or above, Hz:
            changes of direction must not be smeared, friction is read from them.
        force_cutoff_hz: half-amplitude frequency, Hz, of the derivatives of the force; the force
            itself is not filtered. 0 takes 25 Hz, or four times the widest band where that is
            above 8 Hz: a delay is judged by these derivatives up to the end of the band.
        band_hz: upper end of the band in which residuals are compared, Hz, by every later stage; 0
            takes it from the data, axis by axis: where motion and force carry signal above noise.
        tuning_samples: at most so many samples of each axis are used to choose the bandwidth, in
            equal parts from all trials, or from some that are spread over the session if there are
            very many.
    """

    method: Literal["auto", "kalman", "butterworth"] = "auto"
    cutoff_hz: NotNegative = 0.0
    minimum_bandwidth_hz: NotNegative = 25.0
    force_cutoff_hz: NotNegative = 0.0
    band_hz: NotNegative = 0.0
    tuning_samples: Annotated[int, Field(ge=1000)] = 120_000


def _list_hz(by_axis: Mapping[str, float]) -> str:
    return ", ".join(f"{axis} {hz:.1f} Hz" for axis, hz in by_axis.items())


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Differentiate every free and viscous trial."""
    session = run.read(IngestResult)
    axes, rate = session.axes, session.sample_rate_hz
    samples = run.require("ingest/samples.parquet", "ingest")
    trials = read_parquet(run.require("ingest/trials.parquet", "ingest"))
    wanted = trials[trials["kind"].isin(MOVING) & (trials["status"] != "set_aside")]
    ids = [str(name) for name in wanted["trial_id"]]

    progress(0.0, "choosing the bandwidth")
    records, refused = _tuning_records(samples, ids, tuple(axes), rate, config.tuning_samples)
    if not any(records.values()):
        raise _nothing_to_differentiate(run, trials, refused)
    chosen = {
        axis: _choose(axis, records[axis], rate, entry.resolution, config)
        for axis, entry in axes.items()
    }
    kinematics = Kinematics(
        "kalman" if config.method == "auto" else config.method,
        rate,
        {axis: how for axis, (how, _) in chosen.items()},
        min(config.force_cutoff_hz or _FORCE_CUTOFF_HZ, _HIGHEST_CUTOFF * rate),
    )
    path = out / "filter/kinematics.parquet"
    levels, bridged, skipped = _write_motions(path, samples, ids, kinematics, progress)
    progress(0.9, "the band of motion and force")
    system = compile_model(Model(load_device(run, session.device)))
    names = [k for k in ids if k in bridged]
    # The band is that of some of the trials, spread over the session.
    some = np.unique(np.linspace(0, len(names) - 1, min(len(names), _TRIALS_OF_BAND)).round())
    motions = _motions(path, [names[int(k)] for k in some], system, {})
    sensors = Sensors.from_result(session, system.coordinates, system.model.device.forces)
    bands = find_band(system, motions, sensors, kinematics, config.band_hz)
    widest = max(band.cutoff_hz for band in bands.values())
    needed = min(_CUTOFF_OVER_BAND * widest, _HIGHEST_CUTOFF * rate)
    if not config.force_cutoff_hz and widest > LEAST_HZ and needed > kinematics.input_cutoff_hz:
        kinematics = replace(kinematics, input_cutoff_hz=needed)
        levels, bridged, skipped = _write_motions(path, samples, ids, kinematics, progress)
    progress(0.95, "disturbances")
    of_kind = set(trials.loc[trials["kind"] == MOVING[0], "trial_id"])
    free = [name for name in names if name in of_kind]
    held_out = held_out_trials(run)
    fitted = [k for k, name in enumerate(free) if name not in held_out]
    band = Band(rate, tuple(bands[axis].cutoff_hz for axis in system.coordinates))
    dead = {
        name: tuple(Disturbance.of(one, reason=describe_dead_stretch(one)) for one in stretches)
        for name, stretches in session.dead.items()
    }
    offsets: dict[str, dict[str, float]] = {}
    # Nobody zeroes a sensor between two stretches of one record.
    if trials.loc[trials["trial_id"].isin(free), "file"].nunique() > 1:
        offsets = find_force_offsets(system, _motions(path, free, system, dead), band, fitted)
    if offsets:
        levels, *_ = _write_motions(path, samples, ids, kinematics, progress, offsets)
    disturbances = dict(dead)
    motions = _motions(path, free, system, dead)
    for name, found in find_disturbances(system, motions, band, fitted).items():
        both = (*dead.get(name, ()), *found)
        disturbances[name] = tuple(sorted(both, key=lambda one: one.start_s))
    default = "default: bandwidth and order by maximum likelihood, gaps bridged with error bands"
    result = FilterResult(
        method=kinematics.method,
        method_reason=default if config.method == "auto" else "chosen by the user",
        sample_rate_hz=rate,
        axes={
            axis: AxisDifferentiation.of(
                unit=entry.unit, band=bands[axis], **levels[axis], **chosen[axis][1]
            )
            for axis, entry in axes.items()
        },
        force=ForceFilter(derivative_cutoff_hz=kinematics.input_cutoff_hz),
        bridged_fraction=bridged,
        skipped=skipped,
        disturbances=disturbances,
        force_offsets=offsets,
        headline=f"{kinematics.method}, {count_noun(len(bridged), 'trial')}; "
        f"bandwidth {_list_hz({axis: one['bandwidth_hz'] for axis, (_, one) in chosen.items()})};"
        " residuals compared below "
        + _list_hz({axis: one.cutoff_hz for axis, one in bands.items()}),
    )
    progress(0.97, "the set-up")
    setup = _inspect(system, path, session, names, of_kind - held_out, bands, disturbances)
    setup.write(out)
    notes = [f"{name}: not used: {reason}" for name, reason in skipped.items()]
    notes += [*_describe_offsets(offsets, session), *_describe_disturbances(disturbances)]
    return result.write(out) | {"setup": list_setup_faults(setup), "notes": notes}


def _nothing_to_differentiate(
    run: RunFolder, trials: pd.DataFrame, refused: Mapping[str, str]
) -> InputError:
    """Say why no trial can be differentiated: none has the right kind, or all are short."""
    if refused:
        name, reason = next(iter(refused.items()))
        of = {"count": len(refused), "name": name, "reason": reason}
        return refusal("all_too_short", str(run.root), **of)
    moving = trials[trials["kind"].isin(MOVING)]
    if len(moving):
        return refusal("all_set_aside", str(run.root), first=moving.iloc[0])
    return refusal("none_moves", str(run.root), count=len(trials))


def _write_motions(
    path: Path,
    samples: Path,
    ids: Sequence[str],
    kinematics: Kinematics,
    progress: Progress,
    offsets: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
) -> tuple[dict[str, dict[str, float]], dict[str, float], dict[str, str]]:
    """Differentiate each trial, its forces without their ``offsets``, and write all to ``path``.

    Returns, by axis, the median errors over the trials; by trial, the share of its samples that are
    guesses across gaps; and of the others, why they were not differentiated.
    """
    levels: dict[str, list[Array]] = {axis: [] for axis in kinematics.axes}
    bridged: dict[str, float] = {}
    skipped: dict[str, str] = {}
    with ParquetAppender(path) as file:
        for number, trial_id in enumerate(ids):
            progress(0.2 + 0.7 * number / len(ids), trial_id)
            frame = read_parquet(samples, trial=trial_id).dropna()
            if short := _tell_shortness(frame):
                skipped[trial_id] = short
                continue
            for axis, one in kinematics.axes.items():
                if _outruns(frame[f"q_{axis}"].to_numpy(dtype=np.float64), one.noise_sd):
                    skipped[trial_id] = (
                        f"{axis} moves too fast for {kinematics.rate_hz:g} samples a second: log"
                        " it at a higher rate"
                    )
            if trial_id in skipped:
                continue
            for name, offset in offsets.get(trial_id, {}).items():
                frame[name] -= offset
            rows, errors = _differentiate(trial_id, frame, kinematics)
            file.append(rows)
            bridged[trial_id] = float(np.mean(rows["bridged"]))
            for axis, own in levels.items():
                own.append(errors[axis])
    names = ("position_sd", "velocity_sd", "acceleration_sd")
    medians = {a: np.median(np.array(own), axis=0) for a, own in levels.items() if own}
    sds = {axis: dict(zip(names, found, strict=True)) for axis, found in medians.items()}
    return sds, bridged, skipped


def _motions(
    path: Path, names: Sequence[str], system: System, left_out: Mapping[str, Sequence[Disturbance]]
) -> Sequence[Motion]:
    """The trials just written."""
    read = (read_motion(path, name, system, left_out.get(name, ())) for name in names)
    return KeptItems(read, MOST_OF_TRIALS)


def _describe_offsets(
    offsets: Mapping[str, Mapping[str, float]], session: IngestResult
) -> Iterator[str]:
    """Return a sentence on the offsets of each force."""
    force = session.force
    names = {name: None for by_force in offsets.values() for name in by_force}
    for name in names:
        gain, unit = 1.0, force.unit
        if name in force.columns and force.raw_unit:
            row = force.calibration[force.columns.index(name)]
            if sum(entry != 0.0 for entry in row) == 1:
                gain, unit = sum(row), force.raw_unit
        each = ", ".join(f"{trial} {by[name] / gain:+.3g}" for trial, by in offsets.items())
        yield (
            f"{name} is zeroed anew in each trial: its offsets from their mean ({each} {unit})"
            " were subtracted; those of held-out trials come from their own samples"
        )


def _describe_disturbances(disturbances: Mapping[str, Sequence[Disturbance]]) -> Iterator[str]:
    """Return a sentence on the stretches of a trial that are left out for one reason."""
    for name, stretches in disturbances.items():
        for reason in dict.fromkeys(one.reason for one in stretches):
            of_it = [one for one in stretches if one.reason == reason]
            where = f"{of_it[0].start_s:.1f} to {of_it[-1].end_s:.1f} s"
            if len(of_it) > 1:
                lasting = sum(one.end_s - one.start_s for one in of_it)
                where = f"{len(of_it)} stretches, {lasting:.1f} s in all,"
            yield f"{name}: {where} left out: {reason}"


def _inspect(
    system: System,
    path: Path,
    session: IngestResult,
    ids: Sequence[str],
    free: Collection[str],
    bands: Mapping[str, ResidualBand],
    disturbances: Mapping[str, Sequence[Disturbance]],
) -> SetupResult:
    """Check the set-up on the trials ``ids``, fitting those in ``free``."""
    most = _INSPECTED // min(len(ids), MOST_TRIALS)

    def read(name: str) -> Motion:
        motion = read_motion(path, name, system, disturbances.get(name, ()), every_input=True)
        return deepcopy(shorten([motion], most)[0])  # a view would keep the whole trial

    motions = KeptItems(map(read, ids), MOST_OF_TRIALS)
    # The bare device excludes brakes: braked trials judge it but are not fitted.
    folds = Folds.of_trials(ids, (), [name for name in ids if name in free])
    cutoffs = tuple(min(bands[axis].cutoff_hz, HIGHEST_HZ) for axis in system.coordinates)
    band = Band(session.sample_rate_hz, cutoffs)
    return inspect_setup(system, session, motions, band, folds, ids)


def _tell_shortness(frame: pd.DataFrame) -> str:
    """Return why a trial with these samples is too short to be differentiated, else ""."""
    is_short = len(frame) < _SHORTEST
    return f"{len(frame)} sound samples, of which {_SHORTEST} are needed" if is_short else ""


def _tuning_records(
    samples: Path, ids: Sequence[str], axes: tuple[str, ...], rate: float, budget: int
) -> tuple[dict[str, list[tuple[Array, Flags]]], dict[str, str]]:
    """Return, per axis, the first parts of trials as positions and flags of samples seen.

    And of the trials looked at, why those without a part have none.
    """
    records: dict[str, list[tuple[Array, Flags]]] = {axis: [] for axis in axes}
    refused: dict[str, str] = {}
    most = max(budget // _TUNING_PART, 1)
    spread = np.unique(np.linspace(0, len(ids) - 1, min(len(ids), most)).round().astype(int))
    rest = np.setdiff1d(np.arange(len(ids)), spread)
    share = max(budget // max(len(spread), 1), _SHORTEST)
    for number, place in enumerate((*spread, *rest)):
        if number >= len(spread) and any(records.values()):
            break
        frame = read_parquet(samples, trial=ids[place]).dropna()
        if short := _tell_shortness(frame):
            refused[ids[place]] = short
            continue
        grid = uniform_grid(frame["t"].to_numpy(dtype=np.float64), rate)
        for axis in axes:
            position = grid.resample(frame[f"q_{axis}"].to_numpy(dtype=np.float64))
            # Copies: a view would keep the whole trial.
            records[axis].append((position[:share].copy(), ~grid.bridged[:share]))
    return records, refused


def _choose(
    axis: str, records: list[tuple[Array, Flags]], rate: float, resolution: float, config: Config
) -> tuple[AxisFilter, dict[str, Any]]:
    """Return how to differentiate ``axis``, of which there are these ``records``, and why."""
    most = 0.2 * rate
    shown = [white_noise_sd(x[seen]) for x, seen in records]
    quietest = max(float(np.nanmin([*shown, np.inf])), resolution / float(np.sqrt(12.0)))
    records = [(x, seen) for x, seen in records if not _outruns(x, quietest)] or records
    fits = {
        order: kalman_smoother.maximum_likelihood(
            records,
            rate,
            resolution,
            order=order,
            bandwidth_limits_hz=(min(3.0, 0.01 * rate), most),
        )
        for order in kalman_smoother.ORDERS
    }
    fits = {k: found for k, found in fits.items() if np.isfinite(found[1])}
    if not fits:
        raise refusal("not_followed", f"encoders.{axis}", axis=axis)
    order = max(fits, key=lambda k: fits[k][1])
    best, _ = fits[order]
    least = min(config.minimum_bandwidth_hz, most)
    kalman = config.method in ("auto", "kalman")
    found = best.bandwidth_hz
    cutoff = config.cutoff_hz or float(np.clip(found, least, most))
    if cutoff >= 0.5 * rate:
        raise refusal("cutoff_too_high", cutoff=cutoff, rate=rate)
    if config.cutoff_hz:
        why = "set by the user"
    elif found < least:
        why = f"the data suggest {found:.1f} Hz; limited to the minimum bandwidth"
    elif found > most:
        why = f"the data suggest {found:.1f} Hz; limited to a fifth of the sampling rate"
    else:
        why = "maximum likelihood of the encoder samples"
    report: dict[str, Any] = {
        "bandwidth_hz": cutoff,
        "bandwidth_reason": why,
        "order": order if kalman else None,
        "measurement_noise_sd": best.noise_sd,
        "resolution": resolution,
        "log_likelihood": {str(k): likely for k, (_, likely) in fits.items()},
    }
    return AxisFilter(cutoff, best.noise_sd, order if kalman else 0), report


def _outruns(position: Array, noise_sd: float) -> bool:
    """Whether the differences of an axis' samples (T,) look random.

    No filter follows such motion at this rate; a likelihood would take it for noise.
    """
    shown = white_noise_sd(position)
    steps = float(np.sqrt(np.mean(np.diff(position) ** 2)))
    return shown > max(_NO_NOISE * noise_sd, _UNFOLLOWED * steps)


def _differentiate(
    trial_id: str, frame: pd.DataFrame, kinematics: Kinematics
) -> tuple[pd.DataFrame, dict[str, Array]]:
    """Return the rows of one trial and, by axis, the median of each of its error bands, (3,)."""
    grid = uniform_grid(frame["t"].to_numpy(dtype=np.float64), kinematics.rate_hz)
    columns: dict[str, object] = {"trial_id": trial_id, "t": grid.t}
    columns["stamp_offset"] = grid.stamp_offset
    motions = {
        axis: kinematics.differentiate(
            axis, grid.resample(frame[f"q_{axis}"].to_numpy(dtype=np.float64)), ~grid.bridged
        )
        for axis in kinematics.axes
    }
    columns |= {f"q_{axis}": motion.position for axis, motion in motions.items()}
    columns |= {f"qd_{axis}": motion.velocity for axis, motion in motions.items()}
    columns |= {f"qdd_{axis}": motion.acceleration for axis, motion in motions.items()}
    # Forces and other input channels, and their band-limited time derivatives.
    names = [n for n in map(str, frame.columns[2:]) if not n.startswith(("q_", "brake_"))]
    inputs = {n: grid.resample(frame[n].to_numpy(dtype=np.float64), jumps=True) for n in names}
    columns |= inputs
    for name, values in inputs.items():
        columns |= zip(input_derivatives(name), kinematics.input_rates(values), strict=True)
    for name in (str(name) for name in frame.columns if str(name).startswith("brake_")):
        columns[name] = grid.hold(frame[name].to_numpy(dtype=np.float64))
    medians = {}
    for axis, motion in motions.items():
        sds = (motion.position_sd, motion.velocity_sd, motion.acceleration_sd)
        columns |= zip((f"{rate}_sd_{axis}" for rate in ("q", "qd", "qdd")), sds, strict=True)
        medians[axis] = np.median(sds, axis=1)
    columns["bridged"] = grid.bridged
    return pd.DataFrame(columns), medians
