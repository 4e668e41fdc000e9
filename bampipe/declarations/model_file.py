"""Models of a run folder: device, built-in and own effects, and identified parameters."""

import numpy as np
from numpy.typing import NDArray

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model import read_model_file
from bampipe.errors import InputError
from bampipe.files import read_toml
from bampipe.physics import Model, System, registry
from bampipe.physics.device import Device
from bampipe.physics.model_spec import ModelSpec
from bampipe.results.identify import IdentifyResult

MODEL_INPUTS = ("models/{model}/model.toml", "models/{model}/effects/*.toml", "ingest/device.toml?")
"""Files that `load_model` reads, in the form in which a stage declares its inputs."""
IDENTIFIED_MODEL = (*MODEL_INPUTS, "models/{model}/identify.json")
"""Files that `load_model` and `read_estimate` read."""


def load_model(run: RunFolder, name: str, *, as_declared: bool = False) -> Model:
    """Return the model called ``name`` as ``models/<name>/model.toml`` declares it.

    An identified model has the sign width that its identification chose, unless it is requested
    ``as_declared``. Effect files in ``models/<name>/effects/`` and the device file
    ``ingest/device.toml`` take precedence over built-in ones.

    Raises:
        InputError: a file is missing or invalid, or an effect or the device is unknown.
    """
    relative = f"models/{name}/model.toml"
    path = run.require(relative, "identify")
    model = read_model_file(path)
    files = map(run.path, run.glob(f"models/{name}/effects/*.toml"))
    own = [registry.effect_from(read_toml(file), str(file)) for file in files]
    declared = Model(load_device(run, model.device), model.effects, own)
    if as_declared or not run.exists(IdentifyResult.file(name)):
        return declared
    factor = run.read(IdentifyResult, name).sign_width_factor
    if factor == 1.0:
        return declared
    return read_spec(run, name, declared).with_sign_widths(factor).model()


def load_device(run: RunFolder, name: str) -> Device:
    """Return the device of a run folder: its own device file if present, else the built-in one.

    Args:
        run: the run folder; name: name of the built-in device.
    """
    if run.exists("ingest/device.toml"):
        path = run.path("ingest/device.toml")
        return registry.device_from(read_toml(path), str(path))
    return registry.device(name)


def read_spec(run: RunFolder, name: str, model: Model) -> ModelSpec:
    """Return ``model``, called ``name`` in the run folder, as plain data for worker processes."""
    own = [read_toml(run.path(path)) for path in run.glob(f"models/{name}/effects/*.toml")]
    return ModelSpec(model.device.declaration, tuple(e.name for e in model.effects), tuple(own))


def read_estimate(run: RunFolder, name: str, system: System) -> NDArray[np.float64]:
    """Return the parameters of the model called ``name``, (n_p,), fixed ones at their prior.

    Raises `InputError` if the model has not been identified, or has changed since.
    """
    found = run.read(IdentifyResult, name).parameters
    p = system.prior
    for i, item in enumerate(system.parameters):
        if item.fixed:
            continue
        if item.name not in found:
            raise InputError(
                f"no parameter {item.name!r}",
                where=str(run.path(IdentifyResult.file(name))),
                remedy=f"bampipe identify {run.root} --model {name} --force",
            )
        p[i] = found[item.name].estimate
    return p
