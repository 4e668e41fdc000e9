"""Stage performance: the device as felt at the handle, from identified numbers (Table VIII)."""

from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.arrays import Array
from bampipe.data.refusals import refusal
from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.data.store import read_parquet
from bampipe.declarations.model_file import IDENTIFIED_MODEL, load_model, read_estimate
from bampipe.physics import System, compile_model
from bampipe.progress import Progress
from bampipe.results.ingest import IngestResult
from bampipe.results.performance import (
    DeviceConstant,
    Handle,
    PerformanceResult,
    Quantity,
    Range,
    Resolution,
)
from bampipe.results.stiffness import StiffnessResult
from bampipe.schema import STRICT

SUMMARY = "Workspace, stiffness, friction, inertia and force at the handle"
INPUTS = (*INGESTED, *FILTERED, "stiffness/stiffness.json?", *IDENTIFIED_MODEL)
OUTPUTS = ("models/{model}/performance.json",)


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        model: which model version.
        points: poses along each axis at which the handle is evaluated.
    """

    model: str = "base"
    points: Annotated[int, Field(ge=2)] = 15


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Map joint stiffness, friction and inertia to the handle over the poses of the session."""
    system = compile_model(load_model(run, config.model))
    device = system.model.device
    p = read_estimate(run, config.model, system)
    # The range of each axis that the moving trials covered, (n_q, 2).
    columns = [f"q_{axis}" for axis in system.coordinates]
    moved = read_parquet(run.require("filter/kinematics.parquet", "filter"), columns=columns)
    q = moved.to_numpy(dtype=float)
    reach = np.stack([np.nanmin(q, axis=0), np.nanmax(q, axis=0)], axis=1)
    # Its largest quantile leaves out the noise of the force sensor.
    samples = run.require("ingest/samples.parquet", "ingest")
    sizes = np.linalg.norm(read_parquet(samples, columns=[*device.forces]).dropna(), axis=1)
    largest = None
    if sizes.size:
        largest = Quantity(value=np.quantile(sizes, 0.999), unit=device.force_unit)
    # Only a handle that can be pushed in as many directions as there are axes has a stiffness of
    # its own; a device driven by a motor has no handle.
    ways = len(device.forces) == len(system.coordinates)
    at_handle = device.force_unit == "N" and ways and not device.drive
    handle = _handle(run, system, p, reach, config.points) if at_handle else None
    return PerformanceResult(
        model=config.model,
        headline=_headline(handle, device.prescribed) if handle else "No handle on this device.",
        constants={name: DeviceConstant.of(item) for name, item in device.constants.items()},
        range={
            axis: Range(lower=reach[i, 0], upper=reach[i, 1], unit=system.coordinate_units[i])
            for i, axis in enumerate(system.coordinates)
        },
        resolution={
            axis: Resolution(value=entry.resolution, unit=entry.unit)
            for axis, entry in run.read(IngestResult).axes.items()
        },
        largest_force=largest,
        handle=handle,
    ).write(out)


def _handle(run: RunFolder, system: System, p: Array, reach: Array, points: int) -> Handle:
    """Return ranges of friction, stiffness and inertia at the handle over poses and directions.

    With v = B^T q' the handle's velocity: its volume element is |det B| dq, joint stiffness K is
    felt as B^-1 K B^-T, Coulomb friction c as B^-1 c, and the inertia M along direction j as
    1 / (B^T M^-1 B)_jj.
    """
    device, axes = system.model.device, system.coordinates
    grid = _grid(reach, points)
    gain = system.input_map(grid, p=p)
    regular = np.abs(np.linalg.det(gain)) > 1e-9
    if not regular.any():
        raise refusal("no_free_pose", f"device {device.name!r}")
    back = np.linalg.inv(gain[regular])
    swept = "m" if len(axes) == 1 else f"m{len(axes)}"
    known = system.by_name(p)
    coulomb = np.array([known.get(f"coulomb.{axis}", 0.0) for axis in axes])
    compliance = np.linalg.inv(system.mass_matrix(grid[regular], p))
    mobility = np.einsum("tij,tik,tkl->tjl", gain[regular], compliance, gain[regular])
    locked = run.read(StiffnessResult).axes if run.exists(StiffnessResult.FILE) else {}
    felt = None
    if all(axis in locked for axis in axes):
        joint = np.diag([locked[axis].stiffness for axis in axes])
        felt = _range(np.einsum("tfi,ij,tfj->tf", back, joint, back), "N/m")
    return Handle(
        directions=device.components,
        workspace=Quantity(value=_volume(system, reach, p, points), unit=swept),
        friction=_range(np.abs(back) @ coulomb, "N"),
        inertia=_range(1.0 / np.diagonal(mobility, axis1=1, axis2=2), "kg"),
        stiffness=felt,
    )


def _grid(reach: Array, points: int) -> Array:
    """Return poses, every combination of ``points`` values an axis, (points^n_q, n_q)."""
    return np.array(list(product(*(np.linspace(low, high, points) for low, high in reach))))


def _volume(system: System, reach: Array, p: Array, points: int) -> float:
    """Return the volume that the handle sweeps (area, length), by the midpoint rule."""
    width = (reach[:, 1] - reach[:, 0]) / points
    inner = np.stack([reach[:, 0] + width / 2.0, reach[:, 1] - width / 2.0], axis=1)
    grid = _grid(inner, points)
    gain = system.input_map(grid, p=p)
    return float(np.abs(np.linalg.det(gain)).sum() * np.prod(width))


def _range(values: Array, unit: str) -> Range:
    return Range(lower=values.min(), upper=values.max(), unit=unit)


def _headline(handle: Handle, prescribed: bool) -> str:
    """Say it in one line; on a test bench nobody holds a handle."""
    swept = handle.workspace
    what, where = ("stroke", "load cell") if prescribed else ("workspace moved through", "handle")
    parts = [f"{what} {swept.value:.2g} {swept.unit}"]
    for name in ("stiffness", "friction", "inertia"):
        found = getattr(handle, name)
        if found is not None:
            low, high = f"{found.lower:.3g}", f"{found.upper:.3g}"
            parts.append(f"{name} {low if low == high else f'{low} to {high}'} {found.unit}")
    return f"At the {where}: " + ", ".join(parts)
