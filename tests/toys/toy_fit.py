"""Toy: one result a model."""

from pathlib import Path

from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import RunFolder
from bampipe.files import read_json, write_json
from bampipe.progress import Progress
from bampipe.schema import STRICT
from bampipe.stages.toy_read import log

SUMMARY = "Fit the numbers"
INPUTS = ("toy/double.json", "models/{model}/model.toml", "models/{model}/effects/*.toml")
OUTPUTS = ("models/{model}/fit.json",)


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """model: its name."""

    model: str = "base"


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    log(f"toy_fit:{config.model}")
    axes = read_json(run.path("toy/double.json"))["axes"]
    total = sum(axis["value"] for axis in axes.values())
    write_json(out / f"models/{config.model}/fit.json", {"total": total})
    return {"headline": f"total {total:g}"}
