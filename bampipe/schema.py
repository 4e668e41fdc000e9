"""One declaration of each file: a pydantic model, its faults in plain words, its JSON Schema."""

import ast
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Self, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    PrivateAttr,
    Strict,
    StringConstraints,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import PydanticCustomError, core_schema

from bampipe.errors import InputError, did_you_mean

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""Configuration of declarations and stage settings: no unknown keys, no conversion."""


class Declaration(BaseModel):
    """A table of a file: unknown keys are refused, and nothing is converted but lists to tuples.

    Faults between fields are found by `cross_faults` once every field is valid by itself.
    """

    model_config = ConfigDict(
        **STRICT, frozen=True, arbitrary_types_allowed=True, use_attribute_docstrings=True
    )

    def cross_faults(self) -> Iterator[InputError]:
        """Yield every fault between the fields; ``where`` is a key below this table, or empty."""
        yield from ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if found := list(self.cross_faults()):
            raise PydanticCustomError("faults", "faults", {"found": found})
        return self


class NamedDeclaration(Declaration):
    """A table among several of a kind, each called by its key."""

    _name: str = PrivateAttr("")

    @property
    def name(self) -> str:
        """The key of the table."""
        return self._name


D = TypeVar("D", bound=Declaration)
T = TypeVar("T")


def fault(what: str, remedy: str = "") -> PydanticCustomError:
    """Return the exception of a field's validator, with the words of an `InputError`."""
    return PydanticCustomError("faults", "faults", {"found": [InputError(what, remedy=remedy)]})


def checked_by(check: Callable[[Any], T]) -> Callable[[Any], T]:
    """Return ``check``, which raises `InputError`, as the validator of a field."""

    def validate(value: Any) -> T:
        try:
            return check(value)
        except InputError as error:
            raise fault(error.what, error.remedy) from None

    return validate


def _refuse_rounded(value: Any) -> Any:
    if isinstance(value, int) and abs(value) > 2**53:
        raise fault("found a whole number beyond 2^53")
    return value


def _refuse_twice(values: tuple[T, ...]) -> tuple[T, ...]:
    if len(set(values)) < len(values):
        raise fault(f"found {_shown(values)}, expected no entry twice")
    return values


Text = Annotated[str, StringConstraints(min_length=1)]
Number = Annotated[float, BeforeValidator(_refuse_rounded)]
Positive = Annotated[float, Field(gt=0), BeforeValidator(_refuse_rounded)]
Count = Annotated[int, Field(ge=0)]
NotNegative = Annotated[float, Field(ge=0), BeforeValidator(_refuse_rounded)]
Several = Annotated[tuple[T, ...], Strict(False)]
Distinct = Annotated[
    tuple[T, ...],
    Strict(False),
    AfterValidator(_refuse_twice),
    Field(json_schema_extra={"uniqueItems": True}),
]


class ByName:
    """Annotation of ``tuple[NamedDeclaration, ...]``: a table of tables in the file.

    Args:
        key: type of the names.
        least: number of tables.
    """

    def __init__(self, key: Any, least: int = 0) -> None:
        self.key, self.least = key, least

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        entry = get_args(source)[0]
        table = handler.generate_schema(dict.__class_getitem__((self.key, entry)))
        table = {**table, "min_length": self.least}
        return core_schema.no_info_after_validator_function(_named, table)


def _named(table: dict[str, NamedDeclaration]) -> tuple[NamedDeclaration, ...]:
    for name, entry in table.items():
        entry._name = name
    return tuple(table.values())


def read(kind: type[D], content: object, where: str) -> D:
    """Check the ``content`` of the file ``where`` against its declaration.

    Raises:
        InputError: names the file, the field (dotted), what was found, what is expected; and
            likewise for every other wrong field.
    """
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise refusal(error, kind, where) from None


def refusal(
    error: ValidationError, kind: type, where: str, inside: Sequence[str] = ()
) -> InputError:
    """Return the error of `read` for an ``error`` of pydantic; ``inside``: the checked table."""
    first, *others = _faults(error, kind, where, inside)
    return InputError(first.what, where=first.where, remedy=first.remedy, others=others)


def faults(kind: type[Declaration], content: object, where: str) -> list[InputError]:
    """Return every fault for which `read` refuses ``content``, one error per field."""
    try:
        kind.model_validate(content)
    except ValidationError as error:
        return _faults(error, kind, where)
    return []


class _Generator(GenerateJsonSchema):
    """JSON Schema without titles of fields, defaults outside JSON, and keys of another form."""

    def dict_schema(self, schema: Any) -> dict[str, Any]:
        content = super().dict_schema(schema)
        return content | ({"additionalProperties": False} if "patternProperties" in content else {})

    def default_schema(self, schema: Any) -> dict[str, Any]:
        content = super().default_schema(schema)
        if content.get("default") in (math.inf, -math.inf):
            del content["default"]
        return content

    def nullable_schema(self, schema: Any) -> dict[str, Any]:
        content = self.generate_inner(schema["schema"])
        kind = content.get("type")
        if not isinstance(kind, str):
            return super().nullable_schema(schema)
        choices = {"enum": [*content["enum"], None]} if "enum" in content else {}
        return content | choices | {"type": [kind, "null"]}

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


@cache
def json_schema(kind: type) -> dict[str, Any]:
    """The JSON Schema of a file, or of the settings of a stage."""
    content = TypeAdapter(kind).json_schema(schema_generator=_Generator)
    for definition in (content, *content.get("$defs", {}).values()):
        del definition["title"]
        for entry in definition.get("properties", {}).values():
            if "description" in entry:  # a docstring may have several lines
                entry["description"] = " ".join(entry["description"].split())
    name = content["properties"].get("schema", {}).get("const")
    head = {"$schema": GenerateJsonSchema.schema_dialect} | ({"$id": name} if name else {})
    return head | content


def dotted(path: Iterable[str | int]) -> str:
    """``encoders.yaw.unit`` or ``trials[2].kind``, for the keys and indices in ``path``."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return text.removeprefix(".")


_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
_EXPECTED = {
    "string_type": "text",
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "finite_number": "a finite number",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "{ge:g} or more",
    "less_than": "less than {lt:g}",
    "less_than_equal": "{le:g} or less",
    "string_too_short": "text that is not empty",
    "string_too_long": "at most {max_length} characters",
}


def _faults(
    error: ValidationError, kind: type, where: str, inside: Sequence[str] = ()
) -> list[InputError]:
    # A list with wrong entries counts as short: the entries are reported instead.
    found = [
        e
        for e in error.errors(include_url=False)
        if e["type"] != "too_short" or len(e["input"]) < e["ctx"]["min_length"]
    ]
    # An unknown key is often a misspelt missing one: it comes first.
    keys = (*_UNKNOWN, "missing")
    found.sort(
        key=lambda e: (e["type"] not in keys or len(e["loc"]) > 1, e["type"] not in _UNKNOWN)
    )
    said = []
    for e in found:
        place = e["loc"][:-1] if e["type"] in keys else e["loc"]
        place = place[:-2] if place[-1:] == ("[key]",) else place
        path = [*inside, *(part for part in place if not str(part).startswith("#"))]
        if e["type"] == "faults":
            said += [_placed(f, [*path, f.where], where) for f in e["ctx"]["found"]]
        else:
            said.append(_in_words(e, path, json_schema(kind), where))
    return said


def _placed(fault: InputError, path: list[Any], where: str) -> InputError:
    place = dotted(part for part in path if part != "")
    there = ": ".join(part for part in (where, place) if part)
    return InputError(fault.what, where=there, remedy=fault.remedy)


def _in_words(error: Any, path: list[Any], schema: Mapping[str, Any], where: str) -> InputError:
    """One error of pydantic in plain words."""
    kind, given, more = error["type"], error["input"], error.get("ctx", {})
    remedy = ""
    if kind in ("missing", *_UNKNOWN):
        *above, key = error["loc"]
        known = _node(schema, above).get("properties", {})
        if kind == "missing":
            what, remedy = f"'{key}' is missing", known.get(key, {}).get("description", "")
        else:
            what = f"unknown key {_shown(key)}{did_you_mean(str(key), known)}"
            remedy = "" if "did you mean" in what else f"known keys: {', '.join(known)}"
    elif kind == "literal_error":
        choices = [ast.literal_eval(text) for text in re.findall(r"'[^']*'|\d+", more["expected"])]
        what = f"found {_shown(given)}, expected {' or '.join(map(_shown, choices))}"
        what += did_you_mean(given, choices) if isinstance(given, str) else ""
    else:
        node = _node(schema, error["loc"])
        if kind == "string_pattern_mismatch":
            expected = node.get("description", f"a name that matches {more['pattern']}")
        elif kind == "too_short":
            unit = "entry" if more["field_type"] == "Dictionary" else "in the list"
            expected = f"at least {more['min_length']} {unit}"
        else:
            expected = _EXPECTED[kind].format(**more) if kind in _EXPECTED else error["msg"]
        what = f"found {_shown(given)}, expected {expected}"
    return _placed(InputError(what, remedy=remedy), path, where)


def _node(schema: Mapping[str, Any], path: Iterable[str | int]) -> Mapping[str, Any]:
    """Return the part of ``schema`` at ``path``; a part ``#Name`` chooses that definition."""
    node = schema
    for part in path:
        if str(part).startswith("#"):
            node = schema["$defs"].get(str(part)[1:], {})
        elif part == "[key]":
            continue
        elif isinstance(part, int):
            node = node.get("items", {})
        else:
            others = node.get("additionalProperties") or {}
            others = next(iter(node.get("patternProperties", {}).values()), others)
            node = node.get("properties", {}).get(part, others)
        node = node["anyOf"][0] if "$ref" not in node and "anyOf" in node else node
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rpartition("/")[2]] | {
                key: value for key, value in node.items() if key != "$ref"
            }
    return node


def _shown(value: object) -> str:
    if isinstance(value, Mapping):
        return "a table" if value else "an empty table"
    if isinstance(value, tuple):
        value = list(value)
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):  # a date, or a number of thousands of digits
        text = str(value)[:60] if not isinstance(value, int) else "a huge number"
    text = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}.get(text, text)
    return text if len(text) <= 60 else text[:57] + "..."
