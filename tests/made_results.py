"""Results for tests: what a test says of them, the rest made up."""

from collections.abc import Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from bampipe.declarations.model import ModelFile
from bampipe.files import write_json
from bampipe.results.record import Record, Result
from bampipe.run import models

_ABSENT: Any = object()
_MADE_UP = {str: "?", float: 1.0, int: 1, bool: False, tuple: [], dict: {}}


def filled(kind: Any, value: Any = _ABSENT) -> Any:
    """``value`` as a field of type ``kind`` holds it, every required field of records filled."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return filled(inner[0], value)
    if origin in (Union, UnionType):
        return None if value in (_ABSENT, None) else filled(inner[0], value)
    if isinstance(kind, type) and issubclass(kind, Record):
        given = {} if value is _ABSENT else value
        fields = {field.alias or name: field for name, field in kind.model_fields.items()}
        others = get_args(get_type_hints(kind).get("__pydantic_extra__")) or (str, object)
        return {
            **{k: filled(others[1], v) for k, v in given.items() if k not in fields},
            **{
                name: filled(field.annotation, given.get(name, _ABSENT))
                for name, field in fields.items()
                if name in given or field.is_required()
            },
        }
    if value is _ABSENT:
        return inner[0] if origin is Literal else _MADE_UP[origin or kind]
    if origin is tuple and inner[-1] is ...:
        return [filled(inner[0], item) for item in value]
    if origin is dict and isinstance(value, Mapping):
        return {key: filled(inner[1], item) for key, item in value.items()}
    return value


def diagnosis(
    axes: Mapping[str, Mapping[str, Any]], sets: Mapping[tuple[str, ...], float] = {(): 1.0}
) -> dict[str, Any]:
    """Fields of a diagnosis in which these sets of effects are probable, the first selected.

    Args:
        axes: what is said of each axis, its verdict at least; sets: with their probabilities.
    """
    first = next(iter(sets))
    names = dict.fromkeys(name for one in sets for name in one)
    chance = {name: sum(p for one, p in sets.items() if name in one) for name in names}
    said = {}
    for axis, given in axes.items():
        here = [name for name in names if name.partition(":")[2] in ("", axis)]
        found = {"effects": [n for n in here if n in first]}
        said[axis] = {**found, "probabilities": {n: chance[n] for n in here}, **given}
    weighed = [{"effects": one, "probability": p} for one, p in sets.items()]
    return {"axes": said, "selected": first, "sets": weighed}


def write_result(root: Path, kind: type[Result], **given: Any) -> dict[str, Any]:
    """Write the result ``kind`` below ``root`` and return its content."""
    content: dict[str, Any] = filled(kind, given)
    write_json(root / kind.file(str(given.get("model", "base"))), content)
    return content


def write_model(root: Path, name: str, *effects: str, **more: str) -> None:
    """Write a model version with these effects, of the BAM unless ``more`` names a device."""
    models.write(root, ModelFile(**{"name": name, "device": "bam", "effects": effects, **more}))
