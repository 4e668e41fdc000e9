"""A simulated session in the raw-log format, with hidden effects.

The specimen is the compiled model with the effects of kind torque and energy; the effects of kind
input and measurement act on the readings of its sensors. The truth goes into a file beside the
session folder, never inside.
"""

import re
from pathlib import Path

import numpy as np

from bampipe.data import store
from bampipe.errors import InputError
from bampipe.files import write_json, write_text
from bampipe.lists import count_noun
from bampipe.physics.device import Device
from bampipe.progress import Progress, silent
from bampipe.results.truth import TruthResult
from bampipe.simulator.sensor_log import format_session_file, record_trial
from bampipe.simulator.specimen import Config, draw_specimen
from bampipe.simulator.true_trials import simulate_locked_trial, simulate_moving_trial

__all__ = ["Config", "simulate_session"]


def simulate_session(out: Path, config: Config, progress: Progress = silent) -> dict[str, object]:
    """Write a session folder ``out`` and the truth about it to ``out`` + ``.truth.json``.

    Args:
        out: folder to make; must not exist, or be empty.
        config: what to simulate; equal configurations give equal bytes.
        progress: called after each trial.

    Returns:
        ``headline``, ``session``, ``truth`` (paths), ``effects``, ``trials`` (file names).

    Raises:
        InputError: an effect, parameter or option makes no sense, or ``out`` is not empty.
    """
    out = Path(out).resolve()
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", out.name):
        raise InputError(
            f"{out.name!r} cannot name a session", remedy="use letters, digits, '.', '_' and '-'"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("exists and is not an empty folder", where=str(out))
    specimen, strengths = draw_specimen(config)
    trials = _list_trials(specimen.device, config)
    for number, trial in enumerate(trials):
        rng = np.random.default_rng([config.seed, 1 + number])
        if trial["kind"] == "locked":
            true = simulate_locked_trial(specimen, config, rng, trial["locked_axis"])
        else:
            true = simulate_moving_trial(specimen, config, rng, trial["kind"] == "viscous")
        frame = record_trial(specimen, config, rng, true, trial["kind"] == "locked")
        path = out / trial["file"]
        if config.file_format == "csv":
            write_text(path, frame.to_csv(index=False, lineterminator="\n"))
        else:
            store.write_parquet(path, frame)
        progress((number + 1) / len(trials), trial["file"])
    write_text(out / "session.toml", format_session_file(out.name, specimen.device, config, trials))
    truth = out.with_name(out.name + ".truth.json")
    found = TruthResult(
        schema="bampipe.truth/1",
        device=specimen.device.name,
        effects=strengths,
        configuration=config.model_dump(),
        parameters=dict(specimen.values),
        stiffness=dict(specimen.stiffness) if config.locked_trials else {},
    )
    write_json(truth, found.model_dump(mode="json"))
    return {
        "headline": f"{count_noun(len(trials), 'trial')}; the truth is beside {out.name}/, in"
        f" {truth.name}",
        "session": str(out),
        "truth": str(truth),
        "effects": list(strengths),
        "trials": [trial["file"] for trial in trials],
    }


def _list_trials(device: Device, config: Config) -> list[dict[str, str]]:
    """Return the ``[[trials]]`` entries."""
    kinds = [("free", "")] * config.trials + [("viscous", "")] * config.viscous_trials
    if config.locked_trials:
        kinds += [("locked", c.name) for c in device.coordinates if c.name in device.brakes]
    if not device.brakes and (config.viscous_trials or config.locked_trials):
        raise InputError(f"device {device.name!r} has no brakes for locked or viscous trials")
    trials = []
    for number, (kind, axis) in enumerate(kinds, start=1):
        label = f"{kind}_{axis}" if axis else kind
        entry = {"file": f"trials/t{number:02d}_{label}.{config.file_format}", "kind": kind}
        trials.append(entry | ({"locked_axis": axis} if axis else {}))
    return trials
