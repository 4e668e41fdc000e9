"""Model versions in a run folder: the base model and its children.

A missing or damaged model raises `InputError`, which names the existing ones.
"""

import tomllib
from pathlib import Path

from bampipe.data.run_folder import BASE, RunFolder
from bampipe.declarations.model import ModelFile, read_model_file
from bampipe.errors import InputError, choose_from
from bampipe.files import digest_bytes, read_toml, write_text
from bampipe.results.ingest import IngestResult

_LONGEST = 160
"""Characters of a name that lists its effects; a file system takes 255."""
ADOPTED = "effects"
"""Folder beside the run folders with the lab's own effect files, for every run."""


def read(root: Path, name: str) -> ModelFile:
    """Read ``models/<name>/model.toml``."""
    known = RunFolder(root).models()
    if name not in known:
        remedy = choose_from(name, known or (BASE,))
        raise InputError(f"no model {name!r}", where=str(root), remedy=remedy)
    return read_model_file(root / "models" / name / "model.toml")


def choose_model(root: Path, name: str) -> str:
    """Return ``name``, or the default model if it is empty."""
    if name:
        read(root, name)
    return name or RunFolder(root).default_model()


def write(root: Path, model: ModelFile) -> None:
    """Write ``model`` below ``root``, whole or not at all, unless its content is unchanged."""
    path = root / "models" / model.name / "model.toml"
    text = model.text()
    if path.is_file():
        try:
            if read_toml(path) == tomllib.loads(text):
                return
        except InputError:
            path.unlink()
    write_text(path, text)


def ensure_base(root: Path, device: str, effects: tuple[str, ...]) -> None:
    """Write the base model, with the device of the pipeline or else of the session.

    The effects that the lab has adopted are copied beside it, for the diagnosis.

    Args:
        device: the pipeline's device; "" for that of ``ingest/session.json``.
        effects: the pipeline's effects; if there are none, those of the device file.
    """
    if not device:
        session = RunFolder(root).read(IngestResult)
        device = session.device
        effects = effects or session.default_effects
    adopted = (root.parent / ADOPTED).glob("*.toml")
    for source in sorted(path for path in adopted if not path.is_symlink()):
        text = source.read_text(encoding="utf-8")
        target = root / "models" / BASE / "effects" / source.name
        if not target.is_file() or target.read_text(encoding="utf-8") != text:
            write_text(target, text)
    write(root, ModelFile(name=BASE, device=device, effects=effects))


def child_name(parent: str, effects: tuple[str, ...]) -> str:
    """Return the name of the model that adds ``effects`` to ``parent``.

    Beyond `_LONGEST` characters, the number of effects and a digest stand for their names.
    """
    name = "+".join([parent, *(effect.replace(":", ".") for effect in effects)])
    if len(name) <= _LONGEST:
        return name
    return f"{parent}+{len(effects)}_effects_{digest_bytes(' '.join(effects).encode())[:6]}"
