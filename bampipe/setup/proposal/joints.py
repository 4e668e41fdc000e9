"""Which columns of a log are the positions and the drives of a robot's joints.

Columns that belong together have names alike but for the joint: its name, or a number. Only groups
with a column for every joint count, so no joint gets what is left over from another.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.data.units import unit
from bampipe.physics.device import Device

Tokens = tuple[str, ...]

_GENERAL = frozenset(["joint", "link", "axis", "motor", "drive"])
"""Words in the name of a joint that a log may leave out."""
_JOINT = "*"


@dataclass(frozen=True)
class Group:
    """Columns alike, one a joint.

    Attributes:
        columns: in the order of the joints.
        named: whether joints were identified by name; else by order.
    """

    columns: tuple[SurveyedColumn, ...]
    named: bool

    def reordered(self, order: Sequence[int]) -> "Group":
        """The same columns as those of other joints: of each, the number of its column."""
        return replace(self, columns=tuple(self.columns[k] for k in order))

    def __str__(self) -> str:
        return f"{self.columns[0].name} to {self.columns[-1].name}"


def pair_joints(
    device: Device, found: Survey
) -> tuple[list[Group], list[Group], dict[str, SurveyedColumn]]:
    """Find the groups of columns that stand for a robot's joints and its drives.

    Returns:
        Groups of positions and of drives, one a motor, the likeliest first; where no group has all
        drives, those of the group with the most by their input.
    """
    joints = [c.name for c in device.coordinates]
    motors = [re.sub(r"^(torque|current)_", "", name) for name in device.forces]
    roles = ("current", "force") if device.force_unit == "A" else ("force", "current")
    drives = [group for role in roles for group in _groups(motors, found.of(role))]
    positions = _groups(joints, found.of("position"))
    # A name of nothing but the joint is that of its position.
    positions = positions or [group for group in _groups(joints, found.of("")) if group.named]
    some: dict[str, SurveyedColumn] = {}
    if not drives and positions:
        incomplete = [g for r in roles for g in _incomplete(motors, found.of(r), positions[0])]
        most = max(incomplete, key=len, default={})
        # The force of a joint that slides may be called otherwise.
        for motor in (m for m in motors if most and m not in most):
            own = [c for c in found.of(*roles) if c not in most.values()]
            named = [
                c for c in own if _without(_tokens(c.name, c.unit), _tokens(motor)) is not None
            ]
            most = {**most, motor: named[0]} if len(named) == 1 else most
        some = {name: most[m] for name, m in zip(device.forces, motors, strict=True) if m in most}
        if len(some) == len(motors):
            return positions, [Group(tuple(some.values()), named=True)], {}
    return positions, drives, some


def chain_logged(chains: Mapping[str, Sequence[tuple[str, str]]], found: Survey) -> str:
    """The link at which the chain ends whose joints the columns name most; "" if they name none."""
    said = [_tokens(c.name, c.unit) for c in found.of("position") if not c.is_constant]
    logged = [
        [end for end in chain if any(_without(own, _tokens(end[0])) is not None for own in said)]
        for chain in chains.values()
    ]
    longest = max(logged, key=len, default=[])
    return longest[-1][1] if longest else ""


def _incomplete(
    names: Sequence[str], columns: Sequence[SurveyedColumn], positions: Group
) -> Iterator[Mapping[str, SurveyedColumn]]:
    """Groups with columns for some of ``names``: by their names, or numbered as ``positions``."""
    split = {c.name: _tokens(c.name, c.unit) for c in (*columns, *positions.columns)}
    said = {name: _tokens(name) for name in names}
    yield from _named_alike(said, columns, split).values()
    for numbered in _numbered_alike(positions.columns, split).values():
        if len(numbered) == len(names):
            of_number = dict(zip(sorted(numbered), names, strict=True))
            for group in _numbered_alike(columns, split).values():
                if group.keys() <= of_number.keys():
                    yield {of_number[number]: column for number, column in group.items()}


def _groups(names: Sequence[str], columns: Sequence[SurveyedColumn]) -> list[Group]:
    """Groups with a column for each of ``names``, by their names first; a column is in one."""
    split = {column.name: _tokens(column.name, column.unit) for column in columns}
    wanted = {name: _tokens(name) for name in names}
    shared = set.intersection(*map(set, wanted.values())) if len(names) > 1 else set[str]()
    bare, own = (
        {name: tuple(t for t in said if t not in less) for name, said in wanted.items()}
        for less in (_GENERAL, _GENERAL | shared)
    )
    found: list[Group] = []
    for said in (wanted, bare, own):
        if all(said.values()) and len(set(said.values())) == len(names):
            found += [
                Group(tuple(group[name] for name in said), named=True)
                for group in _named_alike(said, columns, split).values()
                if len(group) == len(said)
            ]
    # Names that differ by one number only, in its order.
    found += [
        Group(tuple(group[number] for number in sorted(group)), named=len(names) == 1)
        for group in _numbered_alike(columns, split).values()
        if len(group) == len(names)
    ]
    # Columns on the motors' side stand for their joints only if no others do.
    found.sort(key=lambda group: "motor" in _tokens(group.columns[0].name))
    taken: set[str] = set()
    chosen = []
    for group in found:
        if all(column.is_constant for column in group.columns):
            continue
        if taken.isdisjoint(column.name for column in group.columns):
            taken |= {column.name for column in group.columns}
            chosen.append(group)
    if not found and len(columns) == len(names):
        # In their order, unless the name of a joint stands elsewhere.
        in_order = dict(zip(names, columns, strict=True))
        alike = [_named_alike(said, columns, split) for said in (wanted, bare, own)]
        named = (pair for groups in alike for group in groups.values() for pair in group.items())
        agree = all(in_order[name] is column for name, column in named)
        chosen = [Group(tuple(columns), named=False)] * agree
    return chosen


def _named_alike(
    said: dict[str, Tokens], columns: Sequence[SurveyedColumn], split: dict[str, Tokens]
) -> dict[Tokens, dict[str, SurveyedColumn]]:
    """Columns by name of the joint, those together whose names are alike but for it."""
    groups: dict[Tokens, dict[str, SurveyedColumn]] = {}
    # If names contain one another, as wrist_roll does wrist, the longest one counts.
    for column in columns:
        for name in sorted(said, key=lambda name: -len(said[name])):
            rest = _without(split[column.name], said[name])
            if rest is not None:
                groups.setdefault(rest, {}).setdefault(name, column)
                break
    return groups


def _numbered_alike(
    columns: Sequence[SurveyedColumn], split: dict[str, Tokens]
) -> dict[Tokens, dict[int, SurveyedColumn]]:
    """Columns by a number in their names, those together whose names are alike but for it."""
    groups: dict[Tokens, dict[int, SurveyedColumn]] = {}
    for column in columns:
        tokens = split[column.name]
        for place, token in enumerate(tokens):
            if token.isdigit():
                alike = (*tokens[:place], _JOINT, *tokens[place + 1 :])
                groups.setdefault(alike, {}).setdefault(int(token), column)
    return groups


def _tokens(name: str, unit_of: str = "") -> Tokens:
    """Words and numbers of a name, in lower case, without a unit in brackets or at its end.

    A force is called a torque, as that of a joint that slides is among others, F3 beside T1.
    """
    name = re.sub(rf"(?<=.)[_\W]+{re.escape(unit_of)}\Z", "", name) if unit_of else name
    bare = re.sub(
        r"[\[(]([^\])]*[A-Za-z%°][^\])]*)[\])]",
        lambda said: " " if unit(said[1]) is not None or "°" in said[1] else f" {said[1]} ",
        name,
    )
    bare = re.sub(r"(?i)(?<![a-z])[ft](?=\d)|force", "Torque", bare)
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", bare)
    return tuple(str(int(p)) if p.isdigit() else p.lower() for p in parts)


def _without(tokens: Tokens, part: Tokens) -> Tokens | None:
    """Return ``tokens`` with ``part`` replaced, None unless it stands in them once."""
    places = [k for k in range(len(tokens) - len(part) + 1) if tokens[k : k + len(part)] == part]
    if len(places) != 1:
        return None
    k = places[0]
    return (*tokens[:k], _JOINT, *tokens[k + len(part) :])
