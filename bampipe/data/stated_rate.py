"""The sample rate if no column is a time: as stated by the file, or by one beside it."""

import re
from collections.abc import Collection, Iterator
from itertools import chain
from pathlib import Path

from bampipe.data.guesses import RATES_HZ
from bampipe.data.names import role_of
from bampipe.data.readers import extension_of, hdf5, is_text, text
from bampipe.data.readers.trial import NUMBER
from bampipe.data.units import unit
from bampipe.data.vocabulary import word_set

SMALL = 1 << 16
"""Bytes below which a text is read as notes on logs, or may be no log but a line of results."""
_NOTES = word_set("notes")
"""File extensions of texts about logs."""
_STATEMENT = re.compile(
    r"(?P<name>[A-Za-z][\w .-]*?)\s*(?:[\[(](?P<of>[^\])\d]*)[\])])?"
    r"[\"']?\s*[=:;,\t ]{1,3}\s*[\"']?"
    rf"(?P<value>{NUMBER})[ \t]*[\[(]?(?P<unit>[A-Za-z]+(?:/s)?)?"
)
_SAMPLES = r"(?:data|sampl\w*|abtast|scan|acquisition|logging|log|recording|frame)"
_RATE = re.compile(rf"fs|fps|fsample|{_SAMPLES}(?:rate|freq\w*)")
_INTERVAL = re.compile(
    rf"ts|dt|tsample|delta[tx]|interval|{_SAMPLES}(?:time|period|zeit|interval\w*)"
)
_PER_SECOND = ("S/s", "sps", "SPS")


def interval_of(name: str, value: float, said: str = "") -> float:
    """Sampling interval, s, that a number beside the samples gives (``Ts``, ``fs``), else 0.

    ``said``: its unit, where that is no part of the name.
    """
    bare = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name.rpartition(".")[2])
    words = re.split(r"[\W_]+", bare.strip())
    if not said and len(words) > 1 and (words[-1] == "s" or unit(words[-1].replace("hz", "Hz"))):
        said = words.pop().replace("hz", "Hz")
    plain, known = "".join(words).lower(), unit(said) if said and said not in _PER_SECOND else None
    rate = _RATE.fullmatch(plain) is not None
    if value <= 0.0 or not (rate or _INTERVAL.fullmatch(plain)):
        return 0.0
    if known is not None and known.si != ("Hz" if rate else "s"):
        return 0.0
    size = value * (known.scale if known is not None else 1.0)
    step = 1.0 / size if rate else size
    return step if RATES_HZ[0] <= 1.0 / step <= RATES_HZ[1] else 0.0


def intervals_stated(folder: Path, logs: Collection[str]) -> dict[str, float]:
    """Sampling intervals, s, by file and name: of ``logs``, and of notes written beside them."""
    found = dict[str, float]()
    for path in [*(folder / name for name in sorted(logs)), *_notes(folder)]:
        file = path.relative_to(folder).as_posix()
        for name, value, said in _numbers_of(path, file in logs):
            step = interval_of(name, value, said)
            found |= {f"{name} in {file}": step} if step else {}
    return found


def units_stated(
    folder: Path, logs: Collection[str], names: Collection[str]
) -> dict[str, tuple[str, str]]:
    """Units of columns stated by texts beside ``logs`` (``torque: N mm``), and the file.

    A line begins with the name of the column, or has it in quotes. Units that contradict one
    another, or the name, are left out.
    """
    found: dict[str, dict[str, str]] = {}
    for path in _notes(folder) if names else ():
        file = path.relative_to(folder).as_posix()
        said = path.read_text("utf-8", "replace") if file not in logs else ""
        for name in names:
            line = rf"(?im)(?:^[\W_]*|[\"',{{]\s*){re.escape(name)}[\"'`*]*[\s:=|,([-]+(.*)"
            for match in re.finditer(line, said):
                parts = map(str.strip, re.split(r"[][(){},;|\"']|\bin\b", match[1]))
                known = (x for x in parts if not re.match(r"[^\WsmgNAV]?\Z|\d", x) and unit(x))
                own = next((x for x in known if role_of(name, "") in ("", role_of("", x))), "")
                found.setdefault(name, {}).update({own: file} if own else {})
    agreed = {name: own for name, own in found.items() if len({unit(x) for x in own}) == 1}
    return {name: next(iter(own.items())) for name, own in agreed.items()}


def _notes(folder: Path) -> list[Path]:
    notes = (path for path in sorted(folder.rglob("*")) if extension_of(path.name) in _NOTES)
    return [p for p in notes if p.is_file() and p.stat().st_size < SMALL]


def _numbers_of(path: Path, is_log: bool) -> Iterator[tuple[str, float, str]]:
    """Names, values and units of the numbers that a log states above its samples, or a note."""
    if extension_of(path.name) in hdf5.ENDINGS:
        yield from ((name, value, "") for name, value in hdf5.numbers_of(path).items())
        return
    if not is_log:
        said = path.read_text("utf-8", "replace")
    else:
        said = text.above_samples(path) if is_text(path.name) else ""
    for match in chain.from_iterable(map(_STATEMENT.finditer, said.splitlines())):
        yield match["name"], float(match["value"]), match["of"] or match["unit"] or ""
