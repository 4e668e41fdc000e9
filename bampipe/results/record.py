"""Base classes of records: typed, immutable, read and written whole."""

import json
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
)

from bampipe.errors import InputError
from bampipe.files import read_json_table, write_json
from bampipe.schema import Declaration, refusal

Size = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Names = tuple[str, ...]


class Record(Declaration):
    """Part of a result.

    Fields of another type, undeclared fields and numbers that are not finite are refused; numpy
    numbers are accepted. Fields with their default are left out of the file.
    """

    model_config = ConfigDict(strict=False, serialize_by_alias=True)

    @classmethod
    def of(cls, *sources: object, **values: object) -> Self:
        """Return a record from ``values`` and the attributes of ``sources`` that are fields.

        Arrays become tuples; an earlier source goes before a later one.
        """
        found = {
            name: getattr(one, name)
            for one in reversed(sources)
            for name in cls.model_fields
            if hasattr(one, name)
        } | values
        plain = {k: v.tolist() if hasattr(v, "tolist") else v for k, v in found.items()}
        return cls.model_validate(plain)

    @model_serializer(mode="wrap")
    def _without_defaults(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        held = {
            name
            for name, field in type(self).model_fields.items()
            if not field.is_required() and getattr(self, name) == field.get_default()
        }
        return {name: value for name, value in serialize(self).items() if name not in held}


class Result(Record):
    """One JSON file.

    Attributes:
        FILE: its path in the folder it belongs to; ``{model}`` stands for the model's name.
        STAGE: the command that writes it.
    """

    FILE: ClassVar[str]
    STAGE: ClassVar[str]

    def __init_subclass__(cls, file: str, stage: str, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.FILE, cls.STAGE = file, stage

    @classmethod
    def file(cls, model: str = "") -> str:
        """Return the path of the result of ``model``, relative to the folder."""
        return cls.FILE.replace("{model}", model)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read and check ``path``; fields that another version of bampipe added are passed over.

        Raises:
            InputError: no such file, or a wrong field, which is named.
        """
        content: Any = read_json_table(path)
        try:
            return cls._checked(content)
        except ValidationError as error:
            places = [f["loc"] for f in error.errors() if f["type"] == "extra_forbidden"]
            for *tables, last in places:
                del reduce(getitem, tables, content)[last]
        try:
            return cls._checked(content)
        except ValidationError as error:
            refused = refusal(error, cls, str(path))
            remedy = f"make it again with `bampipe {cls.STAGE} --force`"
            raise InputError(
                refused.what, where=refused.where, remedy=remedy, others=refused.others
            ) from None

    @classmethod
    def _checked(cls, content: object) -> Self:
        # From text, where a list may stand for a tuple but "1" does not stand for 1.
        return cls.model_validate_json(json.dumps(content), strict=True)

    def write(self, folder: Path) -> dict[str, Any]:
        """Write the result below ``folder``, whole or not at all, and return its content."""
        content = self.model_dump(mode="json")
        write_json(folder / self.file(getattr(self, "model", "")), content)
        return content
