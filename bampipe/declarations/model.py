"""The file ``models/<name>/model.toml``: a device, its effects, and the parent model."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from bampipe.data.refusals import refusal
from bampipe.files import read_toml, toml_text
from bampipe.schema import Declaration, Several, Text, read


class ModelFile(Declaration):
    """A model of a run folder."""

    schema_: Literal["bampipe.model/1"] = Field(default="bampipe.model/1", alias="schema")
    name: Text
    """Name of the model; a child's is its parent's, then + and each added effect"""
    parent: str = Field(default="", description="Name of the parent; empty for the base model")
    device: Text = Field(description="Name of the device")
    effects: Several[Text] = Field(default=(), description="Effects, name[:target]")
    start: dict[str, float] = Field(default={})
    """Initial values for identification, by parameter of an effect; those not given are searched
    for"""

    def text(self) -> str:
        """Return the model as TOML."""
        empty = {key for key in ("parent", "start") if not getattr(self, key)}
        return toml_text(self.model_dump(by_alias=True, exclude=empty))


def read_model_file(path: Path) -> ModelFile:
    """Read a ``model.toml`` of a run folder.

    Raises:
        InputError: the file is missing or damaged, or the folder of its parent is missing.
    """
    model = read(ModelFile, read_toml(path), str(path))
    if model.parent and not (path.parent.parent / model.parent / path.name).is_file():
        raise refusal("no_parent", str(path), model=model.name, parent=model.parent)
    return model
