"""Reading of pipelines: stages to run, their settings, and limits of results.

A missing or invalid pipeline raises `InputError`.
"""

from pathlib import Path

import bampipe
from bampipe.declarations.pipeline import Pipeline
from bampipe.errors import InputError, choose_from
from bampipe.files import read_toml
from bampipe.run import record
from bampipe.schema import read

SCHEMA = "bampipe.pipeline/1"


def recorded(root: Path) -> Pipeline:
    """Return the pipeline, without its gates, that ``run.json`` keeps; else the default one."""
    used = record.read(root).pipeline
    if used is None:
        return load()
    model = {"device": used.device, "effects": used.effects}
    table = {"name": used.name, "stages": used.stages, "settings": used.settings, "model": model}
    return read(Pipeline, {"schema": SCHEMA, **table}, "run.json: pipeline")


def whole(root: Path, name: str = "") -> Pipeline:
    """Return the pipeline ``name``, else that of the run, with every stage: for single stages."""
    return (load(name) if name else recorded(root)).with_every_stage()


def find_shipped(name: str) -> Path:
    """Return a folder that ships: a wheel has it inside the package, a working copy beside it."""
    package = Path(bampipe.__file__).parent
    inside = package / f"_{name}"
    return inside if inside.is_dir() else package.parent / name


def names() -> tuple[str, ...]:
    """Return the names of the pipelines that ship, sorted."""
    return tuple(sorted(path.stem for path in find_shipped("pipelines").glob("*.toml")))


def load(name: str = "default") -> Pipeline:
    """Read and check the pipeline ``name``: a shipped one, or the path to a lab's own."""
    path = Path(name)
    if not name.endswith(".toml"):
        if name not in names():
            raise InputError(f"no pipeline {name!r}", remedy=choose_from(name, names()))
        path = find_shipped("pipelines") / f"{name}.toml"
    elif not path.is_file():
        raise InputError("no such pipeline file", where=name)
    pipeline = read(Pipeline, read_toml(path), str(path))
    pipeline._where = str(path)
    return pipeline
