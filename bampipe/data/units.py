"""Units of logs, and their conversion to coherent SI units."""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.data.vocabulary import VOCABULARY, by_word


@dataclass(frozen=True)
class RecordedUnit:
    """Conversion of a unit to SI: value in ``si`` = scale * value + offset."""

    si: str
    scale: float = 1.0
    offset: float = 0.0


_GRAVITY = 9.80665
_ORDER = ("kg", "N", "W", "Pa", "V", "A", "T", "K", "Hz", "rad", "m", "s")
"""Order of SI units in a product."""
_FACTORS: dict[str, tuple[str, float]] = {
    name: next(iter(of.items()))
    for name, of in ({si: {si: 1.0} for si in _ORDER} | VOCABULARY["units"]).items()
}
"""Units that others are put together from, with their SI unit."""
_LOGGED = frozenset(["", *_ORDER, "N.m", "rad/s", "rad/s2", "m/s", "m/s2"])
"""SI units of logged quantities."""
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 0.1, "da": 10.0, "k": 1e3, "M": 1e6}
_PREFIXED = frozenset(["s", "m", "rad", "deg", "N", "A", "V", "W", "Hz", "Pa", "T", "g", "bar"])
_WHOLE = by_word("whole_units")
_RATES = {"rpm": "rev/min", "r/min": "rev/min", "rps": "rev/s", "dps": "deg/s"}
_SPELLINGS = by_word("unit_spellings")
_PLAIN = str.maketrans("µμ×⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "uux-0123456789")
_CELSIUS = frozenset(["degc", "°c", "c", "celsius"])
_NAME_WITH_UNIT = re.compile(
    r"(?P<name>.*?)(?:\s*(?P<open>[\[(])\s*|\s/\s)(?P<unit>[^\[\]()]{1,16}?)\s*(?(open)[\])])\Z"
)
SCALES = ("scale", "scaling", "factor", "lsb", "gain")
"""Names in files for the number by which readings are to be multiplied."""
_BESIDE = re.compile(r"(?i)(?:\A|(?<=[./]))units?[./]|(?:\A|[ _./])units?\Z")
"""Affix that marks a metadata field as the unit of a quantity: the rest names the quantity."""
_INDEX = re.compile(r"\d+|0x[0-9A-Fa-f]+|\d[0-9A-Fa-f]{3}h")
"""Number of an element, or of an object of CANopen."""
_TOKEN = re.compile(
    r"(?P<number>(?<![^\W_])\d+(?:\.\d+)?(?:[eE]-?\d+)?|\.\d+)"
    r"|(?P<over>\s*(?:/|\bper\b)\s*)"
    r"|(?P<word>[^\W\d_]+|[%‰]|[°º][A-Za-z]?)(?:(?:\^|\*\*)?(?P<power>-[1-4]|[2-4])(?![\d.]))?"
    r"|\s*[*·⋅∙・.\s-]\s*"
)  # fmt: skip


def spelled(text: str, among: Sequence[str]) -> str:
    """The one of ``among`` that means the same unit as ``text``, else the text without brackets.

    "" if the unit is not known.
    """
    known = unit(text)
    if text in among or known is None:
        return text if text in among else ""
    return next((other for other in among if unit(other) == known), bare(text))


def bare(text: str) -> str:
    """A unit without the brackets in which some files have it, and without the start of a clock."""
    return text.strip().strip("[]()").partition(" since ")[0].strip()


def units_in(names: Iterable[str]) -> dict[str, str]:
    """Units in names such as ``force [N]`` or ``force / N``; a number, as in ``q[0]``, is an index.

    Beside units of other columns, ``[1]`` is one, unless the name comes with other numbers too.
    """
    # A number behind the unit tells two of one name apart.
    plain = {name: re.sub(r"(?<=[\])]) \(\d+\)\Z", "", name) for name in names}
    matches = {n: match for n, said in plain.items() if (match := _NAME_WITH_UNIT.match(said))}
    numbered = Counter(m["name"] for m in matches.values() if m["unit"].isdigit())
    others = any(not match["unit"].isdigit() for match in matches.values())

    def is_index(match: re.Match[str]) -> bool:
        alone = match["unit"] == "1" and others and numbered[match["name"]] == 1
        return bool(_INDEX.fullmatch(match["unit"])) and not alone

    matches = {n: m for n, m in matches.items() if m["name"] and (m["open"] or unit(m["unit"]))}
    units = {n: m["unit"] for n, m in matches.items() if not is_index(m)}
    # In a name all in capitals, M and S are metres and seconds, too.
    return {n: u.lower() if n.isupper() and u in ("M", "S") else u for n, u in units.items()}


def units_beside(texts: Mapping[str, str]) -> dict[str, str]:
    """Units by quantity, from metadata fields such as ``q_unit``, ``q.unit`` and ``units.q``."""
    found = ((_BESIDE.sub("", name, count=1), name) for name in texts)
    return {of: texts[name] for of, name in found if of != name}


def in_steps(values: np.ndarray, sizes: Collection[float], text: str, sure: bool = True) -> str:
    """Unit of readings (T,) that a file says to multiply by one of ``sizes``; ``text``: that then.

    None that is known where they may be multiplied already, as others than whole numbers may, or
    multiples of a size above one; or where it is not ``sure`` that they are meant.
    """
    if {*sizes} == {1.0}:
        return text
    sure &= len(sizes) == 1 and bool(np.all(values == np.rint(values)))
    sure &= not any(size > 1.0 and np.all(values % size == 0.0) for size in sizes)
    size = " or ".join(map(repr, sizes))
    step = f"{size} {text}" if text else f"steps of {size} of no stated unit"
    return step if sure else f"{step}, if not applied"


def unit(text: str) -> RecordedUnit | None:
    """The unit that ``text`` stands for, None if it is unknown.

    It is a product of factors with powers, in any of the usual spellings: ``Nm``, ``N*m``,
    ``N·m`` and ``N-m`` are the same, ``mA``, ``kN`` and the like are put together from their
    prefix, ``13.5mA`` is a reading in steps of 13.5 mA. ``nm`` is a nanometre, not a torque; a
    mass times a length is a torque.
    """
    plain = re.sub("10(?=[⁻⁰¹²³⁴⁵⁶⁷⁸⁹])", "10^", bare(text)).translate(_PLAIN)
    plain = re.sub(r"(?:\bx ?|\b)10(?:\^|\*\*)(-?\d+)", r"1e\1", plain)
    plain = _WHOLE.get(plain.lower().replace("-", "").replace(".", "") or plain, plain)
    plain = re.sub(
        r"(?i)(?<![a-z])(rpm|r/min|rps|dps)(?![a-z])", lambda rate: _RATES[rate[0].lower()], plain
    )
    if len(plain) == 1 and plain.isupper() and plain not in (*_ORDER, "C"):
        return None  # (R) and (S) are sides and names
    if plain.lower() in _CELSIUS:
        return RecordedUnit("K", 1.0, 273.15)
    scale, at, sign = 1.0, 0, 1
    factors: list[tuple[str, float, int]] = []
    while at < len(plain):
        token = _TOKEN.match(plain, at)
        if token is None:
            return None
        at = token.end()
        if token["number"]:
            # In N.m x 1000, thousands or thousandths; in 10-2 N, a power or a product.
            if sign > 0 and (float(token["number"]) > 1.0 if factors else scale != 1.0):
                return None
            scale *= float(token["number"]) ** sign
        if token["word"]:
            found = _factor(token["word"])
            if found is None:
                return None
            power = sign * int(token["power"] or 1)
            factors += [(*each, power) for each in found]
        sign = -1 if token["over"] else 1
    return _product(scale, factors)


def _factor(word: str) -> list[tuple[str, float]] | None:
    """SI unit and scale of one factor, or of two written without anything between them."""
    pair = re.fullmatch(r"(.*N|[mk]n|n(?=[cm]m))(m|cm|mm|M)", word)
    if pair:
        parts = [_factor(each) for each in (f"{pair[1][:-1]}N", pair[2].lower())]
        return [found for part in parts if part for found in part] if all(parts) else None
    low = word.lower()
    singular = low.removesuffix("s") if len(low) > 2 else low
    for spelling in dict.fromkeys((word, _SPELLINGS.get(word, ""), low, singular)):
        known = _SPELLINGS.get(spelling, spelling)
        if known in _FACTORS:
            return [_FACTORS[known]]
        prefix = "da" if known == "daN" else known[:1]
        if prefix in _PREFIXES and known.removeprefix(prefix) in _PREFIXED:
            si, scale = _FACTORS[known.removeprefix(prefix)]
            return [(si, scale * _PREFIXES[prefix])]
    return None


def _product(scale: float, factors: list[tuple[str, float, int]]) -> RecordedUnit | None:
    """The unit that so many factors make, with what they are multiplied by."""
    powers = dict.fromkeys(_ORDER, 0)
    if {(si, power) for si, _, power in factors} == {("kg", 1), ("m", 1)}:
        scale *= _GRAVITY  # the weight of the mass
        factors = [("N" if si == "kg" else si, size, power) for si, size, power in factors]
    for si, size, power in factors:
        scale *= size**power
        if si:
            powers[si] += power
    above = ".".join(f"{si}{n if n > 1 else ''}" for si, n in powers.items() if n > 0)
    below = "".join(f"/{si}{-n if n < -1 else ''}" for si, n in powers.items() if n < 0)
    if scale <= 0.0 or above + below not in _LOGGED or not (factors or scale == 1.0):
        return None
    return RecordedUnit(above + below, scale)
