"""The model that a run folder names: its device, its effects, a lab's own files among them."""

from __future__ import annotations

from bampipe.data.store import read_toml
from bampipe.errors import InputError
from bampipe.physics import Model, registry
from bampipe.stages.base import RunFolder


def load_model(run: RunFolder, name: str) -> Model:
    """Return the model called ``name`` as ``models/<name>/model.toml`` declares it.

    Effect files in ``models/<name>/effects/`` and the device file ``ingest/device.toml`` come
    before built-in ones.

    Raises:
        InputError: a file is missing or wrong, or an effect or the device is not known.
    """
    relative = f"models/{name}/model.toml"
    path = run.require(relative, "identify")
    content = read_toml(path)
    device, effects = content.get("device"), content.get("effects", [])
    if not isinstance(device, str):
        raise InputError("device must be a text", where=str(path))
    if not isinstance(effects, list) or not all(isinstance(item, str) for item in effects):
        raise InputError("effects must be a list of texts", where=str(path))
    own = []
    for file in run.glob(f"models/{name}/effects/*.toml"):
        own.append(registry.effect_from(read_toml(run.path(file)), str(run.path(file))))
    if run.exists("ingest/device.toml"):
        place = run.path("ingest/device.toml")
        return Model(registry.device_from(read_toml(place), str(place)), effects, own)
    return Model(registry.device(device), effects, own)


def model_inputs(name: str) -> tuple[str, ...]:
    """Return the paths that `load_model` reads, as a stage declares them."""
    return (
        f"models/{name}/model.toml",
        f"models/{name}/effects/*.toml",
        "ingest/device.toml?",
    )
