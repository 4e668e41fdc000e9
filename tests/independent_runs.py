"""Runs on sessions of the independent simulators, short enough for tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import independent
from independent.sensors import Conditions

import bampipe

# Dry friction as the devices write it: a true standstill has tests of its own.
SHORT = {
    "bam": Conditions(creep=True, trials=3, seconds=8.0, rate_hz=250.0),
    "joint": Conditions(creep=True, trials=3, seconds=8.0),
    "axis": Conditions(creep=True, trials=3, seconds=5.0),
    "damper": Conditions(trials=3, seconds=6.0),
}
PIPELINE = """schema = "bampipe.pipeline/1"
name = "short"
stages = ["ingest", "filter", "identify", "validate"]
"""


def record_run(
    root: Path, machine: str, seed: int, *effects: str, **conditions: Any
) -> tuple[bampipe.Run, dict[str, float]]:
    """Record a session with ``effects`` hidden, identify and validate it by the bare device.

    Returns the run, and the true value of every parameter that a right model has.
    """
    chosen = replace(SHORT[machine], **conditions)
    strengths = dict.fromkeys(effects, 1.0)
    truth = independent.record(machine, root / machine, seed, strengths, chosen)
    (root / "short.toml").write_text(PIPELINE)
    run = bampipe.run_session(root / machine, runs=root / "runs", pipeline=str(root / "short.toml"))
    return run, truth["parameters"]


def diagnose(run: bampipe.Run) -> dict[str, Any]:
    """Diagnose the newest model of ``run`` with few replays, in this process."""
    return bampipe.diagnose(run, replicates=4, jobs=1)


def error_over_floor(axis: dict[str, Any]) -> float:
    """Held-out error of an axis with what was found, over its noise floor."""
    return float(axis["rmse_after"] / axis["noise_floor"])
