"""Where a step writes before it counts: results reach the run folder whole or not at all.

A step writes below ``.bampipe/staging/``. Once it is done, a commit file says what it made; from
then on a kill loses nothing, since the next run repeats the moves that the commit file names.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from bampipe.errors import InputError
from bampipe.files import digest_file, is_inside, read_json_table
from bampipe.run import record
from bampipe.run.request import Step
from bampipe.run.state import RunState

if TYPE_CHECKING:
    from bampipe.results.run import StepRecord, Timing

COMMIT = ".commit.json"


def folder(root: Path, step: Step) -> Path:
    """Return the staging folder of ``step`` in the run folder ``root``."""
    return root / record.PRIVATE / "staging" / folder_name(step.name)


def folder_name(step: str) -> str:
    """Return what the staging folder of the step named ``step`` is called."""
    return step.replace(":", "@")


def prepare(root: Path, step: Step, outputs: tuple[str, ...]) -> Path:
    """Make an empty staging folder with the parents of all declared ``outputs``."""
    staging = folder(root, step)
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(parents=True)
    for pattern in outputs:
        fixed = pattern.partition("*")[0]
        (staging / fixed).parent.mkdir(parents=True, exist_ok=True)
        if fixed.endswith("/"):
            (staging / fixed).mkdir(parents=True, exist_ok=True)
    return staging


def written(staging: Path, declared: tuple[str, ...], step: Step) -> dict[str, str]:
    """Hash what a stage wrote, and hold it to what it declared."""
    files = {
        path.relative_to(staging).as_posix(): path
        for path in sorted(staging.rglob("*"))
        if path.is_file()
    }
    allowed: set[str] = set()
    for pattern in declared:
        if "*" in pattern:
            allowed |= {
                path.relative_to(staging).as_posix()
                for path in staging.glob(pattern)
                if path.is_file()
            }
        elif pattern in files:
            allowed.add(pattern)
        else:
            raise RuntimeError(f"stage {step.name} did not write {pattern}, which it declares")
    undeclared = sorted(files.keys() - allowed)
    if undeclared:
        raise RuntimeError(f"stage {step.name} wrote {undeclared[0]}, which it does not declare")
    return {name: digest_file(path) for name, path in files.items()}


def seal(staging: Path, step: Step, made: StepRecord, timing: Timing, remove: list[str]) -> None:
    """Write the commit file: from here on the step counts as done.

    Args:
        staging: the staging folder of the step.
        step: the step.
        made: its record for ``run.json``.
        timing: when it ran and how long.
        remove: outputs of its last run that it no longer has.
    """
    entry = {
        "step": step.name,
        "record": made.model_dump(mode="json"),
        "timing": timing.model_dump(mode="json"),
        "remove": remove,
    }
    record.replace_json(staging / COMMIT, entry)


def commit(state: RunState, staging: Path) -> None:
    """Move the outputs of a sealed step into the run folder; may be repeated."""
    from bampipe.results.run import StepRecord, Timing

    entry = read_json_table(staging / COMMIT)
    made = StepRecord.model_validate(entry["record"])
    for relative in made.outputs:
        source, target = staging / relative, state.root / relative
        if source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            source.replace(target)
    for relative in entry["remove"]:
        (state.root / relative).unlink(missing_ok=True)
    state.records[entry["step"]] = made
    state.failures.pop(entry["step"], None)
    state.timings[entry["step"]] = Timing.model_validate(entry["timing"])
    state.save()
    shutil.rmtree(staging)


def recover(state: RunState) -> None:
    """Finish what a killed run had completed, drop what it had not."""
    record.draft_of(state.root / record.FILE).unlink(missing_ok=True)
    for draft in state.root.glob("models/*/.model.toml.part"):
        draft.unlink()
    parent = state.root / record.PRIVATE / "staging"
    for staging in sorted(parent.glob("*")):
        if not staging.is_dir():
            staging.unlink()
        elif (staging / COMMIT).is_file() and _is_complete(state.root, staging):
            commit(state, staging)
        else:
            shutil.rmtree(staging)


def _is_complete(root: Path, staging: Path) -> bool:
    """Whether the commit file, and what it names and is still here, is as it was sealed."""
    try:
        entry = read_json_table(staging / COMMIT)
    except InputError:
        return False
    step, remove = entry.get("step"), entry.get("remove")
    made = record.sound_step(entry.get("record"))
    if not isinstance(step, str) or folder_name(step) != staging.name:
        return False
    if made is None or not record.is_timing(entry.get("timing")):
        return False
    if not isinstance(remove, list) or not record.are_results(remove):
        return False
    names = (*made.outputs, *remove)
    if not all(is_inside(root, name) and not (root / name).is_dir() for name in names):
        return False
    return all(
        is_inside(staging, name) and digest_file(staging / name) == digest
        for name, digest in made.outputs.items()
        if (staging / name).is_file()
    )
