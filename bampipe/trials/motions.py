"""Moving trials of a run folder as arrays, and a model's residual on them."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bampipe.data.run_folder import MOVING, RunFolder
from bampipe.data.store import read_parquet, trial_ids
from bampipe.errors import InputError
from bampipe.estimate.least_squares import Problem
from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import resting
from bampipe.physics import System
from bampipe.physics.device import derivative
from bampipe.physics.soundness import require_sound
from bampipe.trials.trial_cache import Shelf

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """One trial with its derivatives, on a uniform grid.

    Attributes:
        trial_id: its name.
        t: (T,) s since the start of the trial.
        q, qd, qdd: (T, n_q) rad or m and derivatives; qd_sd: (T, n_q).
        u: (T, n_u) inputs of the model; u_rate: (T, n_u) their rates, zero where not stored.
    """

    trial_id: str
    t: Array
    q: Array
    qd: Array
    qdd: Array
    qd_sd: Array
    u: Array
    u_rate: Array


def held_out_trials(run: RunFolder) -> frozenset[str]:
    """Return the trials that the session holds out: never fitted, only for judging."""
    trials = read_parquet(run.require("ingest/trials.parquet", "ingest"))
    if "hold_out" not in trials:
        return frozenset()
    return frozenset(trials.loc[trials["hold_out"].astype(bool), "trial_id"].astype(str))


def free_trials(run: RunFolder, *, fitted: bool = False, braked: bool = False) -> tuple[str, ...]:
    """Return the free trials that were differentiated, in the order of the session.

    Args:
        run: the run folder.
        fitted: without those that the session holds out.
        braked: those in a viscous field too, after the others: a lag of the brakes, say, shows
            in no other.

    Raises:
        InputError: there is none.
    """
    trials = read_parquet(run.require("ingest/trials.parquet", "ingest"))
    kinds = MOVING if braked else MOVING[:1]
    usable = trials[trials["kind"].isin(kinds) & (trials["status"] != "set_aside")]
    usable = usable.sort_values("kind", key=lambda kind: kind != MOVING[0], kind="stable")
    if fitted:
        usable = usable[~usable["trial_id"].isin(held_out_trials(run))]
    path = run.require("filter/kinematics.parquet", "filter")
    moving = trial_ids(path)
    found = tuple(str(name) for name in usable["trial_id"] if str(name) in moving)
    if not set(found) & set(trials.loc[trials["kind"] == MOVING[0], "trial_id"].astype(str)):
        raise InputError(
            "no free trial to identify from",
            where=str(run.root),
            remedy="look at ingest/trials.parquet for the reasons",
        )
    return found


def read_motion(run: RunFolder, trial_id: str, system: System) -> Motion:
    """Read one trial of ``filter/kinematics.parquet``.

    Raises:
        InputError: the file or a column that the model needs is missing.
    """
    path = run.require("filter/kinematics.parquet", "filter")
    frame = read_parquet(path, trial=trial_id)
    axes = system.coordinates
    t = frame["t"].to_numpy(dtype=float)
    return Motion(
        trial_id=trial_id,
        t=t - t[0],
        q=_columns(frame, [f"q_{axis}" for axis in axes], str(path)),
        qd=_columns(frame, [f"qd_{axis}" for axis in axes], str(path)),
        qdd=_columns(frame, [f"qdd_{axis}" for axis in axes], str(path)),
        qd_sd=_columns(frame, [f"qd_sd_{axis}" for axis in axes], str(path)),
        u=input_columns(frame, system.inputs, system.model.device.brakes, t, str(path)),
        u_rate=_rates(frame, system.inputs),
    )


def read_motions(
    run: RunFolder, system: System, *, fitted: bool = False, braked: bool = False
) -> Sequence[Motion]:
    """Return the free trials, each read from ``filter/kinematics.parquet`` when it is wanted.

    Args:
        run: the run folder.
        system: the model, whose inputs are read.
        fitted, braked: as in :func:`free_trials`.

    Raises:
        InputError: there is none; on reading one, as :func:`read_motion`.
    """
    names = free_trials(run, fitted=fitted, braked=braked)
    return Shelf(lambda place: read_motion(run, names[place], system), len(names), n_samples)


def put_aside(motions: Iterable[Motion]) -> Sequence[Motion]:
    """Return trials that cannot be read again, from a folder that lasts as long as they do.

    What comes back is bit by bit the same, and takes the memory of a few trials only.
    """
    folder = Path(tempfile.mkdtemp(prefix="bampipe-trials-"))
    count = 0
    try:
        for count, motion in enumerate(motions, start=1):
            np.savez(folder / f"{count - 1}.npz", **vars(motion))
    except BaseException:
        shutil.rmtree(folder)
        raise
    shelf = Shelf(lambda place: _put_back(folder / f"{place}.npz"), count, n_samples)
    weakref.finalize(shelf, shutil.rmtree, folder)
    return shelf


def _put_back(path: Path) -> Motion:
    with np.load(path) as kept:
        arrays = {name: kept[name] for name in kept.files if name != "trial_id"}
        return Motion(trial_id=str(kept["trial_id"]), **arrays)


def n_samples(motion: Motion) -> int:
    """Return the number of samples of a trial."""
    return int(motion.t.size)


def input_columns(
    frame: pd.DataFrame,
    names: Sequence[str],
    brakes: Mapping[str, str],
    t: Array,
    where: str,
) -> Array:
    """Return the model's inputs as columns (T, n_u).

    Args:
        frame: columns force_<c>, force_rate_<c>, ..., brake_<axis>; a brake without a column
            was off.
        names: inputs of the model.
        brakes: input that is the brake command, by axis.
        t: (T,) time, s.
        where: file, for messages.

    Raises:
        InputError: an input has no column.
    """
    column = {name: f"brake_{axis}" for axis, name in brakes.items()}
    values = np.empty((len(frame), len(names)))
    for place, name in enumerate(names):
        if name == "t":
            values[:, place] = t - t[0]
            continue
        if name in column and column[name] not in frame:
            values[:, place] = 0.0
            continue
        values[:, place] = _columns(frame, [column.get(name, name)], where)[:, 0]
    return values


def problem_of(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    held: Sequence[str] = (),
    timing: bool = True,
) -> Problem:
    """Return the inverse dynamics of ``motions`` as a least-squares problem.

    Its parameters are the model's, then the time by which the inputs were sampled after the
    positions, s, within half a sample.

    Args:
        system: the model; motions: the trials; band: the low-pass of the residual.
        held: parameters that are not estimated, beside those that the model fixes.
        timing: whether that time is estimated; else it is zero.

    Raises:
        InputError: the mass matrix is singular at a pose of a trial, or a force no number there.
    """
    n = len(system.parameters)

    def residual(trial: int, p: Array) -> Array:
        motion = motions[trial]
        u = motion.u - p[n] * motion.u_rate
        z = system.memory(motion.q, motion.qd, motion.qdd, u, p[:n], motion.t)
        q, qd, qdd = system.true_motion(motion.q, motion.qd, motion.qdd, u, p[:n])
        return system.residual(q, qd, qdd, z, u, p[:n])

    free = [
        i for i, item in enumerate(system.parameters) if not item.fixed and item.name not in held
    ]
    half = 0.5 / band.rate_hz if timing else 0.0
    lower = [system.parameters[i].lower for i in free]
    upper = [system.parameters[i].upper for i in free]
    step = [system.parameters[i].sd * (1.0 if system.linear[i] else 1e-4) or 1.0 for i in free]
    return Problem(
        residual=residual,
        n_trials=len(motions),
        free=np.array([*free, n], dtype=np.int64),
        lower=np.array([*lower, -half]),
        upper=np.array([*upper, half]),
        step=np.array([*step, 0.5 / band.rate_hz]),
        linear=all(system.linear[i] for i in free),
        band=band,
        resting=[_resting(m, system, band) for m in motions],
    )


def _resting(motion: Motion, system: System, band: Band) -> Array:
    """Which samples stand still, of a trial on which the equations of motion can be solved."""
    require_sound(
        system, motion.q, motion.qd, motion.qdd, motion.u, system.prior, motion.t,
        f"trial {motion.trial_id}",
    )  # fmt: skip
    places = [system.model.device.brakes.get(axis) for axis in system.coordinates]
    braked = [
        name in system.inputs and bool(motion.u[:, system.inputs.index(name)].any())
        for name in places
    ]
    return resting(motion.qd, motion.qd_sd, band.rate_hz, np.array(braked))


def _columns(frame: pd.DataFrame, names: Sequence[str], where: str) -> Array:
    for name in names:
        if name not in frame:
            raise InputError(
                f"no column {name!r}, which the model needs",
                where=where,
                remedy="name the channel in session.toml if it was logged; if not, the effect that "
                "uses it cannot be weighed with this session",
            )
    return frame[list(names)].to_numpy(dtype=float, copy=True)  # one column alone is read-only


def _rates(frame: pd.DataFrame, names: Sequence[str]) -> Array:
    rates = np.zeros((len(frame), len(names)))
    for place, name in enumerate(names):
        column = derivative(name, 1)
        if column in frame:
            rates[:, place] = frame[column]
    return rates
