"""A small sound session made in memory, for tests to damage: its first trial, a CSV file."""

import copy
import datetime
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bampipe.files import toml_text

RATE = 500.0
COUNTS = {"yaw": (21333.3333, 12000), "pitch": (10191.0828, -4000), "extension": (33333.3333, 3000)}
COLUMNS = (
    "time_us", "enc_yaw", "enc_pitch", "enc_extension", "force_x_v", "force_y_v", "force_z_v",
    "brake_yaw", "brake_pitch", "brake_extension",
)  # fmt: skip

SESSION: dict[str, Any] = {
    "schema": "bampipe.session/1",
    "session_id": "made",
    "device": "bam",
    "recorded_at": datetime.datetime(2026, 10, 3, 10, 12, tzinfo=datetime.UTC),
    "sample_rate_hz": RATE,
    "encoders": {
        axis: {
            "column": f"enc_{axis}",
            "counts_per_unit": per_unit,
            "zero_counts": zero,
            "unit": "m" if axis == "extension" else "rad",
        }
        for axis, (per_unit, zero) in COUNTS.items()
    },
    "force": {
        "columns": ["force_x_v", "force_y_v", "force_z_v"],
        "unit": "V",
        "frame": "handle",
        "calibration_n_per_v": [[12.0, 0.15, -0.1], [0.1, 11.5, 0.2], [-0.05, 0.1, 24.0]],
        "zero_v": [0.021, -0.034, 0.012],
        "noise_sd_n": 0.05,
    },
    "brakes": {"columns": ["brake_yaw", "brake_pitch", "brake_extension"], "unit": "N.m, N.m, N"},
    "trials": [
        {"file": "trials/t01.csv", "kind": "free"},
        {"file": "trials/t02.parquet", "kind": "free"},
        {"file": "trials/t03.parquet", "kind": "locked", "locked_axis": "yaw"},
    ],
}


def free_trial(seed: int = 0, seconds: float = 2.0) -> dict[str, np.ndarray]:
    """Raw columns of a trial in which all axes move, with sensor noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    phase = rng.uniform(0, 2 * np.pi, 6)
    table = {"time_us": np.rint(t * 1e6)}
    for number, (axis, size, rest) in enumerate(
        (("yaw", 0.5, 0.0), ("pitch", 0.3, 0.0), ("extension", 0.2, 1.0))
    ):
        per_unit, zero = COUNTS[axis]
        q = rest + size * np.sin(2 * np.pi * (0.6 + 0.2 * number) * t + phase[number])
        table[f"enc_{axis}"] = np.rint(zero + q * per_unit)
    for number, name in enumerate(("force_x_v", "force_y_v", "force_z_v")):
        push = np.sin(2 * np.pi * (0.7 + 0.3 * number) * t + phase[3 + number])
        table[name] = np.round(push + 0.004 * rng.standard_normal(len(t)), 6)
    for axis in COUNTS:
        table[f"brake_{axis}"] = np.zeros(len(t))
    return table


def locked_trial(axis: str = "yaw", seed: int = 9, seconds: float = 2.0) -> dict[str, np.ndarray]:
    """Raw columns of a trial with the brake holding one axis, loaded by hand."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    load = np.sin(2 * np.pi * t)
    table = {"time_us": np.rint(t * 1e6)}
    for name, (per_unit, zero) in COUNTS.items():
        rest = 1.0 if name == "extension" else 0.1
        table[f"enc_{name}"] = np.rint(zero + (rest + 0.02 * load * (name == axis)) * per_unit)
    for name, gain in (("force_x_v", 3.0), ("force_y_v", 0.05), ("force_z_v", 0.05)):
        table[name] = np.round(gain * load + 0.004 * rng.standard_normal(len(t)), 6)
    for name in COUNTS:
        table[f"brake_{name}"] = np.full(len(t), 200.0 if name == axis else 0.0)
    return table


def csv_text(table: dict[str, np.ndarray]) -> str:
    """The CSV that a logger writes: whole counts, volts with six decimals."""
    formats = [
        "%.4f" if name.startswith("brake") else "%.6f" if name.startswith("force") else "%.0f"
        for name in table
    ]
    lines = [",".join(table)]
    for row in zip(*table.values(), strict=True):
        cells = ["" if np.isnan(v) else f % v for f, v in zip(formats, row, strict=True)]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def parquet(table: dict[str, np.ndarray]) -> bytes:
    """The table as a Parquet file, which is read in a hundredth of the time of a CSV."""
    return pd.DataFrame(table).to_parquet()


def _as_file(name: str, table: dict[str, np.ndarray]) -> bytes:
    return parquet(table) if name.endswith(".parquet") else csv_text(table).encode()


@dataclass
class Made:
    """A session to damage before it is written: settings, tables, and files byte by byte."""

    session: dict[str, Any] = field(default_factory=lambda: copy.deepcopy(SESSION))
    tables: dict[str, dict[str, np.ndarray]] = field(
        default_factory=lambda: {
            "trials/t01.csv": free_trial(1),
            "trials/t02.parquet": free_trial(2),
            "trials/t03.parquet": locked_trial(),
        }
    )
    files: dict[str, bytes | str] = field(default_factory=dict)

    def text(self, name: str = "trials/t01.csv") -> str:
        return _as_file(name, self.tables[name]).decode()

    def write(self, root: Path) -> Path:
        """Write the session below ``root``; ``files`` take the place of what was made."""
        contents: dict[str, bytes | str] = {
            "session.toml": toml_text(self.session),
            **{name: _as_file(name, table) for name, table in self.tables.items()},
            **self.files,
        }
        for name, content in contents.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        return root
