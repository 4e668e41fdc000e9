"""A run folder as far as an export of its model reads it."""

from pathlib import Path

from bampipe.data.device_file import find_robot_file, read_device_file
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.export import DRAWING
from bampipe.declarations.model import ModelFile
from bampipe.files import toml_text, write_text
from bampipe.physics import Model, System, compile_model
from bampipe.physics.registry import device_from


def write_run(folder: Path, effects: tuple[str, ...] = ()) -> tuple[RunFolder, System]:
    """Write device, drawing and base model of ``device.toml`` in ``folder``; no results yet."""
    path = folder / "device.toml"
    device = device_from(read_device_file(path), str(path))
    run, drawing = RunFolder(folder / "run"), find_robot_file(path)
    write_text(run.path("ingest/device.toml"), toml_text(device.declaration))
    if drawing is not None:
        write_text(run.path(DRAWING), drawing.read_text())
    text = ModelFile(name="base", device=device.name, effects=effects).text()
    write_text(run.path("models/base/model.toml"), text)
    return run, compile_model(Model(device, effects))
