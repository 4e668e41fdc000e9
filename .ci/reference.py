"""The reference pages of the site, made from the declarations: commands, settings, files, library.

`pages` gives their Markdown; `site_hooks.py` puts it into the site.
"""

from __future__ import annotations

import inspect
import json
import re
import runpy
import textwrap
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

import bampipe
from bampipe.cli.app import app
from bampipe.cli.effects import parameter_rows
from bampipe.data.session import Session
from bampipe.declarations.accepted import Accepted
from bampipe.declarations.model import ModelFile
from bampipe.declarations.pipeline import Pipeline
from bampipe.physics import registry
from bampipe.physics.device import Device
from bampipe.physics.effect import Effect
from bampipe.schema import json_schema
from bampipe.stages import base

FILES: Mapping[str, tuple[type, str]] = {
    "session.toml": (Session, "A session: signals and trials ([guide](../raw_log_format.md))."),
    "device file": (Device, "One mechanism ([guide](../devices.md))."),
    "effect file": (Effect, "One physical term ([guide](../effects.md))."),
    "pipeline file": (Pipeline, "Stages, their settings, gates ([guide](../ci.md))."),
    "model.toml": (ModelFile, "One model version in a run folder; bampipe writes it."),
    "accepted file": (Accepted, "What later runs are held against; `bampipe accept` writes it."),
}  # fmt: skip
RECORDS: Mapping[str, type] = {
    kind.FILE.rpartition("/")[2]: kind
    for kind in runpy.run_path(str(Path(__file__).with_name("write_schemas.py")))["FILES"].values()
    if hasattr(kind, "FILE")
}
"""The JSON files that a run, a lab or a simulation writes, by name."""


def pages() -> dict[str, str]:
    """Markdown of each page, by its name in the folder `reference/`."""
    return {
        "commands.md": commands(),
        "settings.md": settings(),
        "files.md": files(),
        "results.md": results(),
        "effects.md": effects(),
        "devices.md": devices(),
        "python.md": python(),
        "versions.md": versions(),
    }


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    cells = [[*head], *([*row] for row in rows)]
    lines = ["| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in cells]
    return "\n".join([lines[0], "|" + "---|" * len(cells[0]), *lines[1:]]) + "\n"


def code(text: str) -> str:
    """``text`` in backticks."""
    return f"`{text}`"


def leaves(group: Any, name: str = "bampipe") -> Iterator[tuple[str, Any]]:
    """Every command, by its full name; one with commands of its own is none itself."""
    for key, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from leaves(command, f"{name} {key}")
        else:
            yield f"{name} {key}", command


def all_commands() -> dict[str, Any]:
    """Every command of the program, by its full name."""
    return dict(leaves(typer.main.get_command(app)))


def commands() -> str:
    """The page of the commands, every argument and option of them."""
    text = [
        "# Commands\n",
        "Every command, argument and option. `bampipe COMMAND --help` prints the same.\n",
    ]
    for name, command in all_commands().items():
        context = command.make_context(name, [], resilient_parsing=True)
        about, *examples = (command.help or "").split("\n\nExample: ")
        text += [f"## {name}\n", about + "\n"]
        records = [parameter.get_help_record(context) for parameter in command.params]
        rows = [(code(names), plain_text(words)) for names, words in filter(None, records)]
        if rows:
            text.append(table(("argument or option", "meaning"), rows))
        if examples:
            shown = "\n".join(" ".join(line.split()) for line in examples)
            text.append(f"```sh\n{shown}\n```\n")
    return "\n".join(text)


def plain_text(words: str) -> str:
    """``words`` with nothing in them that Markdown would take for markup."""
    return re.sub(r"([*_<\[])", r"\\\1", words)


def settings() -> str:
    """The page of the settings of every stage."""
    text = [
        "# Settings of the stages\n",
        "For one run, `bampipe run SESSION --set STAGE.NAME=VALUE`, or `--set NAME=VALUE` with the "
        "command of the stage; for good, `[settings.STAGE]` in a [pipeline file](files.md).\n",
    ]
    for name in base.STAGES:
        stage = base.load_stage(name)
        text += [f"## {name}\n", f"{stage.SUMMARY}.\n"]
        words = described(stage.Config)
        rows = [
            (code(key), code(json.dumps(value)), words[key])
            for key, value in asdict(stage.Config()).items()
            if key not in ("session", "model")
        ]
        text.append(table(("setting", "default", "meaning"), rows) if rows else "None.\n")
    return "\n".join(text)


def described(config: type) -> dict[str, str]:
    """What the docstring of a configuration says of each field."""
    words: dict[str, str] = {}
    for kind in config.__mro__[:-1]:
        part = textwrap.dedent((inspect.getdoc(kind) or "").partition("Attributes:\n")[2])
        entries = re.findall(r"^(\w[\w, ]*): (.*(?:\n(?: .*)?)*)", part, re.M)
        for names, meaning in entries:
            for name in names.split(", "):
                words.setdefault(name, sentence(" ".join(meaning.replace("``", "`").split())))
    return words


def sentence(words: str) -> str:
    """``words`` with a capital letter; names in backticks keep theirs."""
    return words[:1].upper() + words[1:]


KIND = "What kind of file this is, and the version of its format"


def files() -> str:
    """The page of the files that a person writes, field by field."""
    text = [
        "# Files\n",
        "Every field of the files that bampipe reads. Editors that know JSON Schema take the same "
        "from `schemas/`.\n",
    ]
    for name, (kind, about) in FILES.items():
        text += file_tables(name, kind, about)
    return "\n".join(text)


def results() -> str:
    """The page of the JSON files of a run folder, field by field."""
    text = [
        "# Results\n",
        "Every field of the JSON files that a run or a lab writes. `schemas/` holds the same as "
        "JSON Schema; [The run folder](../run_folder.md) says which file is what. A field without "
        "a meaning here is what its name says. Values are in SI units.\n",
    ]
    for name, kind in RECORDS.items():
        text += file_tables(name, kind, (inspect.getdoc(kind) or "").partition("\n")[0])
    return "\n".join(text)


def file_tables(name: str, kind: type, about: str) -> list[str]:
    """Heading and tables of one file: its own fields, then those of each table in it."""
    schema = json_schema(kind)
    text = [f"## {name} {{#{anchor(name)}}}\n", about + "\n", fields(schema, name)]
    for key, node in schema.get("$defs", {}).items():
        if "properties" in node:
            text.append(f"### {name}: {key} {{#{anchor(name, key)}}}\n")
            text += [node.get("description", "") + "\n", fields(node, name)]
    return text


def anchor(name: str, key: str = "") -> str:
    """The identifier of the table ``key`` of the file ``name``."""
    return "-".join(filter(None, (re.sub(r"\W", "-", name), key))).lower()


def fields(node: Mapping[str, Any], name: str) -> str:
    """The fields of one table."""
    rows = []
    for key, entry in node["properties"].items():
        default = entry.get("default")
        shown = (
            "" if default in ("", None, []) or isinstance(default, dict) else json.dumps(default)
        )
        needed = "**required**" if key in node.get("required", ()) else shown and code(shown)
        about = KIND if key == "schema" else entry.get("description", "")
        rows.append((code(key), kind_of(entry, name), needed, sentence(plain_text(about))))
    return table(("field", "type", "default", "meaning"), rows)


_PLAIN = {"string": "text", "number": "number", "integer": "whole number", "boolean": "true, false"}


def kind_of(node: Mapping[str, Any], name: str) -> str:
    """What may stand in a field, in words; a table by a link to its fields."""
    if "$ref" in node:
        key = node["$ref"].rpartition("/")[2]
        return f"[{key}](#{anchor(name, key)})"
    if "const" in node:
        return code(json.dumps(node["const"]))
    if "enum" in node:
        return ", ".join(code(json.dumps(v)) for v in node["enum"] if v is not None)
    for several in ("anyOf", "oneOf"):
        if several in node:
            kinds = [kind_of(n, name) for n in node[several] if n.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds))
    kinds = node.get("type", [])
    kind = next((k for k in ([kinds] if isinstance(kinds, str) else kinds) if k != "null"), "any")
    if kind == "array":
        inner = node.get("items") or (node.get("prefixItems") or [{}])[0]
        return f"list of {kind_of(inner, name)}" if inner else "list"
    if kind == "object":
        inner = next(iter(node.get("patternProperties", {}).values()), None)
        inner = inner or node.get("additionalProperties")
        return f"table of {kind_of(inner, name)}" if isinstance(inner, Mapping) else "table"
    bounds = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    limits = [f"{sign} {node[key]:g}" for key, sign in bounds.items() if key in node]
    return ", ".join([_PLAIN.get(kind, kind), *limits])


def effects() -> str:
    """The page of the library of effects."""
    text = [
        "# Library of effects\n",
        "The built-in effects, each one file; `bampipe effects NAME` adds a picture of what it "
        "leaves in a residual. How to write your own: [Effects](../effects.md).\n",
    ]
    for name in registry.effect_names():
        effect = registry.effect(name)
        formulas = "\n".join(effect.formulas)
        text += [f"## {name}\n", f"{effect.summary}.\n", f"```\n{formulas}\n```\n"]
        facts = [
            ("acts on", effect.scope.replace("_", " ")),
            ("looks like", effect.looks_like),
            ("on the machine", effect.on_the_machine),
            ("source", effect.source),
        ]
        text.append("\n".join(f"- **{k}**: {plain_text(v)}" for k, v in facts if v) + "\n")
        head = ("parameter", "axis", "unit", "prior", "sd", "lower", "upper", "typical", "meaning")
        rows = [
            [code(str(row[0])), *("" if cell is None else str(cell) for cell in row[1:])]
            for row in parameter_rows(effect)
        ]
        used = [place for place in range(len(head)) if any(row[place] for row in rows)]
        text.append(table((head[i] for i in used), ([row[i] for i in used] for row in rows)))
    return "\n".join(text)


def devices() -> str:
    """The page of the built-in devices."""
    text = ["# Built-in devices\n", "Write your own: [Devices](../devices.md).\n"]
    for name in registry.device_names():
        device = registry.device(name)
        text += [f"## {name}\n", f"{device.summary}.\n"]
        rows = [(code(c.name), c.symbol, c.kind, c.unit, c.torque_unit) for c in device.coordinates]
        text.append(table(("axis", "symbol", "kind", "unit", "unit of force"), rows))
        used = [
            effect for effect in registry.effect_names() if registry.effect(effect).targets(device)
        ]
        text.append("Effects: " + ", ".join(f"[{e}](effects.md#{e})" for e in used) + ".\n")
    return "\n".join(text)


def python() -> str:
    """The page of what programs call: the docstrings, filled in by mkdocstrings."""
    text = [
        "# Python\n",
        "What `import bampipe` offers, from its docstrings ([guide](../api.md)).\n",
    ]
    for name in bampipe.__all__:
        home: Callable[..., object] = getattr(bampipe, name)
        text.append(f"::: {home.__module__}.{home.__name__}\n")
    return "\n".join(text)


def versions() -> str:
    """The page of the versions: what is asked for, and what `constraints.txt` holds."""
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned: dict[str, list[str]] = {}
    for line in (root / "constraints.txt").read_text(encoding="utf-8").splitlines():
        name, _, version = line.partition(" ;")[0].partition("==")
        pinned.setdefault(name.lower(), []).append(version)
    extras = {"": project["dependencies"], **project["optional-dependencies"]}
    rows = []
    for extra, wanted in extras.items():
        for text in wanted:
            name, span = re.match(r"([\w.-]+)(?:\[.*\])?(.*)", text).groups()  # type: ignore[union-attr]
            if name != project["name"]:
                rows.append(
                    (name, span, ", ".join(pinned.get(name.lower(), ())), extra and code(extra))
                )
    text = (
        "# Versions\n",
        f"These pages are of bampipe {bampipe.__version__}, for Python "
        f"{project['requires-python']} ([what was run](../install.md#supported-range)).\n",
        table(("library", "range", "in constraints.txt", "extra"), rows),
    )
    return "\n".join(text)
