"""Toy: reads the numbers of a session."""

import json
import os
from pathlib import Path

from made_results import write_result
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.files import write_json
from bampipe.progress import Progress
from bampipe.results.ingest import IngestResult
from bampipe.schema import STRICT

SUMMARY = "Read the numbers"
INPUTS = ()
OUTPUTS = ("ingest/session.json", "toy/numbers.json")


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """session: the folder; offset: added to each number."""

    session: str = ""
    offset: int = 0


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    log("toy_read")
    text = (Path(config.session) / "numbers.txt").read_text()
    if text == "crash":
        raise ZeroDivisionError("a fault of the stage")
    if text == "die":
        os.kill(os.getpid(), 9)
    try:
        numbers = [int(word) + config.offset for word in text.split()]
    except ValueError as error:
        raise InputError(str(error), where="numbers.txt", remedy="write whole numbers") from error
    write_result(out, IngestResult, device="bam", axes={"yaw": {}})
    write_json(out / "toy/numbers.json", {"numbers": numbers})
    return {"headline": f"{len(numbers)} numbers"}


def log(name: str) -> None:
    """Note that a toy ran, where the test asked for it."""
    path = os.environ.get("TOY_LOG")
    if path:
        with open(path, "a") as stream:
            stream.write(json.dumps(name) + "\n")
