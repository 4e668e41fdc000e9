"""Verification of every hash that a run records."""

from pathlib import Path

from bampipe.data.run_folder import RunFolder
from bampipe.files import digest_file, digest_input
from bampipe.results.run import PRIVATE, SESSION
from bampipe.run import hashing, record
from bampipe.stages import base


def verify(root: Path) -> list[tuple[str, str]]:
    """Recompute every hash that ``run.json`` records.

    Returns:
        Pairs of a file and its state: "changed", "gone", or "unknown" for a file that no stage
        recorded; ``run.json`` itself may be "damaged". Empty if all is as it was written.
    """
    content = record.read(root)
    found: dict[str, str] = {record.FILE: "damaged"} if record.is_damaged(root) else {}
    recorded: set[str] = {record.FILE}
    for made in content.stages.values():
        inputs = {n: d for n, d in made.inputs.items() if not n.startswith(SESSION)}
        for names, digest in ((made.outputs, digest_file), (inputs, digest_input)):
            for name, written in names.items():
                recorded.add(name)
                path = root / name
                # Text inputs of a stage are checked here, all others as outputs of their stage.
                held = names is made.outputs or path.suffix == ".toml"
                if not path.is_file():
                    found.setdefault(name, "gone")
                elif held and digest(path) != written:
                    found.setdefault(name, "changed")
    place = content.place.session
    for stage in {*base.READS_SESSION} & content.stages.keys():
        if place is None or not Path(place).is_dir():
            found["session"] = "gone"
            continue
        noted, now = content.stages[stage].inputs, hashing.digest_session(Path(place))
        for name in noted | now:
            if name.startswith(SESSION) and noted.get(name) != now.get(name):
                gone = now.get(name) in (None, hashing.ABSENT)
                found[name] = "gone" if gone else "changed"
    for name in RunFolder(root).glob("**/*"):
        if name.partition("/")[0] != PRIVATE and name not in recorded:
            found[name] = "unknown"
    return sorted(found.items())
