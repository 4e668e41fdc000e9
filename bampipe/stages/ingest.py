"""Ingest: from the raw logs of a session to sound trials in SI units.

Trials are read, checked, repaired where that is safe, and written one at a time. A trial that
cannot be trusted is set aside with a reason (file, row, column), and the others go on.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import pyarrow as pa
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.device_file import find_robot_file
from bampipe.data.quality import CleaningLimits, CleanTrial, thin, thinning_factor
from bampipe.data.recording import describe_spans, find_copies, read_sound_trial
from bampipe.data.run_folder import INGESTED, MOVING, RunFolder
from bampipe.data.session import Session, TrialEntry, read_session
from bampipe.data.store import ParquetAppender, write_parquet
from bampipe.declarations.session_device import placeholders, session_device
from bampipe.errors import InputError
from bampipe.files import toml_text
from bampipe.lists import count_noun
from bampipe.phrases import results as phrases
from bampipe.physics.device import Device
from bampipe.progress import Progress
from bampipe.results.ingest import EncoderChannel, ForceChannels, IngestResult, RecordedChannel
from bampipe.schema import STRICT, NotNegative
from bampipe.trials.channel_records import ChannelRecords

SUMMARY = "Read a session's raw logs, check and repair the trials, bring them to SI units"
INPUTS: tuple[str, ...] = ()
OUTPUTS = (*INGESTED, "ingest/device*.toml", "ingest/robot*.xml")

RATE_TOLERANCE = 0.02
"""The announced sample rate is used if the time stamps agree with it this well."""
_MOST_MEASURED = 100
"""Moving trials whose noise is measured, spread over a longer session: it is their median."""


@checked_dataclass(frozen=True, config=STRICT)
class Config(CleaningLimits):
    """Settings of the stage, beside the limits of a sound trial.

    Attributes:
        session: folder of the session.
        largest_trial_mb: a trial that takes more memory than this, MB, is set aside.
        fastest_hz: logs at twice this rate or more are thinned to about it; 0 keeps every sample.
    """

    session: str = ""
    largest_trial_mb: Annotated[int, Field(ge=1)] = 4096
    fastest_hz: NotNegative = 1000.0


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Write the sound trials of a session, and the status of every trial."""
    if not config.session:
        raise InputError("no session folder given", remedy="bampipe ingest SESSION")
    session = read_session(Path(config.session))
    device = session_device(session)
    if device.drive:
        # A command to a motor may be constant or at its limit for long, and motors hold axes.
        config = replace(config, frozen_share=1.0, saturated_share=1.0, held_axes=True)
    (out / "ingest").mkdir(parents=True, exist_ok=True)
    channels = ChannelRecords(session, device)
    every = thinning_factor(session.sample_rate, config.fastest_hz)
    with ParquetAppender(out / "ingest/samples.parquet") as samples:
        rows = _ingest_trials(session, config, every, channels, samples, progress)
    text = ("trial_id", "file", "kind", "locked_axis", "status", "reason", "repairs")
    trials = pd.DataFrame(rows).drop(columns=["dead", "spans", "stated"])
    trials = trials.astype(dict.fromkeys(text, "string"))
    write_parquet(out / "ingest/trials.parquet", trials)
    # The announced rate, or the median of the trials if the time stamps disagree.
    rate, measured = session.sample_rate / every, float(trials["sample_rate_hz"].median())
    if abs(measured - rate) > RATE_TOLERANCE * rate:
        rate = measured
    description = _description(session, device, rate, every, channels, rows)
    description.write(out)
    if session.device_file is not None:
        _write_device(session.device_file, device, out / "ingest")
    spans = {row["trial_id"]: row["spans"] for row in rows if row["spans"]}
    replaced = "physically impossible body replaced by the nearest possible one"
    notes = [
        *describe_spans(spans),
        *description.sensor_warnings,
        *map(phrases.describe_hum, description.mains_hum),
        *(f"{replaced}: {one}" for one in (device.robot.impossible if device.robot else ())),
        *map(phrases.describe_placeholder, description.placeholders),
    ]
    if every > 1:
        notes.append(
            f"logged at {session.sample_rate:g} Hz, thinned to {rate:g} Hz: inputs after a low-pass"
            " at half of that, positions as read; ingest.fastest_hz=0 keeps every sample"
        )
    return _summary(session, rows) | {"notes": notes}


def _ingest_trials(
    session: Session,
    config: Config,
    every: int,
    channels: ChannelRecords,
    samples: ParquetAppender,
    progress: Progress,
) -> list[dict[str, Any]]:
    """Write the samples of the sound trials and return the status of each trial."""
    rows: list[dict[str, Any]] = []
    copies = find_copies(session)
    encoders = {each.name for each in session.channels if each.second_encoder_of}
    total, measured = len(session.trials), 0
    for number, entry in enumerate(session.trials):
        progress(number / total, entry.name)
        try:
            if entry.name in copies:
                raise InputError(copies[entry.name], where=entry.file)
            trial = read_sound_trial(session, entry, config, config.largest_trial_mb << 20)
        except InputError as error:
            rows.append(_row(entry, None, str(error)))
            continue
        noise = entry.kind in MOVING and measured <= number * _MOST_MEASURED / total
        measured += noise
        channels.note_trial(trial)
        trial = thin(trial, every, encoders)
        if noise:
            channels.measure_noise(trial)
        rows.append(_row(entry, trial, ""))
        ids = pa.DictionaryArray.from_arrays(
            np.zeros(len(trial.t), dtype=np.int32), pa.array([entry.name])
        )
        samples.append({"trial_id": ids, "t": trial.t, **trial.columns})
    if all(row["status"] == "set_aside" for row in rows):
        first, *others = _reasons(rows, str(session.root))
        raise InputError(
            f"none of the {total} trials is sound; {first.what}", where=first.where, others=others
        )
    return rows


def _write_device(file: Path, device: Device, out: Path) -> None:
    """Keep the session's own device file with the content of its URDF: a run is self-contained."""
    path = out / "device.toml"
    if device.robot is None:
        path.write_bytes(file.read_bytes())
        return
    path.write_text(toml_text(device.declaration), encoding="utf-8")
    drawing = find_robot_file(file)
    if drawing is not None:  # an export gives it back
        (out / "robot.xml").write_bytes(drawing.read_bytes())


def _reasons(rows: list[dict[str, Any]], where: str) -> list[InputError]:
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


def _row(entry: TrialEntry, trial: CleanTrial | None, reason: str) -> dict[str, Any]:
    status = "set_aside"
    if trial is not None:
        status = "repaired" if trial.repairs else "ok"
    return {
        "trial_id": entry.name,
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
        "dead": () if trial is None else tuple(trial.dead),
        "stated": () if trial is None else trial.stated,
        "spans": {
            name.removeprefix("q_"): float(np.ptp(values))
            for name, values in (trial.columns.items() if trial and entry.kind in MOVING else ())
            if name.startswith("q_")
        },
    }


def _description(
    session: Session,
    device: Device,
    rate: float,
    every: int,
    channels: ChannelRecords,
    rows: list[dict[str, Any]],
) -> IngestResult:
    """Return the content of session.json, with sensors as used."""
    force = session.force
    encoders, forces = channels.encoders(), channels.forces()
    counted = channels.count_warnings()
    own = session.device_file is not None
    return IngestResult.of(
        session,
        device=device.name,
        device_file=session.device if own else None,
        placeholders=tuple(placeholders(device.declaration)) if own else (),
        driven=bool(device.drive),
        default_effects=device.default_effects,
        sample_rate_hz=rate,
        announced_rate_hz=session.sample_rate,
        kept_every=every,
        axes={
            encoder.name: EncoderChannel.of(
                encoders[encoder.name],
                encoder,
                resolution_stated=encoders[encoder.name].stated,
                resolution_measured=encoders[encoder.name].measured,
                raw_unit=encoder.stated_unit,
                unit_in_log=any(encoder.column in row["stated"] for row in rows),
            )
            for encoder in session.encoders
        },
        force=ForceChannels.of(
            force,
            columns=force.names if force else (),
            unit=device.force_unit,
            noise_sd={name: found.noise_sd for name, found in forces.items()},
            noise_sd_stated=force.noise_sd if force else None,
            noise_sd_measured={name: found.measured for name, found in forces.items()},
            look_like_counts=tuple(counted),
        ),
        sensor_warnings=(
            *(each.warning for each in (*encoders.values(), *forces.values()) if each.warning),
            *counted.values(),
        ),
        mains_hum=channels.mains_hum(),
        brakes={
            f"brake_{brake.axis}": RecordedChannel(unit=brake.unit) for brake in session.brakes
        },
        channels={channel.name: RecordedChannel.of(channel) for channel in session.channels},
        dead={row["trial_id"]: row["dead"] for row in rows if row["dead"]},
    )


def _summary(session: Session, rows: list[dict[str, Any]]) -> dict[str, object]:
    names = ("ok", "repaired", "set_aside")
    counts = {name: sum(row["status"] == name for row in rows) for name in names}
    aside = [row for row in rows if row["status"] == "set_aside"]
    mended = [row for row in rows if row["repairs"]]
    parts = [f"{counts['ok']} sound"]
    parts += [f"{counts['repaired']} repaired"] if counts["repaired"] else []
    parts += [f"{counts['set_aside']} set aside"] if counts["set_aside"] else []
    return {
        "session_id": session.session_id,
        "trials": counts,
        "headline": f"{count_noun(len(rows), 'trial')}: {', '.join(parts)}",
        "set_aside": [{key: row[key] for key in ("trial_id", "reason")} for row in aside],
        "repaired": [{key: row[key] for key in ("trial_id", "repairs")} for row in mended],
    }
