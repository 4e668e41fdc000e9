"""Staging of a step's outputs, so that results reach the run folder complete or not at all.

A step writes below ``.bampipe/staging/``. When it is done, a commit file lists its outputs. From
then on a kill loses nothing, since the next run repeats the moves of the commit file.
"""

import shutil
from pathlib import Path

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.files import digest_file, is_inside, read_json_table
from bampipe.results.run import PRIVATE, Commit
from bampipe.run import record
from bampipe.run.state import RunState
from bampipe.schema import read

COMMIT = ".commit.json"


def folder(root: Path, step: str) -> Path:
    """Return the staging folder of ``step``, as in ``run.json``, in the run folder ``root``."""
    return root / PRIVATE / "staging" / step.replace(":", "@")


def prepare(root: Path, step: str, outputs: tuple[str, ...]) -> Path:
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


def digest_outputs(staging: Path, declared: tuple[str, ...], step: str) -> dict[str, str]:
    """Hash the outputs of a stage, and compare them with its declaration."""
    written, files = RunFolder(staging), RunFolder(staging).glob("**/*")
    for pattern in declared:
        if "*" not in pattern and pattern not in files:
            raise RuntimeError(f"stage {step} did not write {pattern}, which it declares")
    allowed = {name for pattern in declared for name in written.glob(pattern)}
    undeclared = sorted({*files} - allowed)
    if undeclared:
        raise RuntimeError(f"stage {step} wrote {undeclared[0]}, which it does not declare")
    return {name: digest_file(staging / name) for name in files}


def commit(state: RunState, staging: Path, sealed: Commit) -> None:
    """Move the outputs of a sealed step into the run folder; may be repeated."""
    for relative in sealed.record.outputs:
        source, target = staging / relative, state.root / relative
        if source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            source.replace(target)
    for relative in sealed.remove:
        (state.root / relative).unlink(missing_ok=True)
    state.records[sealed.step] = sealed.record
    state.failures.pop(sealed.step, None)
    state.timings[sealed.step] = sealed.timing
    state.save()
    shutil.rmtree(staging)


def recover(state: RunState) -> None:
    """Finish the completed steps of a killed run, and drop the others."""
    for pattern in (f".{record.FILE}.*.partial", "models/*/.model.toml.*.partial"):
        for draft in state.root.glob(pattern):
            draft.unlink()
    parent = state.root / PRIVATE / "staging"
    for staging in sorted(parent.glob("*")):
        if not staging.is_dir():
            staging.unlink()
        elif sealed := _sealed(state.root, staging):
            commit(state, staging, sealed)
        else:
            shutil.rmtree(staging)


def _sealed(root: Path, staging: Path) -> Commit | None:
    """Return the commit file's content, if it and the remaining files that it names are intact."""
    try:
        sealed = read(Commit, read_json_table(staging / COMMIT), COMMIT)
    except InputError:
        return None
    outputs = sealed.record.outputs
    is_sound = folder(root, sealed.step) == staging and all(
        is_inside(root, name) and is_inside(staging, name) and not (root / name).is_dir()
        for name in (*outputs, *sealed.remove)
    )
    files = {staging / name: digest for name, digest in outputs.items()} if is_sound else {}
    intact = all(not f.is_file() or digest_file(f) == digest for f, digest in files.items())
    return sealed if is_sound and intact else None
