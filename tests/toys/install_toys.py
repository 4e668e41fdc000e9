"""Make the toy stages of this folder the only ones, in this process."""

import sys
from pathlib import Path

import bampipe.stages
from bampipe.stages import base

TABLES = {
    "STAGES": ("toy_read", "toy_double", "toy_fit", "toy_sum"),
    "READS_SESSION": ("toy_read",),
    "PER_MODEL": ("toy_fit",),
}


def install() -> None:
    """Replace the stages of bampipe by the toys."""
    folder = str(Path(__file__).parent)
    sys.path.append(str(Path(__file__).parents[1]))  # for made_results
    if folder not in bampipe.stages.__path__:
        bampipe.stages.__path__.append(folder)
    for name, value in TABLES.items():
        setattr(base, name, value)


PIPELINE = """
schema = "bampipe.pipeline/1"
name = "toy"
stages = ["toy_read", "toy_double", "toy_fit", "toy_sum"]

[[gates]]
name = "small enough"
result = "toy/double.json"
value = "axes.*.value"
divide_by = "axes.*.scale"
max = 100.0
advice = "take smaller numbers"
"""

SESSION = """
schema = "bampipe.session/1"
session_id = "{name}"
device = "bam"

[[trials]]
file = "numbers.txt"
kind = "free"
"""


def make_session(folder: Path, numbers: str = "1 2 3") -> Path:
    """Write a toy session of one trial into ``folder`` and return it."""
    folder.mkdir(parents=True)
    (folder / "session.toml").write_text(SESSION.format(name=folder.name))
    (folder / "numbers.txt").write_text(numbers)
    return folder


def make_pipeline(folder: Path) -> Path:
    """Write the toy pipeline into ``folder`` and return its file."""
    path = folder / "toy.toml"
    path.write_text(PIPELINE)
    return path
