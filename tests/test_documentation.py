"""What the documents say: their examples run, their names exist, their links lead somewhere."""

import re
import runpy
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from test_imports import LAWS

import bampipe
from bampipe.physics.expression import FUNCTIONS

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
INSTALL = (ROOT / "docs/install.md").read_text(encoding="utf-8")
NAMES_IN_CONDA = {"matplotlib": "matplotlib-base", "typst": "typst-py"}
DOCS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_all_functions_are_listed():
    text = (ROOT / "docs/effects.md").read_text(encoding="utf-8")
    assert set(re.search(r"^ {4}(sin .*)$", text, re.M)[1].split()) == set(FUNCTIONS)


@pytest.mark.parametrize("path", DOCS, ids=lambda p: p.name)
def test_links_lead_to_files(path):
    text = path.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
        if "://" not in link:
            assert (path.parent / link).exists(), link


def test_the_architecture_describes_every_room_and_no_other():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    table = text.partition("## The rooms\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \|.*\| `([^`]*)`(?:, `([^`]*)`)?[^|]* \|$", table, re.M)
    assert sorted(room for room, *_ in rows) == sorted(LAWS)
    for room, *files in rows:
        for file in filter(None, files):
            assert (ROOT / "bampipe" / room / file).is_file(), (room, file)


def test_the_drawing_of_the_rooms_is_the_law_of_imports():
    """An arrow stands for every room that may be imported and that no other way leads to."""
    below = {
        room: {name[8:] for name in law if name.startswith("bampipe.")} & set(LAWS)
        for room, law in LAWS.items()
    }
    expected = {
        (room, other)
        for room in below
        for other in below[room]
        if not any(other in _reach(below, between) for between in below[room] - {other})
    }
    items = list(ET.parse(ROOT / "docs/images/rooms.svg").iter())
    assert {item.get("data-room") for item in items} - {None} == set(LAWS)
    arrows = {(item.get("data-from"), item.get("data-to")) for item in items} - {(None, None)}
    assert arrows == expected


def test_the_tables_of_validation_are_those_of_the_stored_results():
    validation = runpy.run_path(str(ROOT / "benchmarks" / "validation.py"))
    pages = [path.read_text(encoding="utf-8") for path in validation["PAGES"]]
    assert len(validation["BLOCK"].findall(pages[0])) == len(validation["read_measured"]())
    assert len(validation["BLOCK"].findall(pages[1])) == 1
    assert [validation["fill"](page) for page in pages] == pages


def _reach(below, room):
    return {room}.union(*(_reach(below, other) for other in below[room]))


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_files_that_a_newcomer_is_sent_to_exist(name):
    text = re.sub(r"```.*?```", "", (ROOT / name).read_text(encoding="utf-8"), flags=re.S)
    text = re.sub(r"^\| `\w+` \|.*$", "", text, flags=re.M)  # the rooms, checked above
    paths = re.findall(r"`((?:[\w.]+/)+(?:\w+\.\w+)?)(?: [^`]*)?`", text)
    assert len(paths) > 10
    of_a_session = ("ingest/", "filter/", "models/", "report/report", "trials/t01", "dist/")
    for path in paths:
        if "NAME" not in path and not path.startswith(of_a_session):
            assert any((home / path).exists() for home in (ROOT, ROOT / "bampipe")), path


def read_yaml(name: str) -> dict[str, object]:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    content = yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))
    assert isinstance(content, dict)
    return content


def test_recipe_citation_and_documents_are_of_this_version() -> None:
    recipe = read_yaml(".ci/conda/recipe.yaml")
    split = (re.fullmatch(r"([\w-]+)(.*)", text) for text in PROJECT["dependencies"])
    wanted = [f"{NAMES_IN_CONDA.get(m[1], m[1])} {m[2]}" for m in split if m]
    assert recipe["requirements"]["run"] == [f"python {PROJECT['requires-python']}", *wanted]
    assert recipe["context"]["version"] == bampipe.__version__
    assert recipe["about"]["summary"] == PROJECT["description"]
    assert recipe["about"]["license"] == PROJECT["license"]
    assert recipe["about"]["license_file"] == PROJECT["license-files"]
    citation = read_yaml("CITATION.cff")
    assert citation["version"] == bampipe.__version__
    assert citation["abstract"] == PROJECT["description"]
    assert citation["keywords"] == PROJECT["keywords"]
    classified = re.findall(r":: Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    head = INSTALL.partition("## Supported range")[2]
    stated = re.search(r"Python ([\d., and]+);", head)
    assert stated is not None and re.findall(r"3\.\d+", stated[1]) == classified
    assert set(re.findall(r"^\| (3\.\d+) \|", head, re.M)) == set(classified)
    table = INSTALL.partition("## Extras")[2].partition("\n## ")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.M) == list(PROJECT["optional-dependencies"])
