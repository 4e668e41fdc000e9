"""Column names parsed into words, the unit and the role of the quantity that they name."""

import re
from collections.abc import Iterator, Mapping
from unicodedata import combining, normalize

from bampipe.data.readers import lerobot
from bampipe.data.units import unit
from bampipe.data.vocabulary import VOCABULARY, word_set

DRIVERS = ("force", "current", "voltage")
"""Roles of columns that may drive an axis."""
_ROLE_WORDS: Mapping[str, str] = VOCABULARY["roles"]
_PLAIN = str.maketrans({"ı": "i", "ł": "l", "Ł": "L", "ø": "o", "ß": "ss", "µ": "u", "μ": "u"})
_ALL_WORDS = frozenset(word for text in _ROLE_WORDS.values() for word in text.split())
_ENDS = sorted((word for word in _ALL_WORDS if len(word) > 4 or word in ("time", "zeit")), key=len)
_RUN_TOGETHER = re.compile(r"(q|dq|tau|trq|pos|vel)(des|ref|cmd|meas|msr|act)")
REFERENCE_WORDS = frozenset(_ROLE_WORDS["reference"].split())
"""Words for the references of a controller rather than measurements."""
_BY_UNIT: Mapping[str, str] = VOCABULARY["roles_by_unit"]
_VAGUE, _TERSE, _WORDY = map(word_set, ("vague", "terse", "wordy"))
_PLAIN_POSITIONS, _PRESENT, _ANGLES = map(word_set, ("plain", "present", "angles"))
_VELOCITY_UNIT = re.compile(r"_(rad|deg|rev|mm|cm|m)_(per_)?s$")
"""Unit of a velocity at the end of a name."""
_LONGEST_WORD = 2
"""Letters at the end of a name that are a word rather than a unit, such as the in of pos_in."""
FACTOR = re.compile(
    r"(?i)(?:\s?[*×]\s?|[_ .(]+(?:x ?|(?:div|by|times)[_ ]?|(?=1?e\d\Z|10+0\Z)))"
    r"(?:1?e\d|10+|\d{3,})(?![a-z\d.])"
)
"""Factor in a name, of its unit or of its numbers."""
_UNIT_WORDS: Mapping[str, list[str]] = {
    role: text.split() for role, text in VOCABULARY["units_in_names"].items()
}
_OF_FIRST, _OF_UNIT, _OF_WORD, _OF_SUFFIX, _OF_LETTER, _OF_HINT = 6, 5, 4, 3, 2, 1
"""Weights of the evidence for a role, from words such as setpoint down to mere hints."""


def words(name: str) -> list[str]:
    """The words in the name of a column, in lower case and without accents; of compounds, each."""
    bare = re.sub(r"[\[(（].*?[\])）]", " ", name)
    for foreign, english in VOCABULARY["other_scripts"].items():
        bare = bare.lower().replace(foreign, f" {english} ") if foreign in bare.lower() else bare
    bare = "".join(c for c in normalize("NFKD", bare.translate(_PLAIN)) if not combining(c))
    parts = re.split(r"[^A-Za-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])|(?=[A-Z][a-z]{2})", "_", bare))
    return [word for part in parts if part for word in _parts_of(part.lower())]


def _parts_of(word: str) -> list[str]:
    """A word, or the two that it is put together from, such as ``motorstrom`` and ``qdes``."""
    if match := _RUN_TOGETHER.fullmatch(word):
        return [*match.groups()]
    end = next((end for end in reversed(_ENDS) if word.endswith(end)), word)
    start = word.removesuffix(end)
    return [start, end] if len(start) > 1 and word not in _ALL_WORDS else [word]


def role_of(name: str, stated: str) -> str:
    """Return the role of a column by its name and stated unit; "" if neither suggests one.

    A column of a part of a recording, as ``part:column``, may be named by the part.
    """
    part, colon, bare = name.partition(":")
    if colon and not part.startswith("/"):
        alone = role_of(bare, stated)
        vague = set(words(bare)) <= _VAGUE or not alone
        return (vague and role_of(part, "")) or alone
    weights: dict[str, float] = {}
    for role, weight in _evidence(name, stated):
        weights[role] = max(weight, weights.get(role, 0))
    best = [role for role in weights if weights[role] == max(weights.values())]
    if len(best) > 1 and weights[best[0]] <= _OF_LETTER:
        return ""  # x_F: letters that stand for several quantities
    return min(best, key=[*_ROLE_WORDS, ""].index, default="")


def _evidence(name: str, stated: str) -> Iterator[tuple[str, float]]:
    """Yield each role that a name or a stated unit suggests, with the weight of the evidence."""
    plain, said = name.strip(), words(name)
    clock = plain.lower() in _UNIT_WORDS["time"] or plain.lower().startswith("x_value")
    clock |= plain.endswith("@time")  # of a signal of a bag or of LabVIEW
    if stated == "datetime" or clock or plain.rpartition(".")[2] == "ts":  # Ts: rather an interval
        yield "time", _OF_FIRST + 1
    for phrase, role in VOCABULARY["phrases"].items():
        if f" {phrase} " in f" {' '.join(said)} ":
            yield role, _OF_FIRST + 1
    own = {*said, *(w.removesuffix(end) for w in said for end in ("s", "ed") if len(w) > 3)}
    if own & _PLAIN_POSITIONS:
        own -= _PRESENT  # the position that is current, and no current
    roles = set()
    for role, text in _ROLE_WORDS.items():
        longest = max(map(len, own & {*text.split()}), default=0)
        roles |= {role} if longest else set()
        if longest:
            first = role in ("reference", "brake")
            yield role, _OF_FIRST if first else _OF_WORD if longest > 1 else _OF_LETTER
    of_sensor = len(roles & {"position", "force"}) == 1  # whose volts stand for what it measures
    role = _role_by_unit(stated)
    if role and not (role == "voltage" and of_sensor):
        yield role, _OF_UNIT
    if by_suffix := _role_by_suffix(name):
        terse = max(map(len, said), default=0) <= _LONGEST_WORD  # t_Nm
        yield by_suffix, _OF_WORD + 0.5 if terse else _OF_SUFFIX
    for letter in re.split(r"\W|_", name)[1:] if len(roles) > 1 else ():
        if letter in ("A", "V"):
            yield _role_by_unit(letter), _OF_LETTER + 0.5
    if "joint" in own:
        yield "position", _OF_HINT
    if "load" in own:
        yield "force", _OF_HINT + 0.5
    if name.startswith(lerobot.STATE):
        yield "voltage" if "load" in name else "position", _OF_HINT + 0.7


def _role_by_unit(text: str) -> str:
    known = unit(text)
    return _BY_UNIT.get(known.si, "") if known is not None else ""


def _role_by_suffix(name: str) -> str:
    """The role by a unit at the end of a name that says nothing else."""
    if _VELOCITY_UNIT.search(name):
        return "velocity"
    suffix = re.split(r"[_\W]+", name)[-1]
    long = len(suffix) > _LONGEST_WORD and suffix.lower() not in _WORDY
    role = _role_by_unit(suffix) if long or suffix in _TERSE else ""
    return role if role != "time" else ""


def unit_of(name: str, stated: str, role: str) -> str:
    """Unit by the file, or by a last word of the name such as ``_us``, before an index if any."""
    if stated:
        return "rev/s" if role == "velocity" and unit(stated) == unit("Hz") else stated
    bare = re.sub(r"(\[\d+\]|_\d+)$", "", FACTOR.sub("", name.translate(_PLAIN)))
    if role == "velocity" and (rate := _VELOCITY_UNIT.search(bare)):
        return f"{rate[1]}/s"
    parts = re.findall(r"(?:\d+\.(?=\d))?[^\W_]+|[°%]", bare)
    both = ".".join(parts[-2:]) if role == "force" and len(parts) > 2 else ""  # in_lbs, not in_N
    if re.match("in.(lb|oz)|(?!in.)", both.lower()) and (arm := unit(both)) and arm.si == "N.m":
        return both
    known = _UNIT_WORDS.get(role, [])
    inner = (part for part in parts[-2:0:-1] if len(part) > 1 and part in known)  # pos_mm_act
    for suffix in (*parts[1:][-1:], *inner):
        matches = [u for u in known if u.lower() == suffix.lower()]
        if matches == ["m"] and _ANGLES & set(words(name)):
            return ""  # theta_m is a motor's
        long = role not in ("", "time") and len(suffix) > _LONGEST_WORD
        if matches or (long and _role_by_unit(suffix) == role):
            return next(iter(matches), suffix)
    return ""
