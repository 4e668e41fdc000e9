"""What describes the package elsewhere says the same as pyproject.toml."""

import re
import tomllib
from pathlib import Path

import pytest

import bampipe

yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
INSTALL = (ROOT / "docs/install.md").read_text(encoding="utf-8")
NAMES_IN_CONDA = {"matplotlib": "matplotlib-base", "typst": "typst-py"}


def read_yaml(name: str) -> dict[str, object]:
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
