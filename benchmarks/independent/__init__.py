"""Simulators that share no code with bampipe: sessions of six machines with a known truth.

Equations of motion, integrators, friction, sensors and session files are written here from the
physics, with numpy, numba and scipy alone, so that benchmarks and tests hold the product against
something that cannot share its mistakes. ``record(machine, folder, seed, effects, conditions)``
writes one session folder and, beside it, ``<folder>.truth.json``. `independent.arm` writes
what a lab has of a robot before it knows bampipe: a URDF and logs.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from independent import axis, bam, damper, drive, joint, wrist
from independent.sensors import Conditions

MACHINES = {
    "bam": bam, "joint": joint, "axis": axis, "damper": damper, "drive": drive, "wrist": wrist,
}  # fmt: skip


def record(
    machine: str,
    folder: Path,
    seed: int,
    effects: Mapping[str, float] | None = None,
    conditions: Conditions | None = None,
) -> dict[str, Any]:
    """Write a session of ``machine`` with ``effects`` (strength by name, 1 is typical) hidden.

    Returns the truth: ``effects`` and ``outside`` (names in the library of bampipe and beyond it),
    ``parameters`` (values that an identification of the right model must find, by full name).
    """
    return MACHINES[machine].record(folder, seed, effects or {}, conditions)
