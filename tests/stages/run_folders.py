"""Run folders with an ingested session, for the tests of the stages that read one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from made_results import write_result

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import write_parquet
from bampipe.physics import registry
from bampipe.results.ingest import IngestResult


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
    samples = pd.concat(frames, names=["trial_id"]).reset_index(level=0).reset_index(drop=True)
    write_parquet(root / "ingest/trials.parquet", pd.DataFrame(rows))
    write_parquet(root / "ingest/samples.parquet", samples)
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
