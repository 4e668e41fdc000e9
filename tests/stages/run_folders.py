"""Run folders with an ingested session, for the tests of the stages that read one."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from made_results import write_result

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import write_parquet
from bampipe.physics import registry
from bampipe.results.ingest import IngestResult

SESSIONS = Path(__file__).resolve().parents[3] / "shared" / "sessions"


def write_ingested(
    root: Path,
    frames: Mapping[str, pd.DataFrame],
    kinds: Mapping[str, tuple[str, str | None]],
    axes: Mapping[str, Mapping[str, Any]],
    *,
    device: str = "bam",
    rate: float = 500.0,
) -> RunFolder:
    """Write what ingest leaves: ``frames`` (t, q_*, force_*, brake_*) by trial."""
    rows = [
        {
            "trial_id": name, "file": f"{name}.csv", "kind": kinds[name][0],
            "locked_axis": kinds[name][1], "viscous_n_s_per_m": None,
            "n_samples": len(frame), "duration_s": float(np.ptp(frame["t"])),
            "sample_rate_hz": rate, "status": "ok", "reason": "", "repairs": "",
        }
        for name, frame in frames.items()
    ]  # fmt: skip
    parts = []
    for name, frame in frames.items():
        part = frame.copy()
        part.insert(0, "trial_id", name)
        parts.append(part)
    write_parquet(root / "ingest/trials.parquet", pd.DataFrame(rows))
    write_parquet(root / "ingest/samples.parquet", pd.concat(parts, ignore_index=True))
    forces = registry.device(device).forces
    encoders = {
        axis: {
            "unit": entry["unit"], "resolution": entry["resolution"],
            "resolution_stated": entry["resolution"], "resolution_measured": entry["resolution"],
            "noise_sd": float(entry["resolution"]) / np.sqrt(12.0),
        }
        for axis, entry in axes.items()
    }  # fmt: skip
    write_result(
        root, IngestResult, session_id=root.name, device=device, axes=encoders, sample_rate_hz=rate,
        force={
            "noise_sd": dict.fromkeys(forces, 0.05), "noise_sd_stated": 0.05,
            "noise_sd_measured": dict.fromkeys(forces, 0.05), "unit": "N", "columns": list(forces),
        },
        recorded_at="2026-10-03T10:12:00+00:00",
    )  # fmt: skip
    return RunFolder(root)


def ingested_session(root: Path, name: str) -> RunFolder:
    """Write the shared session ``name`` as ingest would; skip the test where it is absent."""
    folder = SESSIONS / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here")
    session = tomllib.loads((folder / "session.toml").read_text())
    calibration = np.array(session["force"]["calibration_n_per_v"])
    frames, kinds = {}, {}
    for trial in session["trials"]:
        raw = pd.read_csv(folder / trial["file"])
        volts = raw[session["force"]["columns"]].to_numpy() - session["force"]["zero_v"]
        columns = {"t": raw["time_us"].to_numpy() * 1e-6}
        for axis, encoder in session["encoders"].items():
            counts = raw[encoder["column"]].to_numpy() - encoder["zero_counts"]
            columns[f"q_{axis}"] = counts / encoder["counts_per_unit"]
        for component, force in zip("xyz", (volts @ calibration.T).T, strict=True):
            columns[f"force_{component}"] = force
        for axis in session["encoders"]:
            columns[f"brake_{axis}"] = raw[f"brake_{axis}"].to_numpy()
        trial_id = Path(trial["file"]).stem
        frames[trial_id] = pd.DataFrame(columns)
        kinds[trial_id] = (trial["kind"], trial.get("locked_axis"))
    axes = {
        axis: {"unit": encoder["unit"], "resolution": 1.0 / encoder["counts_per_unit"]}
        for axis, encoder in session["encoders"].items()
    }
    return write_ingested(root, frames, kinds, axes)
