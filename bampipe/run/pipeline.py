"""Pipelines: which stages run, with which settings, and which results are good enough."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bampipe
from bampipe.data.schema import validate
from bampipe.errors import InputError
from bampipe.files import read_toml
from bampipe.run.settings import did_you_mean
from bampipe.stages import base


@dataclass(frozen=True)
class Gate:
    """A limit on one number of a result, or on that number for each axis.

    Attributes:
        name: what the gate guards, a few words.
        result: file in the run folder, JSON; ``{model}`` stands for the model that is judged.
        value: dotted path of the number; one ``*`` stands for every key at that place.
        divide_by: dotted path of a second number that the first is divided by, or "".
        against: "accepted" to judge by how many percent the value has changed since it was last
            accepted, two standard deviations of the change taken off; "" to judge the value.
        max: largest value that passes, or None.
        min: smallest value that passes, or None.
        level: "fail" (exit code 1) or "warn" (said, but the run counts as good).
        optional: a result that is not there passes.
        advice: what to do where the gate does not pass.
    """

    name: str
    result: str
    value: str
    divide_by: str = ""
    against: str = ""
    max: float | None = None
    min: float | None = None
    level: str = "fail"
    optional: bool = False
    advice: str = ""


@dataclass(frozen=True)
class Pipeline:
    """What ``bampipe run`` does.

    Attributes:
        name: name of the pipeline.
        stages: the stages, in order.
        device: device of the base model; "" for the one that the session names.
        effects: effects of the base model, ``name[:target]``.
        settings: settings by stage and field, in place of the defaults.
        gates: limits that the results are held against.
        where: the file, for messages.
    """

    name: str
    stages: tuple[str, ...]
    device: str = ""
    effects: tuple[str, ...] = ()
    settings: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    gates: tuple[Gate, ...] = ()
    where: str = ""

    def content(self) -> dict[str, object]:
        """Return what ``run.json`` keeps of the pipeline."""
        return {
            "name": self.name,
            "stages": list(self.stages),
            "device": self.device,
            "effects": list(self.effects),
            "settings": {stage: dict(values) for stage, values in self.settings.items()},
        }


def recorded(content: Mapping[str, Any]) -> Pipeline:
    """Return the pipeline, without its gates, that ``run.json`` keeps; else the default one."""
    kept = content.get("pipeline")
    if kept is None:
        return load()
    return Pipeline(
        name=kept["name"],
        stages=tuple(kept["stages"]),
        device=kept["device"],
        effects=tuple(kept["effects"]),
        settings=kept["settings"],
        where=f"pipeline {kept['name']}",
    )


_PACKAGE = Path(bampipe.__file__).parent
# In a wheel the folder lies inside the package; in a working copy beside it.
_FOLDERS = (_PACKAGE / "_pipelines", _PACKAGE.parent / "pipelines")


def _shipped() -> Path:
    return next((folder for folder in _FOLDERS if folder.is_dir()), _FOLDERS[0])


def names() -> tuple[str, ...]:
    """Return the names of the pipelines that ship, sorted."""
    return tuple(sorted(path.stem for path in _shipped().glob("*.toml")))


def find(name: str) -> Path:
    """Return the file of the pipeline ``name``: a shipped one, or a path to a lab's own.

    Raises:
        InputError: there is none.
    """
    if name.endswith(".toml"):
        path = Path(name)
        if path.is_file():
            return path
        raise InputError("no such pipeline file", where=name)
    if name in names():
        return _shipped() / f"{name}.toml"
    raise InputError(f"no pipeline {name!r}", remedy=did_you_mean(name, names()))


def load(name: str = "default") -> Pipeline:
    """Read and check the pipeline ``name`` (see :func:`find`).

    Raises:
        InputError: there is none, it is not TOML, or it says something impossible.
    """
    path = find(name)
    content = read_toml(path)
    stages = content.get("stages")
    for stage in stages if isinstance(stages, list) else []:
        if stage not in base.STAGES:
            raise InputError(
                f"no stage {stage!r}",
                where=f"{path}: stages",
                remedy=did_you_mean(stage, base.STAGES),
            )
    validate(content, "pipeline", str(path))
    for stage in content.get("settings", {}):
        if stage not in base.STAGES:
            raise InputError(
                f"settings for {stage!r}, which is no stage",
                where=f"{path}: settings",
                remedy=did_you_mean(stage, base.STAGES),
            )
    order = [base.STAGES.index(stage) for stage in content["stages"]]
    if order != sorted(set(order)):
        raise InputError(
            "stages must stand once each and in order",
            where=f"{path}: stages",
            remedy=f"the order is {', '.join(base.STAGES)}",
        )
    model = content.get("model", {})
    return Pipeline(
        name=content["name"],
        stages=tuple(content["stages"]),
        device=model.get("device", ""),
        effects=tuple(model.get("effects", ())),
        settings=content.get("settings", {}),
        gates=tuple(Gate(**gate) for gate in content.get("gates", ())),
        where=str(path),
    )
