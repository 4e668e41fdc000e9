"""Where measured data of other labs lie, and how these tests run the program on them."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
REAL = ROOT.parent / "shared" / "real"


def need(path: Path) -> Path:
    """The path, or skip the test."""
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return path


def bampipe(*arguments: object) -> None:
    """Run the command line and require success."""
    command = [sys.executable, "-m", "bampipe", *map(str, arguments), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def result(run: Path, name: str) -> Any:
    """One JSON result of a run folder."""
    return json.loads((run / name).read_text())


def estimates(run: Path, model: str = "base") -> dict[str, float]:
    """Identified parameters by name."""
    parameters = result(run, f"models/{model}/identify.json")["parameters"]
    return {name: entry["estimate"] for name, entry in parameters.items()}
