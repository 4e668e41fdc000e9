"""Runs on sessions of the independent simulators, short enough for tests."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import independent
from binary_logs import to_parquet
from independent.sensors import Conditions

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.diagnosis.session import system_of
from bampipe.files import toml_text
from bampipe.physics import registry
from bampipe.physics.device import Device
from bampipe.physics.model_spec import ModelSpec
from bampipe.trials.measured import MeasuredTrials, read_measured_trials

# Dry friction as the devices write it: a true standstill has tests of its own.
SHORT = {
    "bam": Conditions(creep=True, trials=3, seconds=8.0, rate_hz=250.0),
    "joint": Conditions(creep=True, trials=3, seconds=8.0),
    "axis": Conditions(creep=True, trials=3, seconds=5.0),
    "damper": Conditions(trials=3, seconds=6.0),
    "drive": Conditions(trials=2, seconds=12.0),
    "wrist": Conditions(trials=3, seconds=4.0),
}
BUILT_IN = {"bam": "bam", "axis": "slider", "damper": "magnetic_damper"}
STAGES = ("ingest", "filter", "identify", "validate")


def run_short(
    folder: Path, root: Path, stages: Sequence[str] = STAGES, **settings: Mapping[str, object]
) -> bampipe.Run:
    """Run the session in ``folder``, its logs as Parquet, through a few stages.

    Args:
        folder: of the session; root: has the run folders; stages: in order; settings: by stage.
    """
    path = root / "short.toml"
    content = {"schema": "bampipe.pipeline/1", "name": "short", "stages": list(stages)}
    path.write_text(toml_text({**content, "settings": settings}))
    return bampipe.run_session(to_parquet(folder), runs=root / "runs", pipeline=str(path))


def record_run(
    root: Path, machine: str, seed: int, *effects: str, **conditions: Any
) -> tuple[bampipe.Run, dict[str, float]]:
    """Record a session with ``effects`` hidden, identify and validate it by the bare device.

    Returns the run, and the true value of every parameter that a right model has.
    """
    chosen = replace(SHORT[machine], **conditions)
    strengths = dict.fromkeys(effects, 1.0)
    truth = independent.record(machine, root / machine, seed, strengths, chosen)
    return run_short(root / machine, root), truth["parameters"]


def device_of(machine: str) -> Device:
    """The device of a machine: built in, or as its simulator writes it beside a session."""
    if machine in BUILT_IN:
        return registry.device(BUILT_IN[machine])
    return registry.device_from(tomllib.loads(independent.MACHINES[machine].DEVICE))


def record_trials(
    root: Path, machine: str, seed: int, *effects: str, **conditions: Any
) -> tuple[MeasuredTrials, ModelSpec, dict[str, float]]:
    """Record a session with ``effects`` hidden and filter it.

    Returns its trials, the bare device, and the true values of a right model.
    """
    chosen = replace(SHORT[machine], **conditions)
    strengths = dict.fromkeys(effects, 1.0)
    truth = independent.record(machine, root / machine, seed, strengths, chosen)
    run = RunFolder(run_short(root / machine, root, ("ingest", "filter")).root)
    spec = ModelSpec(device_of(machine).declaration, (), ())
    trials = read_measured_trials(run, system_of(spec), every_input=True)
    return trials, spec, truth["parameters"]


def diagnose(run: bampipe.Run) -> dict[str, Any]:
    """Diagnose the newest model of ``run`` with few replicates, in this process."""
    return bampipe.diagnose(run, replicates=4, jobs=1)
