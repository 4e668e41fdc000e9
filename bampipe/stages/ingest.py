"""Ingest: from the raw logs of a session to sound trials in SI units.

Trials are read, checked, repaired where that is safe, and written one at a time. A trial that
cannot be trusted is set aside with a reason (file, row, column), and the others go on.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import pyarrow as pa
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.device_file import find_robot_file, read_device_file
from bampipe.data.quality import CleaningLimits, CleanTrial, clean
from bampipe.data.readers import read_trial
from bampipe.data.run_folder import INGESTED, MOVING, RunFolder
from bampipe.data.session import SECONDS, Session, TrialEntry, inside, read_session
from bampipe.data.store import ParquetAppender, write_parquet
from bampipe.errors import InputError, did_you_mean
from bampipe.estimate.spectral_lines import remove_mains
from bampipe.files import digest_content, digest_file, toml_text
from bampipe.physics import registry
from bampipe.physics.device import Device
from bampipe.physics.units import parse_unit
from bampipe.progress import Progress
from bampipe.results.ingest import (
    EncoderChannel,
    ForceChannels,
    IngestResult,
    MainsHum,
    RecordedChannel,
)
from bampipe.schema import STRICT
from bampipe.trials.sensors import (
    RecordNoise,
    looks_like_counts,
    settle_encoder,
    settle_force,
)

SUMMARY = "Read a session's raw logs, check and repair the trials, bring them to SI units"
INPUTS: tuple[str, ...] = ()
OUTPUTS = (*INGESTED, "ingest/device*.toml", "ingest/robot*.xml")

RATE_TOLERANCE = 0.02
"""The announced sample rate is used where the time stamps agree with it this well."""
_MOST_MEASURED = 100
"""Moving trials whose noise is measured, spread over a longer session: it is their median."""


@checked_dataclass(frozen=True, config=STRICT)
class Config(CleaningLimits):
    """Settings of the stage, beside the limits of a sound trial.

    Attributes:
        session: folder of the session.
        largest_trial_mb: a trial that takes more memory than this, MB, is set aside.
    """

    session: str = ""
    largest_trial_mb: Annotated[int, Field(ge=1)] = 4096


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Write the sound trials of a session and what became of each.

    Raises:
        InputError: a mistake in the session file, or no trial is sound.
    """
    if not config.session:
        raise InputError("no session folder given", remedy="bampipe ingest SESSION")
    session = read_session(Path(config.session))
    device = _device(session)
    _match(session, device)
    if device.drive:
        # A command to a motor, unlike a sensor, may rest or stand at its limit for long.
        config = replace(config, frozen_share=1.0, saturated_share=1.0)
    (out / "ingest").mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    reasons = _refused(session)
    noise: dict[str, list[RecordNoise]] = defaultdict(list)
    hum: dict[str, list[dict[float, float]]] = defaultdict(list)
    units = _force_units(session, device)
    counts: dict[str, list[tuple[float, float] | None]] = defaultdict(list)
    total, measured = len(session.trials), 0
    with ParquetAppender(out / "ingest/samples.parquet") as samples:
        for number, entry in enumerate(session.trials):
            progress(number / total, entry.trial_id)
            try:
                trial = _trial(session, entry, config, reasons[number])
            except InputError as error:
                rows.append(_row(entry, None, str(error)))
                continue
            for name, unit in units.items():
                counts[name].append(_counts(trial.columns[name] / unit))
            _remove_hum(hum, trial)
            rows.append(_row(entry, trial, ""))
            _append(samples, entry, trial)
            if entry.kind in MOVING and measured <= number * _MOST_MEASURED / total:
                _measure_noise(noise, trial)
                measured += 1
        if all(row["status"] == "set_aside" for row in rows):
            first, *others = _reasons(rows, str(session.root))
            raise InputError(
                f"none of the {total} trials is sound; {first.what}",
                where=first.where,
                others=others,
            )
    trials = _trials_table(rows)
    write_parquet(out / "ingest/trials.parquet", trials)
    rate = _rate(session, trials)
    description = _description(session, device, rate, noise, hum, counts)
    description.write(out)
    if session.device_file is not None:
        file = out / "ingest/device.toml"
        if device.robot is None:
            file.write_bytes(session.device_file.read_bytes())
        else:  # with all that its URDF says: the run folder stands on its own
            file.write_text(toml_text(device.declaration), encoding="utf-8")
            drawing = find_robot_file(session.device_file)
            if drawing is not None:  # an export gives it back
                (out / "ingest/robot.xml").write_bytes(drawing.read_bytes())
    notes = [*description.sensor_warnings, *(line.sentence for line in description.mains_hum)]
    notes += _impossible(device)
    notes += [f"{place}: its source still says `fill in`" for place in description.placeholders]
    return _summary(session, rows) | {"notes": notes}


def _reasons(rows: list[dict[str, object]], where: str) -> list[InputError]:
    """Return why trials were set aside: each kind of reason once, as of the first it holds for.

    Reasons that differ by numbers alone, such as rows and sizes, are of one kind.
    """
    found: dict[str, list[tuple[str, str]]] = {}
    for row in rows:
        name = str(row["file"])
        reason = str(row["reason"]).removeprefix(f"{name}: ")
        kind = re.sub(r"\d+(\.\d+)?(e[+-]\d+)?", "", reason.replace(name, ""))
        found.setdefault(kind, []).append((name, reason))
    return [
        InputError(f"{name}{f' and {len(more)} more' if more else ''}: {reason}", where=where)
        for (name, reason), *more in found.values()
    ]


def _impossible(device: Device) -> list[str]:
    """What no body can have among the numbers of a robot's drawing."""
    found = device.robot.impossible if device.robot is not None else []
    return [f"no body has what is drawn: {line}" for line in found]


def _device(session: Session) -> Device:
    path = session.device_file
    if path is not None:
        return registry.device_from(read_device_file(path), str(path))
    try:
        return registry.device(session.device)
    except InputError as error:
        raise InputError(
            error.what, where=f"{session.root / 'session.toml'}: device", remedy=error.remedy
        ) from error


def _match(session: Session, device: Device) -> None:
    """Hold the session's channels to the device's axes and inputs.

    Raises:
        InputError: an axis or an input is missing, of another name or of another unit; all of it.
    """
    found = list(_mismatches(session, device))
    if found:
        first, *others = found
        raise InputError(first.what, where=first.where, remedy=first.remedy, others=others)


def _mismatches(session: Session, device: Device) -> Iterator[InputError]:
    where = f"{session.root / 'session.toml'}"
    encoders = {encoder.axis: encoder for encoder in session.encoders}
    axes = {coordinate.name: coordinate.unit for coordinate in device.coordinates}
    for axis in encoders:
        if axis not in axes:
            yield InputError(
                f"device '{device.name}' has no axis '{axis}'{did_you_mean(axis, axes)}",
                where=f"{where}: encoders.{axis}",
                remedy=f"its axes are {', '.join(axes)}",
            )
    for axis, unit in axes.items():
        if axis not in encoders:
            yield InputError(
                f"no encoder for axis '{axis}' of device '{device.name}'",
                where=f"{where}: encoders",
            )
        elif encoders[axis].unit != unit:
            yield InputError(
                f"a unit of {encoders[axis].unit}, but device '{device.name}' has this axis"
                f" in {unit}",
                where=f"{where}: encoders.{axis}.unit",
            )
    given = {channel.name for channel in session.channels}
    given |= set(session.force.names) if session.force else set()
    for name in (*device.forces, *device.channels):
        if name not in given:
            yield InputError(
                f"no channel for input '{name}' of device '{device.name}'",
                where=f"{where}: force",
                remedy=f"these are given: {', '.join(sorted(given)) or 'none'}",
            )
    wanted = {**dict.fromkeys(device.forces, device.force_unit), **device.channels}
    wanted |= device.controller.channels if device.controller else {}
    for channel in session.channels:
        expected = wanted.get(channel.name, channel.unit)
        if device.robot is not None and (channel.unit, expected) == ("N", "N.m"):
            continue  # the drive of a joint that slides: its force, along the joint
        if not _alike(channel.unit, expected):
            yield InputError(
                f"a unit of {channel.unit or 'a pure number'}, but device '{device.name}' takes"
                f" {expected or 'a pure number'}",
                where=f"{where}: channels.{channel.name}.unit",
            )
    if session.force and not session.force.volts and session.force.unit != device.force_unit:
        yield InputError(
            f"found \"{session.force.unit}\", but device '{device.name}' takes {device.force_unit}",
            where=f"{where}: force.unit",
        )


def _alike(one: str, other: str) -> bool:
    """Whether two units have the same dimension, as far as they can be read."""
    if one == other:
        return True
    try:
        return parse_unit(one, "") == parse_unit(other, "")
    except InputError:
        return False


def _refused(session: Session) -> list[str]:
    """Why each trial is refused before it is read: the same file or content as another, or ''."""
    same: dict[str, list[int]] = defaultdict(list)
    for number, entry in enumerate(session.trials):
        try:
            path = inside(session.root, entry.file, where="")
        except InputError:
            continue  # said when the trial's turn comes
        if path.stat().st_size > 0:
            same[digest_file(path)].append(number)
    reasons = [""] * len(session.trials)
    for alike_files in same.values():
        numbers = [
            n
            for n in alike_files
            if any(session.trials[n].overlaps(session.trials[m]) for m in alike_files if m != n)
        ]
        entries = [session.trials[number] for number in numbers]
        alike = len({(entry.kind, entry.locked_axis, entry.viscous) for entry in entries}) == 1
        for number in numbers[1:] if alike else numbers if len(numbers) > 1 else []:
            entry = session.trials[number]
            other = next(e for e in entries if e is not entry)
            what = "file" if other.file == entry.file else "content"
            reasons[number] = f"the same {what} as trial {other.trial_id}" + (
                ": used once" if alike else f", which is declared {other.kind}"
            )
    return reasons


def _trial(session: Session, entry: TrialEntry, config: Config, reason: str) -> CleanTrial:
    """One sound trial in SI units.

    Raises:
        InputError: the trial is to be set aside, with the reason.
    """
    if reason:
        raise InputError(reason, where=entry.file)
    path = inside(session.root, entry.file, where=entry.file)
    clock = session.clock
    raw = read_trial(
        path,
        session.columns,
        name=entry.file,
        largest_bytes=config.largest_trial_mb << 20,
        datetimes={clock.column: clock.format} if clock.datetime else {},
        dialect=session.dialect,
    )
    if clock.nanoseconds:
        columns = dict(raw.columns)
        seconds, nanoseconds = columns[clock.column], columns.pop(clock.nanoseconds)
        # Seconds since 1970 leave no room for nanoseconds in a double: the first goes first.
        columns[clock.column] = seconds - np.fmin.reduce(seconds) + SECONDS["ns"] * nanoseconds
        raw = replace(raw, columns=columns)
    if not clock.column:
        count = len(raw.columns[session.columns[0]])
        note = f"no time stamps: samples counted at {session.sample_rate:g} Hz"
        raw = replace(
            raw,
            columns={clock.column: np.arange(count, dtype=float), **raw.columns},
            remarks=(*raw.remarks, note),
        )
    return clean(raw, session, entry, config)


def _append(samples: ParquetAppender, entry: TrialEntry, trial: CleanTrial) -> None:
    ids = pa.DictionaryArray.from_arrays(
        np.zeros(len(trial.t), dtype=np.int32), pa.array([entry.trial_id])
    )
    samples.append({"trial_id": ids, "t": trial.t, **trial.columns})


def _remove_hum(hum: dict[str, list[dict[float, float]]], trial: CleanTrial) -> None:
    """Take mains hum off the inputs of a trial, and note it; encoders have none."""
    moving = [column for name, column in trial.columns.items() if name.startswith("q_")]
    for name, values in trial.columns.items():
        if not name.startswith(("q_", "brake_")) and np.isfinite(values).all():
            trial.columns[name], found = remove_mains(values, trial.t, moving)
            hum[name].append(found)


def _force_units(session: Session, device: Device) -> dict[str, float]:
    """One raw unit, in SI, of the forces that are logged in a unit in which none counts whole."""
    units: dict[str, float] = {}
    if session.force and not session.force.volts:
        gains = np.diag(np.array(session.force.calibration))
        units |= dict(zip(session.force.names, gains, strict=True))
    units |= {each.name: each.scale for each in session.channels if each.offset == 0.0}
    return {name: unit for name, unit in units.items() if name in device.forces and unit >= 1.0}


def _counts(readings: np.ndarray) -> tuple[float, float] | None:
    """The range of readings that look like counts of a converter; None for others."""
    if not looks_like_counts(readings):
        return None
    return float(readings.min()), float(readings.max())


def _count_warnings(
    session: Session, device: Device, counts: Mapping[str, list[tuple[float, float] | None]]
) -> dict[str, str]:
    """A sentence for each channel that looks like counts in most of its trials."""
    said = {}
    for name, ranges in counts.items():
        found = [each for each in ranges if each is not None]
        if 2 * len(found) <= len(ranges):
            continue
        low, high = min(each[0] for each in found), max(each[1] for each in found)
        in_force = session.force is not None and name in session.force.names
        said[name] = (
            f"{name}: whole numbers from {low:.0f} to {high:.0f} look like counts of a converter,"
            f" not like {device.channels.get(name, device.force_unit)}; if so, "
            + (
                'give [force] unit = "V", calibration_n_per_v with the force of one count, and'
                " zero_v with the reading without load"
                if in_force
                else f"give scale and offset under channels.{name}"
            )
        )
    return said


def _typical_hum(
    hum: Mapping[str, list[dict[float, float]]], device: Device
) -> tuple[MainsHum, ...]:
    """The hum taken off each channel, typical of the trials that had it."""
    return tuple(
        MainsHum(
            channel=name,
            unit=device.channels.get(name, device.force_unit),
            hz=hz,
            amplitude=float(np.median([trial[hz] for trial in trials if hz in trial])),
            trials=sum(hz in trial for trial in trials),
        )
        for name, trials in sorted(hum.items())
        for hz in sorted({hz for trial in trials for hz in trial})
    )


def _measure_noise(noise: dict[str, list[RecordNoise]], trial: CleanTrial) -> None:
    """Note what a trial says of the noise of its encoders (``q_<axis>``) and inputs."""
    columns = {
        name: np.asarray(values, dtype=float)
        for name, values in trial.columns.items()
        if not name.startswith("brake_")
    }
    readings = {name: x for name, x in columns.items() if name.startswith("q_")}
    inputs = {name: x for name, x in columns.items() if name not in readings}
    found = {name: RecordNoise.of(x, trial.t) for name, x in readings.items()}
    found |= RecordNoise.of_inputs(inputs, [*readings.values()], trial.t)
    for name, one in found.items():
        noise[name].append(one)


def _row(entry: TrialEntry, trial: CleanTrial | None, reason: str) -> dict[str, object]:
    status = "set_aside"
    if trial is not None:
        status = "repaired" if trial.repairs else "ok"
    return {
        "trial_id": entry.trial_id,
        "file": entry.file,
        "kind": entry.kind,
        "locked_axis": entry.locked_axis,
        "viscous_n_s_per_m": np.nan if entry.viscous is None else entry.viscous,
        "hold_out": entry.hold_out,
        "n_samples": 0 if trial is None else len(trial.t),
        "duration_s": np.nan if trial is None else float(trial.t[-1]),
        "sample_rate_hz": np.nan if trial is None else trial.sample_rate,
        "status": status,
        "reason": reason,
        "repairs": "" if trial is None else "; ".join([*trial.repairs, *trial.notes]),
    }


def _trials_table(rows: list[dict[str, object]]) -> pd.DataFrame:
    table = pd.DataFrame(rows)
    text = ("trial_id", "file", "kind", "locked_axis", "status", "reason", "repairs")
    return table.astype(dict.fromkeys(text, "string"))


def _rate(session: Session, trials: pd.DataFrame) -> float:
    """Announced sample rate, or the median of the trials where the time stamps say otherwise."""
    measured = float(trials["sample_rate_hz"].median())
    if abs(measured - session.sample_rate) <= RATE_TOLERANCE * session.sample_rate:
        return session.sample_rate
    return measured


def _description(
    session: Session,
    device: Device,
    rate: float,
    noise: Mapping[str, list[RecordNoise]],
    hum: Mapping[str, list[dict[float, float]]],
    counts: Mapping[str, list[tuple[float, float] | None]],
) -> IngestResult:
    """Return what session.json says, the sensors settled."""
    force = session.force
    stated = force.noise_sd if force else None
    encoders = {
        e.axis: settle_encoder(e.axis, e.unit, e.resolution, noise.get(f"q_{e.axis}", []))
        for e in session.encoders
    }
    forces = {
        name: settle_force(name, device.force_unit, stated, noise.get(name, []))
        for name in device.forces
    }
    counted = _count_warnings(session, device, counts)
    own = session.device_file is not None
    return IngestResult(
        session_id=session.session_id,
        device=device.name,
        device_file=session.device if own else None,
        placeholders=tuple(_placeholders(device.declaration)) if own else (),
        device_digest=digest_content(device.declaration) if own else "",
        driven=bool(device.drive),
        default_effects=device.default_effects,
        recorded_at=session.recorded_at,
        operator=session.operator,
        device_serial=session.device_serial,
        notes=session.notes,
        simulated=session.simulated,
        sample_rate_hz=rate,
        announced_rate_hz=session.sample_rate,
        axes={
            encoder.axis: EncoderChannel(
                unit=encoder.unit,
                resolution=encoders[encoder.axis].resolution,
                resolution_stated=encoders[encoder.axis].stated,
                resolution_measured=encoders[encoder.axis].measured,
                noise_sd=encoders[encoder.axis].noise_sd,
                scale=encoder.scale,
                zero=encoder.zero,
                counts_per_unit=encoder.counts_per_unit,
                raw_unit=encoder.stated_unit,
                scale_sd=encoder.scale_sd,
            )
            for encoder in session.encoders
        },
        force=ForceChannels(
            columns=force.names if force else (),
            unit=device.force_unit,
            noise_sd={name: found.noise_sd for name, found in forces.items()},
            noise_sd_stated=stated,
            noise_sd_measured={name: found.measured for name, found in forces.items()},
            calibration=force.calibration if force else (),
            zero=force.zero if force else (),
            raw_unit=force.raw_unit if force else "",
            gain_sd=force.gain_sd if force else 0.0,
            crosstalk_sd=force.crosstalk_sd if force else 0.0,
            look_like_counts=tuple(counted),
        ),
        sensor_warnings=(
            *(each.warning for each in (*encoders.values(), *forces.values()) if each.warning),
            *counted.values(),
        ),
        mains_hum=_typical_hum(hum, device),
        brakes={
            f"brake_{brake.axis}": RecordedChannel(unit=brake.unit) for brake in session.brakes
        },
        channels={
            channel.name: RecordedChannel(
                unit=channel.unit,
                scale=channel.scale,
                offset=channel.offset,
                raw_unit=channel.raw_unit,
                scale_sd=channel.scale_sd,
                second_encoder_of=channel.second_encoder_of,
            )
            for channel in session.channels
        },
    )


def _placeholders(table: object, place: str = "device") -> Iterator[str]:
    """Yield the dotted names of the numbers below ``table`` whose source says ``fill in``."""
    if isinstance(table, Mapping):
        if "value" in table and str(table.get("source", "")).startswith("fill in"):
            yield place
        for name, entry in table.items():
            yield from _placeholders(entry, f"{place}.{name}")


def _summary(session: Session, rows: list[dict[str, object]]) -> dict[str, object]:
    names = ("ok", "repaired", "set_aside")
    counts = {name: sum(row["status"] == name for row in rows) for name in names}
    parts = [f"{counts['ok']} sound"]
    parts += [f"{counts['repaired']} repaired"] if counts["repaired"] else []
    parts += [f"{counts['set_aside']} set aside"] if counts["set_aside"] else []
    return {
        "session_id": session.session_id,
        "trials": counts,
        "headline": f"{len(rows)} trials: {', '.join(parts)}",
        "set_aside": [
            {"trial_id": row["trial_id"], "reason": row["reason"]}
            for row in rows
            if row["status"] == "set_aside"
        ],
        "repaired": [
            {"trial_id": row["trial_id"], "repairs": row["repairs"]}
            for row in rows
            if row["repairs"]
        ],
    }
