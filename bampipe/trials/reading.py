"""Reads the trials of a run folder as motions, and their sensors, filters and band."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bampipe.arrays import Array
from bampipe.data.run_folder import MOVING, RunFolder
from bampipe.data.store import column_names, read_arrays, read_parquet, trial_ids
from bampipe.errors import InputError
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.results.filter import Disturbance, FilterResult
from bampipe.results.ingest import IngestResult
from bampipe.trials.kept import MOST_OF_TRIALS, KeptItems
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.motion import STAMP_OFFSET, TIMING_ORDERS, Motion, input_derivatives
from bampipe.trials.sensors import Sensors

KINEMATICS = "filter/kinematics.parquet"


def read_sensors(run: RunFolder, system: System) -> Sensors:
    """Return the sensors that `ingest` determined, axes and forces in the order of the model."""
    return Sensors.from_result(
        run.read(IngestResult), system.coordinates, system.model.device.forces
    )


def read_kinematics(run: RunFolder, system: System) -> Kinematics:
    """Return the filters of the session, axes in the order of the model."""
    return Kinematics.from_result(run.read(FilterResult), system.coordinates)


def read_band(run: RunFolder, system: System) -> Band:
    """Return the band in which residuals are compared, axes in the order of the model."""
    found = run.read(FilterResult)
    cutoffs = tuple(found.axes[axis].band.cutoff_hz for axis in system.coordinates)
    return Band(found.sample_rate_hz, cutoffs)


def held_out_trials(run: RunFolder) -> frozenset[str]:
    """Return the trials that the session holds out: never fitted, used only for validation."""
    trials = read_parquet(run.require("ingest/trials.parquet", "ingest"))
    if "hold_out" not in trials:
        return frozenset()
    return frozenset(trials.loc[trials["hold_out"].astype(bool), "trial_id"].astype(str))


def free_trials(run: RunFolder, *, fitted: bool = False, braked: bool = False) -> tuple[str, ...]:
    """Return the free trials that were differentiated, in the order of the session.

    With ``fitted``, held-out trials are left out; with ``braked``, those in a viscous field follow,
    which alone show effects of the brakes. If there is none, `InputError` is raised.
    """
    trials = read_parquet(run.require("ingest/trials.parquet", "ingest"))
    kinds = MOVING if braked else MOVING[:1]
    usable = trials[trials["kind"].isin(kinds) & (trials["status"] != "set_aside")]
    usable = usable.sort_values("kind", key=lambda kind: kind != MOVING[0], kind="stable")
    if fitted:
        usable = usable[~usable["trial_id"].isin(held_out_trials(run))]
    moving = trial_ids(run.require(KINEMATICS, "filter"))
    found = tuple(str(name) for name in usable["trial_id"] if str(name) in moving)
    if not set(found) & set(trials.loc[trials["kind"] == MOVING[0], "trial_id"].astype(str)):
        raise InputError(
            "no free trial to identify from",
            where=str(run.root),
            remedy="look at ingest/trials.parquet for the reasons",
        )
    return found


def read_motion(
    path: Path,
    trial_id: str,
    system: System,
    disturbances: Sequence[Disturbance] = (),
    filters: Kinematics | None = None,
    *,
    every_input: bool = False,
) -> Motion:
    """Read one trial of a table of kinematics.

    The model's inputs are read with their first time derivatives; with ``every_input``, all inputs
    of the device are, with all derivatives, since effects that are not in the model may need them.
    Disturbances do not count; ``filters`` are those of the session.

    Raises:
        InputError: the file or a column that the model needs is missing.
    """
    axes, device = system.coordinates, system.model.device
    stored = frozenset(column_names(path))
    brakes = {name: f"brake_{axis}" for axis, name in device.brakes.items()}
    needed = [name for name in system.inputs if name != "t"]
    wanted = list(needed)
    smooth = (*device.forces, *device.channels)
    if every_input:
        needed += [name for name in (*smooth, *brakes) if name not in needed]
        wanted = [*needed, *(rate for name in smooth for rate in input_derivatives(name))]
    else:
        for name in [name for name in needed if name in smooth]:
            wanted += input_derivatives(name)[:TIMING_ORDERS]
    column_of = {name: brakes.get(name, name) for name in dict.fromkeys((*wanted, STAMP_OFFSET))}
    motion = {key: [f"{key}_{axis}" for axis in axes] for key in ("q", "qd", "qdd", "qd_sd")}
    required = [column for columns in motion.values() for column in columns]
    required += [column_of[name] for name in needed if name not in brakes]
    for column in required:
        if column not in stored:
            raise _no_column(column, str(path))
    read = dict.fromkeys(["t", *required, *(c for c in column_of.values() if c in stored)])
    columns = read_arrays(path, list(read), trial_id)
    t = columns["t"]
    channels = {
        name: columns[column] if column in stored else np.zeros(t.size)
        for name, column in column_of.items()
        if column in stored or name in brakes  # a brake without a logged command was off
    }
    kinematics: dict[str, Any] = {
        kind: np.stack([columns[name] for name in names]).T for kind, names in motion.items()
    }
    t = t - t[0]
    left_out = None
    if disturbances:
        inside = np.any([(t >= one.start_s) & (t <= one.end_s) for one in disturbances], axis=0)
        left_out = np.tile(inside[:, None], (1, len(axes)))
    return Motion(trial_id, t, **kinematics, channels=channels, left_out=left_out, filters=filters)


def read_motions(
    run: RunFolder,
    system: System,
    *,
    fitted: bool = False,
    braked: bool = False,
    every_input: bool = False,
    late_s: float = 0.0,
) -> Sequence[Motion]:
    """Return the free trials of ``filter/kinematics.parquet``, with a delay of inputs compensated.

    Arguments and errors are those of :func:`free_trials` and :func:`read_motion`; the inputs were
    sampled ``late_s`` after the positions, s.
    """
    names = free_trials(run, fitted=fitted, braked=braked)
    path = run.require(KINEMATICS, "filter")
    disturbances, filters = run.read(FilterResult).disturbances, read_kinematics(run, system)

    read = (
        read_motion(path, k, system, disturbances.get(k, ()), filters, every_input=every_input)
        for k in names
    )
    return KeptItems((motion.with_input_timing(late_s) for motion in read), MOST_OF_TRIALS)


def read_samples(run: RunFolder, trial_id: str, system: System) -> dict[str, Array]:
    """Return raw samples of one trial, each (T,): ``t``, ``q_<axis>``, and the inputs as logged.

    Raises:
        InputError: the file or the trial is missing.
    """
    path = run.require("ingest/samples.parquet", "ingest")
    stored = frozenset(column_names(path))
    brakes = {name: f"brake_{axis}" for axis, name in system.model.device.brakes.items()}
    inputs = [brakes.get(name, name) for name in system.inputs]
    wanted = ["t", *(f"q_{axis}" for axis in system.coordinates)]
    wanted += [name for name in inputs if name in stored]
    return read_arrays(path, list(dict.fromkeys(wanted)), trial_id)


def input_columns(
    columns: Mapping[str, Array], names: Sequence[str], brakes: Mapping[str, str]
) -> Array:
    """Return inputs of a model by their ``names``, (T, n_u), from raw samples; gaps are bridged.

    ``columns`` are t, force_<c>, brake_<axis>, ...; a brake without a column was off. ``brakes``
    has the name of each axis' brake command. An input without a column raises `InputError`.
    """
    column = {name: f"brake_{axis}" for axis, name in brakes.items()}
    t = columns["t"]
    values = np.zeros((t.size, len(names)))
    for number, name in enumerate(names):
        logged = column.get(name, name)
        if name == "t":
            values[:, number] = t - t[0]
        elif logged in columns:
            values[:, number] = columns[logged]
        elif name not in column:
            raise _no_column(name, "ingest/samples.parquet")
    for row in values.T:
        if (lost := np.isnan(row)).any():
            row[lost] = np.interp(t[lost], t[~lost], row[~lost])
    return values


def _no_column(name: str, where: str) -> InputError:
    return InputError(
        f"no column {name!r}, which the model needs",
        where=where,
        remedy="name the channel in session.toml if it was logged; if not, the effect that "
        "uses it cannot be weighed with this session",
    )
