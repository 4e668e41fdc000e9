"""Toy: doubles the numbers, slowly or in worker processes where the test asks for it."""

import os
import time
from functools import partial
from pathlib import Path

from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import RunFolder
from bampipe.files import read_json, write_json
from bampipe.progress import Progress
from bampipe.schema import STRICT
from bampipe.stages.toy_read import log
from bampipe.workers import process_pool

SUMMARY = "Double the numbers"
INPUTS = ("toy/numbers.json",)
OUTPUTS = ("toy/double.json", "toy/parts/*.json")


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """factor: of the doubling; label: a text."""

    factor: float = 2.0
    label: str = ""


def multiply(factor: float, number: float) -> float:
    """Note the process in a folder, wait, and multiply."""
    folder = Path(os.environ["TOY_WORKERS"])
    folder.mkdir(exist_ok=True)
    (folder / str(os.getpid())).touch()
    time.sleep(float(os.environ.get("TOY_PAUSE", "0")))
    return factor * number


def multiply_all(numbers: list[float], factor: float) -> list[float]:
    jobs = int(os.environ.get("TOY_JOBS", "0"))
    if not jobs:
        return [factor * number for number in numbers]
    with process_pool(jobs, os.getpid) as pool:
        return list(pool.map(partial(multiply, factor), numbers))


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    log("toy_double")
    numbers = read_json(run.path("toy/numbers.json"))["numbers"]
    doubled = multiply_all(numbers, config.factor)
    for index, value in enumerate(doubled):
        write_json(out / f"toy/parts/{index}.json", {"value": value})
        progress(index / len(doubled), f"number {index}")
        time.sleep(float(os.environ.get("TOY_PAUSE", "0")))
    axes = {f"n{index}": {"value": value, "scale": 1} for index, value in enumerate(doubled)}
    write_json(out / "toy/double.json", {"axes": axes})
    return {"headline": f"times {config.factor:g}", "axes": axes}
