"""Model versions in a run folder: the base model and its children."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

from bampipe.errors import InputError
from bampipe.files import read_toml
from bampipe.run import record
from bampipe.run.settings import did_you_mean

SCHEMA = "bampipe.model/1"
BASE = "base"


@dataclass(frozen=True)
class ModelFile:
    """What ``models/<name>/model.toml`` says.

    Attributes:
        name: name of the model; a child's is its parent's, ``+`` and the effect added.
        parent: name of the parent, "" for the base model.
        device: name of the device.
        effects: effects, ``name[:target]``.
    """

    name: str
    parent: str
    device: str
    effects: tuple[str, ...]

    def text(self) -> str:
        """Return the model as TOML."""
        lines = [f"schema = {json.dumps(SCHEMA)}", f"name = {json.dumps(self.name)}"]
        if self.parent:
            lines.append(f"parent = {json.dumps(self.parent)}")
        lines.append(f"device = {json.dumps(self.device)}")
        lines.append(f"effects = [{', '.join(json.dumps(effect) for effect in self.effects)}]")
        return "\n".join(lines) + "\n"


def names(root: Path) -> tuple[str, ...]:
    """Return the models of the run folder ``root``: parents before children, then by name."""
    found = (path.parent.name for path in (root / "models").glob("*/model.toml"))
    return tuple(sorted(found, key=lambda name: (name != BASE, name.count("+"), name)))


def read(root: Path, name: str) -> ModelFile:
    """Read ``models/<name>/model.toml``.

    Raises:
        InputError: there is none, it is damaged, or its parent is missing.
    """
    path = root / "models" / name / "model.toml"
    if name not in names(root):
        known = names(root) or (BASE,)
        raise InputError(f"no model {name!r}", where=str(root), remedy=did_you_mean(name, known))
    content = read_toml(path)
    device, effects = content.get("device"), content.get("effects", [])
    if not isinstance(device, str):
        raise InputError("device must be a text", where=str(path))
    if not isinstance(effects, list) or not all(isinstance(item, str) for item in effects):
        raise InputError("effects must be a list of texts", where=str(path))
    parent = content.get("parent", "")
    if not isinstance(parent, str):
        raise InputError("parent must be a text", where=str(path))
    if parent and parent not in names(root):
        raise InputError(
            f"model {name!r} has parent {parent!r}, which is missing",
            where=str(path),
            remedy="restore the parent's folder, or remove the child's",
        )
    return ModelFile(name, parent, device, tuple(effects))


def write(root: Path, model: ModelFile) -> None:
    """Write ``model`` below ``root``, whole or not at all; one that says the same is left."""
    path = root / "models" / model.name / "model.toml"
    text = model.text()
    if path.is_file():
        try:
            if tomllib.loads(path.read_text(encoding="utf-8")) == tomllib.loads(text):
                return
        except (tomllib.TOMLDecodeError, UnicodeDecodeError):
            path.unlink()
    record.replace_text(path, text)


def ensure_base(root: Path, device: str, effects: tuple[str, ...]) -> None:
    """Write the base model: the device that the pipeline or else the session names.

    Args:
        root: the run folder; ``ingest/session.json`` must be there where ``device`` is "".
        device: the pipeline's device, or "".
        effects: the pipeline's effects of the base model; without any, those that the device file
            gives it.
    """
    if not device:
        session = root / "ingest" / "session.json"
        if not session.is_file():
            raise InputError(
                "ingest/session.json is missing",
                where=str(root),
                remedy="run `bampipe ingest SESSION` first",
            )
        about = json.loads(session.read_text(encoding="utf-8"))
        device = str(about["device"])
        effects = effects or tuple(map(str, about.get("default_effects", [])))
    write(root, ModelFile(BASE, "", device, effects))


def child_name(parent: str, effect: str) -> str:
    """Return the name of the model that adds ``effect`` to ``parent``."""
    return f"{parent}+{effect.replace(':', '.')}"
