"""The notebook in docs/: its code runs as it stands, and the outputs stored are those it gives."""

import ast
import json
from pathlib import Path

import matplotlib
import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "positioning_axis.ipynb"


def code_cells() -> list[dict]:
    """The code cells with their stored outputs."""
    content = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return [cell for cell in content["cells"] if cell["cell_type"] == "code"]


def test_outputs_and_figures_are_kept():
    cells = code_cells()
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [o for o in outputs if o["output_type"] == "error" or o.get("name") == "stderr"]
    assert sum("image/png" in o.get("data", {}) for o in outputs) == 3
    assert "/tmp" not in NOTEBOOK.read_text(encoding="utf-8")


@pytest.mark.long
def test_the_code_gives_the_numbers_that_are_stored(monkeypatch):
    monkeypatch.chdir(NOTEBOOK.parent)
    matplotlib.use("Agg")
    names: dict[str, object] = {}
    cells = code_cells()
    for cell in cells:
        exec(compile("".join(cell["source"]), NOTEBOOK.name, "exec"), names)
    stored = ast.literal_eval("".join(cells[-1]["outputs"][0]["data"]["text/plain"]))
    found = names["key_numbers"]
    assert found.keys() == stored.keys()
    for name, value in found.items():
        expected = value if isinstance(value, str) else pytest.approx(value, rel=0.01)
        assert stored[name] == expected, f"{name}: run the notebook again (docs/api.md)"
