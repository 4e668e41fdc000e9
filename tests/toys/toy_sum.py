"""Toy: sums up whatever fits there are."""

from pathlib import Path

from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import RunFolder
from bampipe.files import read_json, write_json
from bampipe.progress import Progress
from bampipe.schema import STRICT
from bampipe.stages.toy_read import log

SUMMARY = "Sum up"
INPUTS = ("models/*/fit.json", "toy/absent.json?")
OUTPUTS = ("sum.json",)


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Nothing to set."""


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    log("toy_sum")
    totals = {name: read_json(run.path(name))["total"] for name in run.glob("models/*/fit.json")}
    write_json(out / "sum.json", totals)
    return {"totals": totals}
